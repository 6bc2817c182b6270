#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <functional>

#include "cost_testing.h"
#include "range_costs.h"

namespace rangesfm {
namespace {

TEST(RangeCost, ResidualIsTheHandComputedOne) {
  // The camera is at (1, 2.5, 0), rotated by 90 degrees about z, so that its x axis is the world's -y. The tag, half a
  // metre along that axis, is at (1, 2, 0), 5 m from the anchor. The predicted range is 5.25 m and the measured one 5
  // m, with a standard deviation of 0.1 m, so that the residual is 2.5.
  const auto cost = AtKeyframe(5.0, Eigen::Vector3d(0.5, 0.0, 0.0), 0.1);
  const Block pose = {0.0, 0.0, std::sqrt(0.5), std::sqrt(0.5), 2.5, -1.0, 0.0};
  const Evaluation evaluation = Evaluate(cost, {pose, {4.0, 6.0, 0.0}, {0.25}});
  EXPECT_NEAR(evaluation.residuals[0], 2.5, 1e-13);
}

TEST(RangeCost, MovingTheCameraOntoTheTagGivesTheSameResidual) {
  Random random(1);
  const Eigen::Quaterniond cam_from_world = random.Rotation();
  const Eigen::Vector3d cam_in_world = random.Vector(5.0);
  const Eigen::Vector3d tag_in_world = cam_in_world + cam_from_world.conjugate() * TagInCam();
  const Block anchor = ToBlock(random.Vector(5.0));
  const auto with_lever_arm = AtKeyframe(4.0, TagInCam(), 0.1);
  const auto without = AtKeyframe(4.0, Eigen::Vector3d::Zero(), 0.1);
  EXPECT_NEAR(Evaluate(with_lever_arm, {PoseBlock(cam_from_world, cam_in_world), anchor, {0.0}}).residuals[0],
              Evaluate(without, {PoseBlock(cam_from_world, tag_in_world), anchor, {0.0}}).residuals[0], 1e-12);
}

TEST(RangeCost, GradientsAreRightAtRandomPoints) {
  Random random(2);
  for (int i = 0; i < 100; ++i) {
    const auto cost = AtKeyframe(random.Uniform(0.1, 20.0), random.Vector(1.0), random.Uniform(0.01, 1.0));
    ExpectGradientsAreRight(
        cost,
        {PoseBlock(random.Rotation(), random.Vector(10.0)), ToBlock(random.Vector(10.0)), {random.Uniform(-1.0, 1.0)}});
  }
}

TEST(RangeCost, GradientsAreRightForEitherSignOfTheQuaternion) {
  Random random(3);
  const auto cost = AtKeyframe(3.0, TagInCam(), 0.1);
  const Block anchor = ToBlock(random.Vector(5.0));
  Block pose = PoseBlock(random.Rotation(), random.Vector(5.0));
  const double residual = Evaluate(cost, {pose, anchor, {0.0}}).residuals[0];
  std::transform(pose.begin(), pose.begin() + 4, pose.begin(), std::negate<>());
  EXPECT_NEAR(Evaluate(cost, {pose, anchor, {0.0}}).residuals[0], residual, 1e-12);
  ExpectGradientsAreRight(cost, {pose, anchor, {0.0}});
}

TEST(RangeCost, GradientsAreRightFarAway) {
  Random random(4);
  const auto cost = AtKeyframe(1e6, TagInCam(), 0.1);
  ExpectGradientsAreRight(cost, {PoseBlock(random.Rotation(), random.Vector(1e6)), ToBlock(random.Vector(1e6)), {0.0}});
}

TEST(RangeCost, GradientsAreRightForATinyStddev) {
  Random random(5);
  const auto cost = AtKeyframe(3.0, TagInCam(), 1e-9);
  ExpectGradientsAreRight(cost, {PoseBlock(random.Rotation(), random.Vector(5.0)), ToBlock(random.Vector(5.0)), {0.1}});
}

TEST(RangeCost, GradientsAreRightWithTheTagAlmostOnTheAnchor) {
  Random random(6);
  const Eigen::Quaterniond cam_from_world = random.Rotation();
  const Eigen::Vector3d cam_in_world = random.Vector(1.0);
  const Eigen::Vector3d tag_in_world = cam_in_world + cam_from_world.conjugate() * TagInCam();
  const auto cost = AtKeyframe(0.1, TagInCam(), 0.05);
  const Eigen::Vector3d anchor = tag_in_world + Eigen::Vector3d(1e-3, -2e-3, 1e-3);
  // The steps are so small that they do not cross the anchor. They cost accuracy, which the tolerance allows for.
  ExpectGradientsAreRight(cost, {PoseBlock(cam_from_world, cam_in_world), ToBlock(anchor), {0.0}}, 1e-6);
}

TEST(RangeCost, AnswerIsFiniteWithTheTagOnTheAnchor) {
  const auto cost = AtKeyframe(0.5, TagInCam(), 0.1);
  const Block pose = {0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0};
  const Evaluation evaluation = Evaluate(cost, {pose, ToBlock(TagInCam()), {0.0}});
  ExpectAllFinite(evaluation);
  EXPECT_DOUBLE_EQ(evaluation.residuals[0], -5.0);
  EXPECT_EQ(evaluation.jacobians[0], std::vector<double>(7, 0.0));
  EXPECT_EQ(evaluation.jacobians[1], std::vector<double>(3, 0.0));
  EXPECT_DOUBLE_EQ(evaluation.jacobians[2][0], 10.0);
}

TEST(RangeCost, PullsWithFullStrengthAnyDistanceFromTheAnchor) {
  // The derivative with respect to the anchor is a unit vector over the standard deviation, at any distance.
  const Block pose = {0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0};
  const auto cost = AtKeyframe(1.0, Eigen::Vector3d::Zero(), 0.1);
  for (const double distance : {1e-11, 1e-6, 1.0, 1e6}) {
    const Evaluation evaluation = Evaluate(cost, {pose, {0.0, distance, 0.0}, {0.0}});
    EXPECT_DOUBLE_EQ(evaluation.jacobians[1][1], 10.0) << distance;
  }
}

TEST(RangeCost, AnyJacobianMayBeLeftOut) {
  Random random(7);
  const auto cost = AtKeyframe(3.0, TagInCam(), 0.1);
  ExpectAnyJacobianMayBeLeftOut(cost,
                                {PoseBlock(random.Rotation(), random.Vector(5.0)), ToBlock(random.Vector(5.0)), {0.1}});
}

}  // namespace
}  // namespace rangesfm
