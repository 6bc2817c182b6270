#pragma once

#include <ceres/cost_function.h>

#include <Eigen/Core>
#include <cmath>
#include <optional>
#include <utility>

#include "rangesfm/robust_loss.h"
#include "rangesfm/tag_place.h"

namespace rangesfm {

// n known positions of one antenna.
struct KnownPositions {
  Eigen::Matrix3Xd position;
  Eigen::Matrix3Xd whitening;  // three columns for each position: a matrix W with W^T W the inverse of its covariance
  Eigen::VectorXd share;       // factor of the robust loss
};

// Errors of n known positions of the antenna at one place, in standard deviations: three residuals for each, whose
// length is robust, times the root of its share. The formula, the blocks and their order are in the docstring of
// position_cost (src/bindings.cc). Metres and seconds throughout.
template <typename Place>
class PositionCost final : public ceres::CostFunction {
 public:
  PositionCost(Place place, KnownPositions known, std::optional<Eigen::Vector3d> tag_in_cam, bool has_time_shift,
               RobustLoss loss = RobustLoss())
      : place_(std::move(place)),
        known_(std::move(known)),
        root_share_(known_.share.cwiseSqrt()),
        tag_in_cam_(std::move(tag_in_cam)),
        has_time_shift_(has_time_shift),
        loss_(loss) {
    set_num_residuals(3 * static_cast<int>(known_.position.cols()));
    for (int pose = 0; pose < Place::kNumPoses; ++pose) {
      mutable_parameter_block_sizes()->push_back(kPoseSize);
    }
    if (!tag_in_cam_) {
      mutable_parameter_block_sizes()->push_back(3);
    }
    if (has_time_shift_) {
      mutable_parameter_block_sizes()->push_back(1);
    }
  }

  bool Evaluate(double const* const* parameters, double* residuals, double** jacobians) const override {
    int block = Place::kNumPoses;
    const int lever_arm = tag_in_cam_ ? kNone : block++;
    const int time_shift = has_time_shift_ ? block : kNone;
    const TagMotion motion = {tag_in_cam_ ? *tag_in_cam_ : Eigen::Vector3d(parameters[lever_arm]),
                              has_time_shift_ ? *parameters[time_shift] : 0.0};
    const typename Place::Now place(place_, parameters, motion);
    for (int i = 0; i < known_.position.cols(); ++i) {
      const Eigen::Index first_row = 3 * static_cast<Eigen::Index>(i);
      const Eigen::Matrix3d whitening = known_.whitening.middleCols<3>(first_row);
      const Eigen::Vector3d off = whitening * (place.TagInWorld(i) - known_.position.col(i));
      const RobustLoss::OfVector scaled = loss_.ForLength(off.norm());
      Eigen::Map<Eigen::Vector3d>{residuals + first_row} = root_share_[i] * scaled.factor * off;
      if (jacobians == nullptr) {
        continue;
      }
      const Eigen::Matrix3d by_position =
          root_share_[i] * (scaled.factor * Eigen::Matrix3d::Identity() + scaled.along * off * off.transpose()) *
          whitening;
      for (int axis = 0; axis < 3; ++axis) {
        const Eigen::Vector3d direction = by_position.row(axis).transpose();
        const Eigen::Index row = first_row + axis;
        for (int pose = 0; pose < Place::kNumPoses; ++pose) {
          if (jacobians[pose] != nullptr) {
            Eigen::Map<PoseGradient>{jacobians[pose] + kPoseSize* row} = place.OfPose(pose, i, direction);
          }
        }
        if (lever_arm != kNone && jacobians[lever_arm] != nullptr) {
          Eigen::Map<Eigen::Vector3d>{jacobians[lever_arm] + 3 * row} = place.OfLeverArm(i, direction);
        }
        if (time_shift != kNone && jacobians[time_shift] != nullptr) {
          jacobians[time_shift][row] = place.OfTimeShift(direction);
        }
      }
    }
    return true;
  }

 private:
  static constexpr int kPoseSize = 7;
  static constexpr int kNone = -1;

  const Place place_;
  const KnownPositions known_;
  const Eigen::VectorXd root_share_;
  const std::optional<Eigen::Vector3d> tag_in_cam_;
  const bool has_time_shift_;
  const RobustLoss loss_;
};

}  // namespace rangesfm
