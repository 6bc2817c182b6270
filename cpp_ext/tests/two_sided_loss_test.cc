#include "rangesfm/two_sided_loss.h"

#include <ceres/loss_function.h>
#include <gtest/gtest.h>

#include <array>
#include <cmath>

#include "cost_testing.h"

namespace rangesfm {
namespace {

class TwoSidedLossTest : public testing::TestWithParam<bool> {};

TEST_P(TwoSidedLossTest, SlopeIsTheDerivative) {
  const TwoSidedLoss loss(2.4, 0.7, GetParam());
  for (const double residual : {-100.0, -3.0, -0.5, -1e-3, 1e-3, 0.5, 3.0, 100.0}) {
    const double step = 1e-5 * std::abs(residual);
    const double expected = (loss(residual + step).value - loss(residual - step).value) / (2.0 * step);
    EXPECT_NEAR(loss(residual).slope, expected, 1e-8) << residual;
  }
}

TEST_P(TwoSidedLossTest, ValueAndSlopeAreContinuousWhereTheSidesMeet) {
  const TwoSidedLoss loss(2.4, 0.7, GetParam());
  for (const double residual : {-1e-7, -1e-9, -1e-12, 0.0, 1e-12, 1e-9, 1e-7}) {
    EXPECT_NEAR(loss(residual).value, residual, 1e-20);
    EXPECT_NEAR(loss(residual).slope, 1.0, 1e-12);
  }
}

TEST_P(TwoSidedLossTest, InfiniteScaleIsLeastSquaresOnThatSide) {
  const TwoSidedLoss loss(1.0, kInfinity, GetParam());
  EXPECT_DOUBLE_EQ(loss(50.0).value, 50.0);
  EXPECT_DOUBLE_EQ(loss(50.0).slope, 1.0);
  EXPECT_LT(std::abs(loss(-50.0).value), 3.0);
  EXPECT_DOUBLE_EQ(TwoSidedLoss()(-50.0).value, -50.0);
}

INSTANTIATE_TEST_SUITE_P(CauchyAndGemanMcClure, TwoSidedLossTest, testing::Bool());

TEST(TwoSidedLoss, HalfItsSquareIsHalfOfCeresCauchyLoss) {
  const TwoSidedLoss loss(2.4, 0.7, false);
  for (const double residual : {-1e6, -30.0, -2.4, -0.1, -1e-6, 0.0, 1e-6, 0.1, 0.7, 30.0, 1e6}) {
    std::array<double, 3> rho{};
    ceres::CauchyLoss(residual < 0.0 ? 2.4 : 0.7).Evaluate(residual * residual, rho.data());
    const TwoSidedLoss::Robust robust = loss(residual);
    EXPECT_NEAR(robust.value * robust.value, rho[0], 1e-12 * rho[0] + 1e-15);  // Ceres rounds 1 + x
    EXPECT_EQ(robust.value < 0.0, residual < 0.0);
    // The gradient of half the square is that of half the loss.
    EXPECT_NEAR(robust.value * robust.slope, rho[1] * residual, 1e-12 * std::abs(residual));
  }
}

TEST(TwoSidedLoss, ABoundedOneNeverExceedsItsScale) {
  const TwoSidedLoss loss(2.4, 0.7, true);
  EXPECT_NEAR(loss(-1e9).value, -2.4, 1e-12);
  EXPECT_NEAR(loss(1e9).value, 0.7, 1e-12);
  EXPECT_NEAR(loss(0.7).value, 0.7 / std::sqrt(2.0), 1e-12);
}

}  // namespace
}  // namespace rangesfm
