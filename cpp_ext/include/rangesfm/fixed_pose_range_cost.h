#ifndef RANGESFM_FIXED_POSE_RANGE_COST_H_
#define RANGESFM_FIXED_POSE_RANGE_COST_H_

#include <ceres/sized_cost_function.h>

#include <Eigen/Core>

#include "rangesfm/range_geometry.h"

namespace rangesfm {

// 1-DoF error of a range measured from a known place, in stddevs:
//
//   (|| tag_in_world - anchor_in_world || + bias - range) / stddev
//
// Blocks: anchor_in_world (3), range bias (1: what the radio reads too long). Metres throughout. For a keyframe whose
// pose is held, where a pose block would be one too many, and for finding an anchor from a known path.
class FixedPoseRangeCost final : public ceres::SizedCostFunction<1, 3, 1> {
 public:
  FixedPoseRangeCost(double range, const Eigen::Vector3d& tag_in_world, double stddev)
      : range_(range), tag_in_world_(tag_in_world), inv_stddev_(1.0 / stddev) {}

  bool Evaluate(double const* const* parameters, double* residuals, double** jacobians) const override {
    const AnchorToTag anchor_to_tag(tag_in_world_, parameters[0]);
    const double bias = *parameters[1];
    residuals[0] = (anchor_to_tag.Distance() + bias - range_) * inv_stddev_;
    if (jacobians == nullptr) {
      return true;
    }
    if (jacobians[0] != nullptr) {
      Eigen::Map<Eigen::Vector3d>{jacobians[0]} = -anchor_to_tag.Direction() * inv_stddev_;
    }
    if (jacobians[1] != nullptr) {
      jacobians[1][0] = inv_stddev_;
    }
    return true;
  }

 private:
  const double range_;
  const Eigen::Vector3d tag_in_world_;
  const double inv_stddev_;
};

}  // namespace rangesfm

#endif  // RANGESFM_FIXED_POSE_RANGE_COST_H_
