#pragma once

#include <ceres/cost_function.h>

#include <Eigen/Core>
#include <algorithm>
#include <cmath>
#include <optional>
#include <utility>
#include <vector>

#include "rangesfm/range_geometry.h"
#include "rangesfm/robust_loss.h"
#include "rangesfm/tag_place.h"

namespace rangesfm {

// n measured ranges.
struct MeasuredRanges {
  Eigen::VectorXd range;
  Eigen::VectorXd stddev;    // unit of the robust loss
  Eigen::VectorXd share;     // factor of the robust loss
  Eigen::MatrixXd loadings;  // n x k: change by each of k numbers that all ranges share
};

// Model of a range between two antennas, and which of its parameters are estimated.
struct RangeModel {
  std::optional<Eigen::Vector3d> tag_in_cam;  // without a value it is a parameter block
  bool has_time_shift = false;                // whether it is a parameter block; only with InterpolatedPlace
  std::optional<double> short_range_length;   // with a value, the short-range error's amplitude is a parameter block
  RobustLoss loss;
};

// Errors of n ranges between the tag at one place and one anchor, in standard deviations, each robust and times the
// root of its share. The formula, the blocks and their order are in the docstring of range_cost (src/bindings.cc).
// Metres and seconds throughout. The scale of the model must be metric, at least approximately.
template <typename Place>
class RangeCost final : public ceres::CostFunction {
 public:
  RangeCost(Place place, MeasuredRanges measured, RangeModel model)
      : place_(std::move(place)),
        range_(std::move(measured.range)),
        inv_stddev_(measured.stddev.cwiseInverse()),
        root_share_(measured.share.cwiseSqrt()),
        loadings_(std::move(measured.loadings)),
        model_(std::move(model)),
        inv_short_range_length_(model_.short_range_length ? 1.0 / *model_.short_range_length : 0.0) {
    set_num_residuals(static_cast<int>(range_.size()));
    for (int pose = 0; pose < Place::kNumPoses; ++pose) {
      AddBlock(true, kPoseSize);
    }
    anchor_ = AddBlock(true, 3);
    bias_ = AddBlock(true, 1);
    lever_arm_ = AddBlock(!model_.tag_in_cam.has_value(), 3);
    time_shift_ = AddBlock(model_.has_time_shift, 1);
    amplitude_ = AddBlock(model_.short_range_length.has_value(), 1);
    for (Eigen::Index first = 0; first < loadings_.cols(); first += kNumSharedInBlock) {
      shared_.push_back(AddBlock(true, static_cast<int>(std::min(kNumSharedInBlock, loadings_.cols() - first))));
    }
  }

  bool Evaluate(double const* const* parameters, double* residuals, double** jacobians) const override {
    const typename Place::Now place(place_, parameters, Motion(parameters));
    const double bias = *parameters[bias_];
    const double amplitude = Number(parameters, amplitude_);
    for (int i = 0; i < num_residuals(); ++i) {
      const AnchorToTag anchor_to_tag(place.TagInWorld(i), parameters[anchor_]);
      const double distance = anchor_to_tag.Distance();
      const double fading = std::exp(-distance * inv_short_range_length_);
      const double predicted = distance + bias + amplitude * fading + SharedError(i, parameters);
      const RobustLoss::Robust robust = model_.loss((predicted - range_[i]) * inv_stddev_[i]);
      residuals[i] = root_share_[i] * robust.value;
      if (jacobians != nullptr) {
        const double of_range = root_share_[i] * robust.slope * inv_stddev_[i];
        const double of_distance = of_range * (1.0 - amplitude * fading * inv_short_range_length_);
        WriteGeometry(i, place, of_distance * anchor_to_tag.Direction(), jacobians);
        WriteNumber(i, bias_, of_range, jacobians);
        WriteNumber(i, amplitude_, of_range * fading, jacobians);
        WriteShared(i, of_range, jacobians);
      }
    }
    return true;
  }

 private:
  static constexpr int kPoseSize = 7;
  static constexpr int kNone = -1;
  static constexpr Eigen::Index kNumSharedInBlock = 6;  // as many columns as a pose has

  int AddBlock(bool is_there, int size) {
    if (!is_there) {
      return kNone;
    }
    mutable_parameter_block_sizes()->push_back(size);
    return static_cast<int>(parameter_block_sizes().size()) - 1;
  }

  static double Number(double const* const* parameters, int block) { return block == kNone ? 0.0 : *parameters[block]; }

  // Returns the loadings of one range by the numbers of one block.
  auto SharedLoadings(int range, size_t block) const {
    const Eigen::Index first = static_cast<Eigen::Index>(block) * kNumSharedInBlock;
    return loadings_.row(range).segment(first, std::min(kNumSharedInBlock, loadings_.cols() - first));
  }

  double SharedError(int range, double const* const* parameters) const {
    double sum = 0.0;
    for (size_t block = 0; block < shared_.size(); ++block) {
      const auto loadings = SharedLoadings(range, block);
      sum += loadings.dot(Eigen::Map<const Eigen::RowVectorXd>(parameters[shared_[block]], loadings.size()));
    }
    return sum;
  }

  TagMotion Motion(double const* const* parameters) const {
    return {model_.tag_in_cam ? *model_.tag_in_cam : Eigen::Vector3d(parameters[lever_arm_]),
            Number(parameters, time_shift_)};
  }

  // Returns where to write the derivatives of one range with respect to a block, or null if they are not needed.
  double* Row(int range, int block, double** jacobians) const {
    if (block == kNone || jacobians[block] == nullptr) {
      return nullptr;
    }
    return jacobians[block] + range * parameter_block_sizes()[block];
  }

  void WriteGeometry(int range, const typename Place::Now& place, const Eigen::Vector3d& direction,
                     double** jacobians) const {
    for (int pose = 0; pose < Place::kNumPoses; ++pose) {
      if (double* const row = Row(range, pose, jacobians)) {
        Eigen::Map<PoseGradient>{row} = place.OfPose(pose, range, direction);
      }
    }
    if (double* const row = Row(range, anchor_, jacobians)) {
      Eigen::Map<Eigen::Vector3d>{row} = -direction;
    }
    if (double* const row = Row(range, lever_arm_, jacobians)) {
      Eigen::Map<Eigen::Vector3d>{row} = place.OfLeverArm(range, direction);
    }
    if (double* const row = Row(range, time_shift_, jacobians)) {
      *row = place.OfTimeShift(direction);
    }
  }

  void WriteNumber(int range, int block, double value, double** jacobians) const {
    if (double* const row = Row(range, block, jacobians)) {
      *row = value;
    }
  }

  void WriteShared(int range, double of_range, double** jacobians) const {
    for (size_t block = 0; block < shared_.size(); ++block) {
      if (double* const row = Row(range, shared_[block], jacobians)) {
        const auto loadings = SharedLoadings(range, block);
        Eigen::Map<Eigen::RowVectorXd>(row, loadings.size()) = of_range * loadings;
      }
    }
  }

  const Place place_;
  const Eigen::VectorXd range_;
  const Eigen::VectorXd inv_stddev_;
  const Eigen::VectorXd root_share_;
  const Eigen::MatrixXd loadings_;
  const RangeModel model_;
  const double inv_short_range_length_;
  int anchor_ = kNone;
  int bias_ = kNone;
  int lever_arm_ = kNone;
  int time_shift_ = kNone;
  int amplitude_ = kNone;
  std::vector<int> shared_;
};

}  // namespace rangesfm
