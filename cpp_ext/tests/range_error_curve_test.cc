#include "rangesfm/range_error_curve.h"

#include <gtest/gtest.h>

#include <Eigen/Core>
#include <cmath>

namespace rangesfm {
namespace {

TabulatedCurve Table() {
  Eigen::VectorXd distance(5);
  Eigen::VectorXd value(5);
  distance << 0.3, 1.0, 1.5, 3.0, 8.0;
  value << -0.15, -0.08, -0.06, 0.02, 0.01;
  return {distance, value};
}

void ExpectSlopeIsTheDerivative(const RangeErrorCurve& curve, double distance) {
  constexpr double kStep = 1e-5;
  const double expected = (curve.At(distance + kStep).value - curve.At(distance - kStep).value) / (2.0 * kStep);
  EXPECT_NEAR(curve.At(distance).slope, expected, 1e-8) << distance;
}

TEST(ExponentialCurve, FadesByAFactorOfEOverItsLength) {
  const ExponentialCurve curve(0.5);
  EXPECT_DOUBLE_EQ(curve.At(0.0).value, 1.0);
  EXPECT_NEAR(curve.At(0.5).value, std::exp(-1.0), 1e-15);
  EXPECT_EQ(curve.At(1e6).value, 0.0);
  for (const double distance : {0.1, 0.5, 3.0}) {
    ExpectSlopeIsTheDerivative(curve, distance);
  }
}

TEST(TabulatedCurve, GoesThroughItsPointsAndStaysBeyondThem) {
  const TabulatedCurve curve = Table();
  EXPECT_DOUBLE_EQ(curve.At(0.3).value, -0.15);
  EXPECT_NEAR(curve.At(1.5).value, -0.06, 1e-15);
  EXPECT_NEAR(curve.At(std::nextafter(1.5, 0.0)).value, -0.06, 1e-14);
  EXPECT_DOUBLE_EQ(curve.At(0.0).value, -0.15);
  EXPECT_DOUBLE_EQ(curve.At(100.0).value, 0.01);
  EXPECT_EQ(curve.At(0.1).slope, 0.0);
  EXPECT_EQ(curve.At(9.0).slope, 0.0);
}

TEST(TabulatedCurve, SlopeIsTheDerivativeAndContinuousAtThePoints) {
  const TabulatedCurve curve = Table();
  for (const double distance : {0.31, 0.7, 1.2, 2.0, 2.99, 5.0, 7.9}) {
    ExpectSlopeIsTheDerivative(curve, distance);
  }
  for (const double distance : {0.3, 1.0, 1.5, 3.0, 8.0}) {
    EXPECT_NEAR(curve.At(distance - 1e-9).slope, curve.At(distance + 1e-9).slope, 1e-7) << distance;
  }
}

TEST(TabulatedCurve, IsExactForAStraightLineBetweenItsEnds) {
  const TabulatedCurve curve(Eigen::Vector4d(0.0, 1.0, 3.0, 4.0), Eigen::Vector4d(1.0, 1.5, 2.5, 3.0));
  EXPECT_NEAR(curve.At(2.2).value, 2.1, 1e-14);
  EXPECT_NEAR(curve.At(2.2).slope, 0.5, 1e-14);
}

}  // namespace
}  // namespace rangesfm
