#include <gtest/gtest.h>

#include "cost_testing.h"
#include "range_costs.h"

namespace rangesfm {
namespace {

TEST(FixedPoseRangeCost, ResidualIsTheHandComputedOne) {
  const auto cost = AtKnownPlace(5.0, Eigen::Vector3d(1.0, 2.0, 0.0), 0.1);
  EXPECT_NEAR(Evaluate(cost, {{4.0, 6.0, 0.0}, {0.25}}).residuals[0], 2.5, 1e-13);
}

TEST(FixedPoseRangeCost, IsTheRangeCostWithoutItsPose) {
  Random random(1);
  const Eigen::Quaterniond cam_from_world = random.Rotation();
  const Eigen::Vector3d cam_in_world = random.Vector(5.0);
  const Eigen::Vector3d tag_in_cam = random.Vector(0.1);
  const Block anchor = ToBlock(random.Vector(5.0));
  const auto free_cost = AtKeyframe(3.0, tag_in_cam, 0.05);
  const auto fixed_cost = AtKnownPlace(3.0, cam_in_world + cam_from_world.conjugate() * tag_in_cam, 0.05);
  const Evaluation free = Evaluate(free_cost, {PoseBlock(cam_from_world, cam_in_world), anchor, {0.2}});
  const Evaluation fixed = Evaluate(fixed_cost, {anchor, {0.2}});
  EXPECT_NEAR(fixed.residuals[0], free.residuals[0], 1e-11);
  for (int i = 0; i < 3; ++i) {
    EXPECT_NEAR(fixed.jacobians[0][i], free.jacobians[1][i], 1e-12);
  }
  EXPECT_EQ(fixed.jacobians[1], free.jacobians[2]);
}

TEST(FixedPoseRangeCost, GradientsAreRightAtRandomPoints) {
  Random random(2);
  for (int i = 0; i < 100; ++i) {
    const auto cost = AtKnownPlace(random.Uniform(0.1, 20.0), random.Vector(10.0), random.Uniform(0.01, 1.0));
    ExpectGradientsAreRight(cost, {ToBlock(random.Vector(10.0)), {random.Uniform(-1.0, 1.0)}});
  }
}

TEST(FixedPoseRangeCost, GradientsAreRightFarAwayAndForATinyStddev) {
  Random random(3);
  const auto cost = AtKnownPlace(1e6, random.Vector(1e6), 1e-9);
  ExpectGradientsAreRight(cost, {ToBlock(random.Vector(1e6)), {0.0}});
}

TEST(FixedPoseRangeCost, AnswerIsFiniteWithTheTagOnTheAnchor) {
  const Eigen::Vector3d tag_in_world(1.0, 2.0, 3.0);
  const Evaluation evaluation = Evaluate(AtKnownPlace(0.5, tag_in_world, 0.1), {ToBlock(tag_in_world), {0.0}});
  ExpectAllFinite(evaluation);
  EXPECT_DOUBLE_EQ(evaluation.residuals[0], -5.0);
  EXPECT_EQ(evaluation.jacobians[0], std::vector<double>(3, 0.0));
}

TEST(FixedPoseRangeCost, AnyJacobianMayBeLeftOut) {
  Random random(4);
  ExpectAnyJacobianMayBeLeftOut(AtKnownPlace(3.0, random.Vector(5.0), 0.1), {ToBlock(random.Vector(5.0)), {0.1}});
}

}  // namespace
}  // namespace rangesfm
