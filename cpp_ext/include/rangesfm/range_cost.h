#ifndef RANGESFM_RANGE_COST_H_
#define RANGESFM_RANGE_COST_H_

#include <ceres/sized_cost_function.h>

#include <Eigen/Core>

#include "rangesfm/range_geometry.h"

namespace rangesfm {

// 1-DoF error of a range measured at a keyframe, in stddevs:
//
//   (|| R^T (tag_in_cam - t) - anchor_in_world || + bias - range) / stddev
//
// Blocks: rig_from_world (7: qx qy qz qw tx ty tz), anchor_in_world (3), range bias (1: what the radio reads too
// long). Metres throughout. Needs the model to be metric already, or close to it.
class RangeCost final : public ceres::SizedCostFunction<1, 7, 3, 1> {
 public:
  RangeCost(double range, const Eigen::Vector3d& tag_in_cam, double stddev)
      : range_(range), tag_in_cam_(tag_in_cam), inv_stddev_(1.0 / stddev) {}

  bool Evaluate(double const* const* parameters, double* residuals, double** jacobians) const override {
    const TagPosition tag(parameters[0], tag_in_cam_);
    const AnchorToTag anchor_to_tag(tag.InWorld(), parameters[1]);
    const double bias = *parameters[2];
    residuals[0] = (anchor_to_tag.Distance() + bias - range_) * inv_stddev_;
    if (jacobians == nullptr) {
      return true;
    }
    const Eigen::Vector3d direction = anchor_to_tag.Direction() * inv_stddev_;
    if (jacobians[0] != nullptr) {
      Eigen::Map<PoseGradient>{jacobians[0]} = tag.Gradient(direction);
    }
    if (jacobians[1] != nullptr) {
      Eigen::Map<Eigen::Vector3d>{jacobians[1]} = -direction;
    }
    if (jacobians[2] != nullptr) {
      jacobians[2][0] = inv_stddev_;
    }
    return true;
  }

 private:
  const double range_;
  const Eigen::Vector3d tag_in_cam_;
  const double inv_stddev_;
};

}  // namespace rangesfm

#endif  // RANGESFM_RANGE_COST_H_
