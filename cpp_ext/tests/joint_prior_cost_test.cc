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
  const JointPriorCost cost(1, mean, whitening);
  const Evaluation evaluation = Evaluate(cost, {{3.0}, {2.0}});
  const Eigen::Vector2d off(2.0, 3.0);
  const double expected = off.dot(covariance.inverse() * off);
  EXPECT_NEAR(std::pow(evaluation.residuals[0], 2) + std::pow(evaluation.residuals[1], 2), expected, 1e-12);
}

TEST(JointPriorCost, GradientsAreRightForAnyNumberAndSizeOfBlocks) {
  Random random(1);
  for (const int num : {1, 2, 7}) {
    for (const int block_size : {1, 3}) {
      const int size = num * block_size;
      Eigen::VectorXd mean(size);
      Eigen::MatrixXd whitening(size + 1 - num, size);
      for (double& value : mean) {
        value = random.Uniform(-5.0, 5.0);
      }
      for (double& value : whitening.reshaped()) {
        value = random.Uniform(-2.0, 2.0);
      }
      std::vector<Block> blocks(num, Block(block_size));
      for (Block& block : blocks) {
        for (double& value : block) {
          value = random.Uniform(-5.0, 5.0);
        }
      }
      ExpectGradientsAreRight(JointPriorCost(block_size, mean, whitening), blocks);
      ExpectAnyJacobianMayBeLeftOut(JointPriorCost(block_size, mean, whitening), blocks);
    }
  }
}

}  // namespace
}  // namespace rangesfm
