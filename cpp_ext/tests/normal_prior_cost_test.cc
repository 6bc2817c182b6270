#include "rangesfm/normal_prior_cost.h"

#include <gtest/gtest.h>

#include "cost_testing.h"

namespace rangesfm {
namespace {

TEST(NormalPriorCost, ResidualsAreInStddevs) {
  const NormalPriorCost cost(Eigen::Vector3d(1.0, 2.0, 3.0), Eigen::Vector3d(0.1, 0.5, 2.0));
  const Evaluation evaluation = Evaluate(cost, {{1.2, 1.0, 7.0}});
  const std::vector<double> expected = {2.0, -2.0, 2.0};
  for (int i = 0; i < 3; ++i) {
    EXPECT_NEAR(evaluation.residuals[i], expected[i], 1e-12);
  }
}

TEST(NormalPriorCost, GradientsAreRightForBlocksOfAnySize) {
  Random random(1);
  for (const int size : {1, 3, 10}) {
    Eigen::VectorXd mean(size);
    Eigen::VectorXd stddev(size);
    Block block(size);
    for (int i = 0; i < size; ++i) {
      mean[i] = random.Uniform(-5.0, 5.0);
      stddev[i] = random.Uniform(0.01, 1.0);
      block[i] = random.Uniform(-5.0, 5.0);
    }
    ExpectGradientsAreRight(NormalPriorCost(mean, stddev), {block});
    ExpectAnyJacobianMayBeLeftOut(NormalPriorCost(mean, stddev), {block});
  }
}

TEST(NormalPriorCost, GradientsAreRightForATinyStddev) {
  ExpectGradientsAreRight(NormalPriorCost(Eigen::Vector3d(1.0, 2.0, 3.0), Eigen::Vector3d::Constant(1e-9)),
                          {{1.1, 2.2, 3.3}});
}

}  // namespace
}  // namespace rangesfm
