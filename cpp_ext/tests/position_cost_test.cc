#include "rangesfm/position_cost.h"

#include <gtest/gtest.h>

#include <Eigen/Core>
#include <optional>
#include <vector>

#include "cost_testing.h"
#include "rangesfm/robust_loss.h"
#include "rangesfm/tag_place.h"

namespace rangesfm {
namespace {

KnownPositions RandomPositions(Random& random, int num, double extent) {
  KnownPositions known;
  known.position = Eigen::Matrix3Xd(3, num);
  known.whitening = Eigen::Matrix3Xd(3, 3 * num);
  known.share = Eigen::VectorXd(num);
  for (int i = 0; i < num; ++i) {
    known.position.col(i) = random.Vector(extent);
    known.share[i] = random.Uniform(0.2, 1.0);
    for (int axis = 0; axis < 3; ++axis) {
      known.whitening.col(3 * i + axis) = random.Vector(3.0);
    }
  }
  return known;
}

InterpolatedPlace RandomPlace(Random& random, int num) {
  Eigen::VectorXd weight(num);
  Eigen::Matrix3Xd offset(3, num);
  for (int i = 0; i < num; ++i) {
    weight[i] = random.Uniform(0.0, 1.0);
    offset.col(i) = random.Vector(0.3);
  }
  return {weight, offset, random.Uniform(0.2, 2.0)};
}

TEST(PositionCost, ResidualIsTheHandComputedOne) {
  // The antenna is 1 m along the x axis of a camera at (1, 2, 0) that is rotated by 180 degrees about z: at (0, 2, 0).
  // It is known to be at (0.3, 2, -0.2), with standard deviations of 0.1, 0.2 and 0.4 m and a share of a quarter.
  const Block pose = {0.0, 0.0, 1.0, 0.0, 1.0, 2.0, 0.0};
  KnownPositions known;
  known.position = Eigen::Vector3d(0.3, 2.0, -0.2);
  known.whitening = Eigen::Vector3d(10.0, 5.0, 2.5).asDiagonal();
  known.share = Eigen::VectorXd::Constant(1, 0.25);
  const PositionCost<KeyframePlace> cost(KeyframePlace(), known, Eigen::Vector3d(1.0, 0.0, 0.0), false);
  const std::vector<double> residuals = Evaluate(cost, {pose}).residuals;
  EXPECT_NEAR(residuals[0], -1.5, 1e-12);
  EXPECT_NEAR(residuals[1], 0.0, 1e-12);
  EXPECT_NEAR(residuals[2], 0.25, 1e-12);
}

TEST(PositionCost, GradientsAreRightForAnyBlocksAtRandomPoints) {
  Random random(2);
  for (int i = 0; i < 30; ++i) {
    const RobustLoss loss(i % 2 == 0 ? kInfinity : 20.0, true);
    const Block before = RandomPose(random, 5.0);
    const Block after = RandomPose(random, 5.0);
    const Block arm = ToBlock(random.Vector(0.5));
    const Block shift = {random.Uniform(-0.3, 0.3)};
    const Eigen::Vector3d known_arm = random.Vector(0.5);
    const KnownPositions known = RandomPositions(random, 3, 5.0);
    const double tolerance = i % 2 == 0 ? 1e-9 : 1e-7;
    ExpectGradientsAreRight(PositionCost<KeyframePlace>(KeyframePlace(), known, known_arm, false, loss), {before},
                            tolerance);
    ExpectGradientsAreRight(PositionCost<KeyframePlace>(KeyframePlace(), known, std::nullopt, false, loss),
                            {before, arm}, tolerance);
    ExpectGradientsAreRight(PositionCost<InterpolatedPlace>(RandomPlace(random, 3), known, known_arm, true, loss),
                            {before, after, shift}, tolerance);
    ExpectGradientsAreRight(PositionCost<InterpolatedPlace>(RandomPlace(random, 3), known, std::nullopt, true, loss),
                            {before, after, arm, shift}, tolerance);
  }
}

TEST(PositionCost, ALossLimitsWhatAnOutlierCosts) {
  KnownPositions known;
  known.position = Eigen::Vector3d(300.0, 400.0, 0.0);
  known.whitening = 10.0 * Eigen::Matrix3d::Identity();
  known.share = Eigen::VectorXd::Ones(1);
  const PositionCost<KeyframePlace> cost(KeyframePlace(), known, Eigen::Vector3d::Zero(), false, RobustLoss(3.0, true));
  const std::vector<double> residuals = Evaluate(cost, {{0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0}}).residuals;
  EXPECT_NEAR(Eigen::Map<const Eigen::Vector3d>(residuals.data()).norm(), 3.0, 1e-5);
}

TEST(PositionCost, AnswerIsFiniteAtTheKnownPosition) {
  KnownPositions known;
  known.position = Eigen::Vector3d::Zero();
  known.whitening = Eigen::Matrix3d::Identity();
  known.share = Eigen::VectorXd::Ones(1);
  const PositionCost<KeyframePlace> cost(KeyframePlace(), known, Eigen::Vector3d::Zero(), false, RobustLoss(3.0, true));
  const Evaluation evaluation = Evaluate(cost, {{0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0}});
  ExpectAllFinite(evaluation);
  EXPECT_EQ(evaluation.residuals, std::vector<double>(3, 0.0));
}

TEST(PositionCost, AnyJacobianMayBeLeftOut) {
  Random random(4);
  const PositionCost<InterpolatedPlace> cost(RandomPlace(random, 2), RandomPositions(random, 2, 5.0), std::nullopt,
                                             true, RobustLoss(4.0, true));
  ExpectAnyJacobianMayBeLeftOut(cost,
                                {RandomPose(random, 5.0), RandomPose(random, 5.0), ToBlock(random.Vector(0.5)), {0.1}});
}

}  // namespace
}  // namespace rangesfm
