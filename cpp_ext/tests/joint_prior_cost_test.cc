#include "rangesfm/joint_prior_cost.h"

#include <gtest/gtest.h>

#include "cost_testing.h"

namespace rangesfm {
namespace {

TEST(JointPriorCost, SumOfSquaresIsThatOfTheCovariance) {
  Eigen::Matrix2d covariance;
  covariance << 5.0, 4.0, 4.0, 5.0;  // standard deviations: 1 of each number alone, 2 in common
  const Eigen::Matrix2d whitening = Eigen::Matrix2d(covariance.llt().matrixL()).inverse();
  const Eigen::Vector2d mean(1.0, -1.0);
  const JointPriorCost cost(mean, whitening);
  const Evaluation evaluation = Evaluate(cost, {{3.0}, {2.0}});
  const Eigen::Vector2d off(2.0, 3.0);
  const double expected = off.dot(covariance.inverse() * off);
  EXPECT_NEAR(std::pow(evaluation.residuals[0], 2) + std::pow(evaluation.residuals[1], 2), expected, 1e-12);
}

TEST(JointPriorCost, GradientsAreRightForAnyNumberOfBlocks) {
  Random random(1);
  for (const int size : {1, 2, 7}) {
    Eigen::VectorXd mean(size);
    Eigen::MatrixXd whitening(size, size);
    std::vector<Block> blocks;
    for (int i = 0; i < size; ++i) {
      mean[i] = random.Uniform(-5.0, 5.0);
      blocks.push_back({random.Uniform(-5.0, 5.0)});
      for (int j = 0; j < size; ++j) {
        whitening(i, j) = random.Uniform(-2.0, 2.0);
      }
    }
    ExpectGradientsAreRight(JointPriorCost(mean, whitening), blocks);
    ExpectAnyJacobianMayBeLeftOut(JointPriorCost(mean, whitening), blocks);
  }
}

}  // namespace
}  // namespace rangesfm
