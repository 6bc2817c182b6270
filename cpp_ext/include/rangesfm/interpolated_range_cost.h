#ifndef RANGESFM_INTERPOLATED_RANGE_COST_H_
#define RANGESFM_INTERPOLATED_RANGE_COST_H_

#include <ceres/sized_cost_function.h>

#include <Eigen/Core>

#include "rangesfm/range_geometry.h"

namespace rangesfm {

// 1-DoF error of a range measured between two keyframes, in stddevs:
//
//   (|| (1 - weight) p_before + weight p_after + offset_in_world - anchor_in_world || + bias - range) / stddev,
//   p_i = R_i^T (tag_in_cam - t_i)
//
// The straight line between the tag's two places moves with both poses; the constant offset is what the path's
// curvature adds to it. Blocks: rig_from_world before and after (7 each: qx qy qz qw tx ty tz), anchor_in_world (3),
// range bias (1: what the radio reads too long). Metres throughout; weight in [0, 1].
class InterpolatedRangeCost final : public ceres::SizedCostFunction<1, 7, 7, 3, 1> {
 public:
  InterpolatedRangeCost(double range, const Eigen::Vector3d& tag_in_cam, double weight,
                        const Eigen::Vector3d& offset_in_world, double stddev)
      : range_(range),
        tag_in_cam_(tag_in_cam),
        weight_(weight),
        offset_in_world_(offset_in_world),
        inv_stddev_(1.0 / stddev) {}

  bool Evaluate(double const* const* parameters, double* residuals, double** jacobians) const override {
    const TagPosition before(parameters[0], tag_in_cam_);
    const TagPosition after(parameters[1], tag_in_cam_);
    const Eigen::Vector3d tag_in_world =
        (1.0 - weight_) * before.InWorld() + weight_ * after.InWorld() + offset_in_world_;
    const AnchorToTag anchor_to_tag(tag_in_world, parameters[2]);
    const double bias = *parameters[3];
    residuals[0] = (anchor_to_tag.Distance() + bias - range_) * inv_stddev_;
    if (jacobians == nullptr) {
      return true;
    }
    const Eigen::Vector3d direction = anchor_to_tag.Direction() * inv_stddev_;
    if (jacobians[0] != nullptr) {
      Eigen::Map<PoseGradient>{jacobians[0]} = before.Gradient((1.0 - weight_) * direction);
    }
    if (jacobians[1] != nullptr) {
      Eigen::Map<PoseGradient>{jacobians[1]} = after.Gradient(weight_ * direction);
    }
    if (jacobians[2] != nullptr) {
      Eigen::Map<Eigen::Vector3d>{jacobians[2]} = -direction;
    }
    if (jacobians[3] != nullptr) {
      jacobians[3][0] = inv_stddev_;
    }
    return true;
  }

 private:
  const double range_;
  const Eigen::Vector3d tag_in_cam_;
  const double weight_;
  const Eigen::Vector3d offset_in_world_;
  const double inv_stddev_;
};

}  // namespace rangesfm

#endif  // RANGESFM_INTERPOLATED_RANGE_COST_H_
