#include "rangesfm/distance_cost.h"

#include <gtest/gtest.h>

#include "cost_testing.h"
#include "range_costs.h"

namespace rangesfm {
namespace {

TEST(DistanceCost, ResidualIsTheHandComputedOne) {
  // One camera is at (1, 2, 0), rotated by 180 degrees about z, with its end 1 m along its x axis, at (0, 2, 0). The
  // other camera and its end are at the origin. The ends are 2 m apart. With a bias of 0.25 m, a measured distance
  // of 1.75 m and a standard deviation of 0.1 m, the residual is 5.
  const Block a = {0.0, 0.0, 1.0, 0.0, 1.0, 2.0, 0.0};
  const Block b = {0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0};
  const CamEnd end_a(Eigen::Vector3d(1.0, 0.0, 0.0));
  const CamEnd end_b(Eigen::Vector3d::Zero());
  const DistanceCost<CamEnd, CamEnd> with_bias(1.75, end_a, end_b, 0.1, true);
  EXPECT_NEAR(Evaluate(with_bias, {a, b, {0.25}}).residuals[0], 5.0, 1e-12);
  const DistanceCost<CamEnd, CamEnd> without(1.75, end_a, end_b, 0.1, false);
  EXPECT_NEAR(Evaluate(without, {a, b}).residuals[0], 2.5, 1e-12);
}

TEST(DistanceCost, IsTheRangeCostBetweenACameraAndAPoint) {
  Random random(1);
  const Eigen::Vector3d tag_in_cam = random.Vector(0.1);
  const std::vector<Block> blocks = {RandomPose(random, 5.0), ToBlock(random.Vector(5.0)), {0.2}};
  const DistanceCost<CamEnd, PointEnd> distance(3.0, CamEnd(tag_in_cam), PointEnd(), 0.05, true);
  const Evaluation expected = Evaluate(AtKeyframe(3.0, tag_in_cam, 0.05), blocks);
  const Evaluation found = Evaluate(distance, blocks);
  EXPECT_EQ(found.residuals, expected.residuals);
  EXPECT_EQ(found.jacobians, expected.jacobians);
}

TEST(DistanceCost, GradientsAreRightForAnyTwoEndsAtRandomPoints) {
  Random random(2);
  for (int i = 0; i < 50; ++i) {
    const CamEnd a(random.Vector(1.0));
    const CamEnd b(random.Vector(1.0));
    const double distance = random.Uniform(0.1, 20.0);
    const double stddev = random.Uniform(0.001, 1.0);
    const Block pose_a = RandomPose(random, 10.0);
    const Block pose_b = RandomPose(random, 10.0);
    const Block point_a = ToBlock(random.Vector(10.0));
    const Block point_b = ToBlock(random.Vector(10.0));
    const Block bias = {random.Uniform(-1.0, 1.0)};
    ExpectGradientsAreRight(DistanceCost<CamEnd, CamEnd>(distance, a, b, stddev, true), {pose_a, pose_b, bias});
    ExpectGradientsAreRight(DistanceCost<CamEnd, PointEnd>(distance, a, PointEnd(), stddev, false), {pose_a, point_b});
    ExpectGradientsAreRight(DistanceCost<PointEnd, CamEnd>(distance, PointEnd(), b, stddev, false), {point_a, pose_b});
    ExpectGradientsAreRight(DistanceCost<PointEnd, PointEnd>(distance, PointEnd(), PointEnd(), stddev, true),
                            {point_a, point_b, bias});
  }
}

TEST(DistanceCost, ALossLimitsWhatAnOutlierCosts) {
  const Block a = {0.0, 0.0, 0.0};
  const Block b = {500.0, 0.0, 0.0};
  const RobustLoss loss(3.0, true);
  const DistanceCost<PointEnd, PointEnd> cost(2.0, PointEnd(), PointEnd(), 0.1, false, loss);
  EXPECT_NEAR(Evaluate(cost, {a, b}).residuals[0], 3.0, 1e-5);
  Random random(4);
  for (int i = 0; i < 20; ++i) {
    const DistanceCost<CamEnd, PointEnd> robust(random.Uniform(0.1, 20.0), CamEnd(random.Vector(1.0)), PointEnd(), 1.0,
                                                true, RobustLoss(20.0, true));
    ExpectGradientsAreRight(robust, {RandomPose(random, 10.0), ToBlock(random.Vector(10.0)), {0.3}}, 1e-7);
  }
}

TEST(DistanceCost, GradientsAreRightFarAwayAndForATinyStddev) {
  Random random(3);
  const CamEnd end(random.Vector(1.0));
  ExpectGradientsAreRight(DistanceCost<CamEnd, CamEnd>(1e6, end, end, 1e-9, false),
                          {RandomPose(random, 1e6), RandomPose(random, 1e6)});
}

TEST(DistanceCost, AnswerIsFiniteWhereTheEndsMeet) {
  const DistanceCost<PointEnd, PointEnd> cost(0.5, PointEnd(), PointEnd(), 0.1, true);
  const Evaluation evaluation = Evaluate(cost, {{1.0, 2.0, 3.0}, {1.0, 2.0, 3.0}, {0.0}});
  ExpectAllFinite(evaluation);
  EXPECT_DOUBLE_EQ(evaluation.residuals[0], -5.0);
  EXPECT_EQ(evaluation.jacobians[0], std::vector<double>(3, 0.0));
}

TEST(DistanceCost, AnyJacobianMayBeLeftOut) {
  Random random(4);
  const CamEnd end(random.Vector(1.0));
  ExpectAnyJacobianMayBeLeftOut(DistanceCost<CamEnd, CamEnd>(3.0, end, end, 0.1, true),
                                {RandomPose(random, 5.0), RandomPose(random, 5.0), {0.1}});
}

}  // namespace
}  // namespace rangesfm
