#include <gtest/gtest.h>

#include "cost_testing.h"
#include "range_costs.h"

namespace rangesfm {
namespace {

std::vector<Block> RandomBlocks(Random& random, double extent) {
  return {PoseBlock(random.Rotation(), random.Vector(extent)),
          PoseBlock(random.Rotation(), random.Vector(extent)),
          ToBlock(random.Vector(extent)),
          {random.Uniform(-0.1, 0.1)}};
}

TEST(InterpolatedRangeCost, ResidualIsTheHandComputedOne) {
  // The tag is a quarter of the way from (0, 2, 0) to (4, 2, 0), plus an offset of half a metre in z: at (1, 2, 0.5),
  // 5 m from the anchor. The predicted range is 5.25 m and the measured one 5 m, with a standard deviation of 0.1 m, so
  // that the residual is 2.5.
  const auto cost = BetweenKeyframes(5.0, Eigen::Vector3d::Zero(), 0.25, Eigen::Vector3d(0.0, 0.0, 0.5), 0.1);
  const Block before = {0.0, 0.0, 0.0, 1.0, 0.0, -2.0, 0.0};
  const Block after = {0.0, 0.0, 1.0, 0.0, 4.0, 2.0, 0.0};  // rotated by 180 degrees about z
  EXPECT_NEAR(Evaluate(cost, {before, after, {4.0, 6.0, 0.5}, {0.25}}).residuals[0], 2.5, 1e-13);
}

TEST(InterpolatedRangeCost, IsTheRangeCostAtEitherEnd) {
  Random random(1);
  const std::vector<Block> blocks = RandomBlocks(random, 5.0);
  const auto at_keyframe = AtKeyframe(3.0, TagInCam(), 0.1);
  for (const int end : {0, 1}) {
    const auto between = BetweenKeyframes(3.0, TagInCam(), end, Eigen::Vector3d::Zero(), 0.1);
    const Evaluation expected = Evaluate(at_keyframe, {blocks[end], blocks[2], blocks[3]});
    const Evaluation found = Evaluate(between, blocks);
    EXPECT_EQ(found.residuals, expected.residuals);
    EXPECT_EQ(found.jacobians[end], expected.jacobians[0]);
    EXPECT_EQ(found.jacobians[1 - end], std::vector<double>(7, 0.0));
  }
}

TEST(InterpolatedRangeCost, GradientsAreRightAtRandomPoints) {
  Random random(2);
  for (int i = 0; i < 100; ++i) {
    const auto cost = BetweenKeyframes(random.Uniform(0.1, 20.0), random.Vector(1.0), random.Uniform(0.0, 1.0),
                                       random.Vector(0.5), random.Uniform(0.01, 1.0));
    ExpectGradientsAreRight(cost, RandomBlocks(random, 10.0));
  }
}

TEST(InterpolatedRangeCost, GradientsAreRightFarAway) {
  Random random(3);
  const auto cost = BetweenKeyframes(1e6, TagInCam(), 0.4, random.Vector(1e3), 0.1);
  ExpectGradientsAreRight(cost, RandomBlocks(random, 1e6));
}

TEST(InterpolatedRangeCost, GradientsAreRightForATinyStddev) {
  Random random(4);
  const auto cost = BetweenKeyframes(3.0, TagInCam(), 0.4, random.Vector(0.1), 1e-9);
  ExpectGradientsAreRight(cost, RandomBlocks(random, 5.0));
}

TEST(InterpolatedRangeCost, GradientsAreRightWithTheTagAlmostOnTheAnchor) {
  const auto cost = BetweenKeyframes(0.1, Eigen::Vector3d::Zero(), 0.5, Eigen::Vector3d::Zero(), 0.05);
  const Eigen::Quaterniond identity = Eigen::Quaterniond::Identity();
  ExpectGradientsAreRight(cost,
                          {PoseBlock(identity, Eigen::Vector3d(-1.0, 0.5, 0.25)),
                           PoseBlock(identity, Eigen::Vector3d(1.0, 0.5, 0.25)),
                           {1e-3, 0.5 - 2e-3, 0.25 + 1e-3},
                           {0.0}},
                          1e-6);
}

TEST(InterpolatedRangeCost, AnswerIsFiniteWithTheTagOnTheAnchor) {
  const auto cost = BetweenKeyframes(0.5, Eigen::Vector3d::Zero(), 0.5, Eigen::Vector3d::Zero(), 0.1);
  const Eigen::Quaterniond identity = Eigen::Quaterniond::Identity();
  const Evaluation evaluation = Evaluate(cost, {PoseBlock(identity, -Eigen::Vector3d::UnitX()),
                                                PoseBlock(identity, Eigen::Vector3d::UnitX()),
                                                {0.0, 0.0, 0.0},
                                                {0.0}});
  ExpectAllFinite(evaluation);
  EXPECT_DOUBLE_EQ(evaluation.residuals[0], -5.0);
}

TEST(InterpolatedRangeCost, AnyJacobianMayBeLeftOut) {
  Random random(5);
  ExpectAnyJacobianMayBeLeftOut(BetweenKeyframes(3.0, TagInCam(), 0.3, random.Vector(0.1), 0.1),
                                RandomBlocks(random, 5.0));
}

}  // namespace
}  // namespace rangesfm
