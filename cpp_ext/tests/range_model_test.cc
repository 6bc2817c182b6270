// Tests of the range costs with all optional parameters estimated, and with many ranges in one residual block.

#include <gtest/gtest.h>

#include <Eigen/Core>
#include <cmath>
#include <utility>
#include <vector>

#include "cost_testing.h"
#include "range_costs.h"
#include "rangesfm/range_cost.h"
#include "rangesfm/robust_loss.h"
#include "rangesfm/tag_place.h"

namespace rangesfm {
namespace {

Eigen::VectorXd Uniform(Random& random, int size, double min, double max) {
  return Eigen::VectorXd::NullaryExpr(size, [&] { return random.Uniform(min, max); });
}

Eigen::Matrix3Xd Vectors(Random& random, int size, double stddev) {
  Eigen::Matrix3Xd columns(3, size);
  for (int i = 0; i < size; ++i) {
    columns.col(i) = random.Vector(stddev);
  }
  return columns;
}

MeasuredRanges Measured(Random& random, int size, double max_range) {
  return {Uniform(random, size, 0.1, max_range), Uniform(random, size, 0.05, 1.0), Uniform(random, size, 0.2, 2.0),
          Eigen::MatrixXd(size, 0)};
}

InterpolatedPlace Between(Random& random, int size, double interval) {
  return {Uniform(random, size, 0.0, 1.0), Vectors(random, size, 0.3), interval};
}

// A model in which all optional parameters are estimated.
RangeModel FullModel(double short_range_length, RobustLoss loss) {
  RangeModel model;
  model.has_time_shift = true;
  model.short_range_length = short_range_length;
  model.loss = loss;
  return model;
}

// Parameter blocks: two poses, anchor, bias, lever arm, time shift and amplitude.
std::vector<Block> FullBlocks(Random& random, double extent) {
  return {PoseBlock(random.Rotation(), random.Vector(extent)),
          PoseBlock(random.Rotation(), random.Vector(extent)),
          ToBlock(random.Vector(extent)),
          {random.Uniform(-0.5, 0.5)},
          ToBlock(random.Vector(0.3)),
          {random.Uniform(-0.2, 0.2)},
          {random.Uniform(-0.5, 0.5)}};
}

TEST(RangeModel, PredictionIsTheHandComputedOne) {
  // The camera moves from (0, 2, 0) to (4, 2, 0) in 2 s. With weight 0, half a second later and an offset of 0.6 m in
  // z, it is at (1, 2, 0.6). The lever arm of 1 m along x puts the tag at (2, 2, 0.6), 5 m from the anchor. With a bias
  // of 0.3 m and a short-range error of 0.3 m that decays over 5 m, the predicted range is 5.3 + 0.3/e. The measured
  // range is 5 m, with a standard deviation of 0.1 m.
  InterpolatedPlace place(Eigen::VectorXd::Zero(1), Eigen::Vector3d(0.0, 0.0, 0.6), 2.0);
  const RangeCost<InterpolatedPlace> cost(std::move(place), OneRange(5.0, 0.1), FullModel(5.0, RobustLoss()));
  const std::vector<Block> blocks = {{0.0, 0.0, 0.0, 1.0, 0.0, -2.0, 0.0},
                                     {0.0, 0.0, 0.0, 1.0, -4.0, -2.0, 0.0},
                                     {5.0, 6.0, 0.6},
                                     {0.3},
                                     {1.0, 0.0, 0.0},
                                     {0.5},
                                     {0.3}};
  EXPECT_NEAR(Evaluate(cost, blocks).residuals[0], (0.3 + 0.3 / std::exp(1.0)) / 0.1, 1e-12);
}

// Vanishing terms are left out, that is, a short-range error far away and an outlier far beyond a bounded loss. Their
// derivatives are smaller than rounding errors.
TEST(RangeModel, GradientsAreRightForEverythingFreeBetweenKeyframes) {
  Random random(1);
  for (int i = 0; i < 40; ++i) {
    const bool is_bounded = i % 2 == 0;
    const double min_loss_scale = is_bounded ? 20.0 : 1.0;
    const RobustLoss loss(i % 3 == 0 ? kInfinity : random.Uniform(min_loss_scale, 100.0), is_bounded);
    const RangeCost<InterpolatedPlace> cost(Between(random, 5, random.Uniform(0.1, 3.0)), Measured(random, 5, 20.0),
                                            FullModel(random.Uniform(10.0, 50.0), loss));
    ExpectGradientsAreRight(cost, FullBlocks(random, 10.0), 1e-7);
  }
}

TEST(RangeModel, GradientsAreRightForEverythingFreeAtAKeyframe) {
  Random random(2);
  for (int i = 0; i < 20; ++i) {
    RangeModel model = FullModel(20.0, RobustLoss(5.0, false));
    model.has_time_shift = false;
    const RangeCost<KeyframePlace> cost(KeyframePlace(), Measured(random, 4, 20.0), std::move(model));
    ExpectGradientsAreRight(cost,
                            {PoseBlock(random.Rotation(), random.Vector(10.0)),
                             ToBlock(random.Vector(10.0)),
                             {0.1},
                             ToBlock(random.Vector(0.5)),
                             {0.2}},
                            1e-7);
  }
}

TEST(RangeModel, GradientsAreRightFarBeyondTheKeyframesInTime) {
  Random random(3);
  std::vector<Block> blocks = FullBlocks(random, 5.0);
  blocks[5] = {30.0};
  const RangeCost<InterpolatedPlace> cost(Between(random, 3, 0.5), Measured(random, 3, 20.0),
                                          FullModel(1e3, RobustLoss()));
  ExpectGradientsAreRight(cost, blocks, 1e-7);
}

TEST(RangeModel, AnswerIsFiniteForAnOutlierOfAMillionStddevs) {
  Random random(4);
  const std::vector<Block> blocks = FullBlocks(random, 5.0);
  const RangeCost<InterpolatedPlace> cost(Between(random, 1, 0.5), OneRange(1e6, 1e-3),
                                          FullModel(20.0, RobustLoss(2.0, false)));
  const Evaluation evaluation = Evaluate(cost, blocks);
  ExpectAllFinite(evaluation);
  EXPECT_NEAR(evaluation.residuals[0], -2.0 * std::sqrt(std::log1p(std::pow(1e9 / 2.0, 2))), 1e-3);
}

TEST(RangeModel, AnswerIsFiniteWithTheTagOnTheAnchor) {
  RangeModel model = WithLeverArm(Eigen::Vector3d::Zero());
  model.short_range_length = 1.0;
  model.loss = RobustLoss(2.0, false);
  const RangeCost<KeyframePlace> cost(KeyframePlace(), OneRange(1.0, 1.0), std::move(model));
  const Evaluation evaluation = Evaluate(cost, {{0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0}, {0.0, 0.0, 0.0}, {0.0}, {1.0}});
  ExpectAllFinite(evaluation);
  EXPECT_EQ(evaluation.residuals[0], 0.0);
}

TEST(RangeModel, ManyRangesAreAsManyCostsOfOne) {
  Random random(5);
  constexpr int kNumRanges = 6;
  const Eigen::VectorXd weight = Uniform(random, kNumRanges, 0.0, 1.0);
  const Eigen::Matrix3Xd offset = Vectors(random, kNumRanges, 0.3);
  const MeasuredRanges measured = Measured(random, kNumRanges, 10.0);
  const RangeModel model = FullModel(20.0, RobustLoss(3.0, false));
  const std::vector<Block> blocks = FullBlocks(random, 5.0);
  const Evaluation many =
      Evaluate(RangeCost<InterpolatedPlace>(InterpolatedPlace(weight, offset, 0.7), measured, model), blocks);
  for (int i = 0; i < kNumRanges; ++i) {
    const RangeCost<InterpolatedPlace> cost(InterpolatedPlace(weight.segment(i, 1), offset.col(i), 0.7),
                                            MeasuredRanges{measured.range.segment(i, 1), measured.stddev.segment(i, 1),
                                                           measured.share.segment(i, 1), Eigen::MatrixXd(1, 0)},
                                            model);
    const Evaluation one = Evaluate(cost, blocks);
    EXPECT_EQ(many.residuals[i], one.residuals[0]);
    for (size_t block = 0; block < blocks.size(); ++block) {
      const auto row = many.jacobians[block].begin() + static_cast<std::ptrdiff_t>(i * blocks[block].size());
      EXPECT_EQ(std::vector<double>(row, row + static_cast<std::ptrdiff_t>(blocks[block].size())),
                one.jacobians[block]);
    }
  }
}

TEST(RangeModel, AShareMultipliesTheLossOfItsRange) {
  RangeModel model = WithLeverArm(Eigen::Vector3d::Zero());
  model.loss = RobustLoss(3.0, true);
  const std::vector<Block> blocks = {{0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0}, {3.0, 4.0, 0.0}, {0.0}};
  MeasuredRanges measured = OneRange(4.6, 0.1);
  const double whole = Evaluate(RangeCost<KeyframePlace>(KeyframePlace(), measured, model), blocks).residuals[0];
  EXPECT_NEAR(whole, 4.0 / std::sqrt(1.0 + 16.0 / 9.0), 1e-9);
  measured.share[0] = 0.25;
  const double part = Evaluate(RangeCost<KeyframePlace>(KeyframePlace(), measured, model), blocks).residuals[0];
  EXPECT_DOUBLE_EQ(part * part, 0.25 * whole * whole);
}

TEST(RangeModel, SharedNumbersChangeEachRangeByItsLoadings) {
  Random random(7);
  constexpr int kNumRanges = 4;
  MeasuredRanges measured = Measured(random, kNumRanges, 10.0);
  const RangeModel model = FullModel(20.0, RobustLoss(3.0, false));
  const InterpolatedPlace place = Between(random, kNumRanges, 0.7);
  std::vector<Block> blocks = FullBlocks(random, 5.0);
  MeasuredRanges shorter = measured;
  measured.loadings = Eigen::MatrixXd(kNumRanges, 8);
  const Eigen::VectorXd shared = Uniform(random, 8, -0.3, 0.3);
  for (int k = 0; k < measured.loadings.cols(); ++k) {
    measured.loadings.col(k) = Uniform(random, kNumRanges, -0.1, 0.1);
  }
  shorter.range -= measured.loadings * shared;
  const Evaluation expected = Evaluate(RangeCost<InterpolatedPlace>(place, shorter, model), blocks);
  blocks.emplace_back(shared.begin(), shared.begin() + 6);
  blocks.emplace_back(shared.begin() + 6, shared.end());
  const RangeCost<InterpolatedPlace> cost(place, measured, model);
  const Evaluation found = Evaluate(cost, blocks);
  for (int i = 0; i < kNumRanges; ++i) {
    EXPECT_NEAR(found.residuals[i], expected.residuals[i], 1e-12);
  }
  ExpectGradientsAreRight(cost, blocks, 1e-7);
}

TEST(RangeModel, AFreeLeverArmIsTheConstantOneWithAGradient) {
  Random random(6);
  const Eigen::Vector3d tag_in_cam = random.Vector(0.3);
  const std::vector<Block> blocks = {
      PoseBlock(random.Rotation(), random.Vector(5.0)), ToBlock(random.Vector(5.0)), {0.1}};
  const RangeCost<KeyframePlace> cost(KeyframePlace(), OneRange(3.0, 0.1), RangeModel());
  const Evaluation found = Evaluate(cost, {blocks[0], blocks[1], blocks[2], ToBlock(tag_in_cam)});
  const Evaluation expected = Evaluate(AtKeyframe(3.0, tag_in_cam, 0.1), blocks);
  EXPECT_EQ(found.residuals, expected.residuals);
  EXPECT_EQ(found.jacobians[0], expected.jacobians[0]);
}

TEST(RangeModel, AnyJacobianMayBeLeftOut) {
  Random random(7);
  const RangeCost<InterpolatedPlace> cost(Between(random, 4, 0.5), Measured(random, 4, 10.0),
                                          FullModel(20.0, RobustLoss(2.0, false)));
  ExpectAnyJacobianMayBeLeftOut(cost, FullBlocks(random, 5.0));
}

}  // namespace
}  // namespace rangesfm
