#include "rangesfm/robust_loss.h"

#include <ceres/loss_function.h>
#include <gtest/gtest.h>

#include <array>
#include <cmath>

#include "cost_testing.h"

namespace rangesfm {
namespace {

class RobustLossTest : public testing::TestWithParam<bool> {};

TEST_P(RobustLossTest, SlopeIsTheDerivative) {
  const RobustLoss loss(2.4, GetParam());
  for (const double residual : {-100.0, -3.0, -0.5, -1e-3, 1e-3, 0.5, 3.0, 100.0}) {
    const double step = 1e-5 * std::abs(residual);
    const double expected = (loss(residual + step).value - loss(residual - step).value) / (2.0 * step);
    EXPECT_NEAR(loss(residual).slope, expected, 1e-8) << residual;
  }
}

TEST_P(RobustLossTest, ValueAndSlopeAreContinuousAtZero) {
  const RobustLoss loss(2.4, GetParam());
  for (const double residual : {-1e-7, -1e-9, -1e-12, 0.0, 1e-12, 1e-9, 1e-7}) {
    EXPECT_NEAR(loss(residual).value, residual, 1e-20);
    EXPECT_NEAR(loss(residual).slope, 1.0, 1e-12);
  }
}

TEST_P(RobustLossTest, InfiniteScaleIsLeastSquares) {
  const RobustLoss loss(kInfinity, GetParam());
  EXPECT_DOUBLE_EQ(loss(50.0).value, 50.0);
  EXPECT_DOUBLE_EQ(loss(50.0).slope, 1.0);
  EXPECT_DOUBLE_EQ(RobustLoss()(-50.0).value, -50.0);
}

INSTANTIATE_TEST_SUITE_P(CauchyAndGemanMcClure, RobustLossTest, testing::Bool());

TEST(RobustLoss, HalfItsSquareIsHalfOfCeresCauchyLoss) {
  const RobustLoss loss(2.4, false);
  for (const double residual : {-1e6, -30.0, -2.4, -0.1, -1e-6, 0.0, 1e-6, 0.1, 0.7, 30.0, 1e6}) {
    std::array<double, 3> rho{};
    ceres::CauchyLoss(2.4).Evaluate(residual * residual, rho.data());
    const RobustLoss::Robust robust = loss(residual);
    EXPECT_NEAR(robust.value * robust.value, rho[0], 1e-12 * rho[0] + 1e-15);  // Ceres rounds 1 + x
    EXPECT_EQ(robust.value < 0.0, residual < 0.0);
    // The derivative of half the square equals that of half the loss.
    EXPECT_NEAR(robust.value * robust.slope, rho[1] * residual, 1e-12 * std::abs(residual));
  }
}

TEST(RobustLoss, ABoundedOneNeverExceedsItsScale) {
  const RobustLoss loss(2.4, true);
  EXPECT_NEAR(loss(-1e9).value, -2.4, 1e-12);
  EXPECT_NEAR(loss(1e9).value, 2.4, 1e-12);
  EXPECT_NEAR(loss(2.4).value, 2.4 / std::sqrt(2.0), 1e-12);
}

}  // namespace
}  // namespace rangesfm
