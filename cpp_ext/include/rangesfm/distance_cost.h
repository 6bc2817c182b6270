#pragma once

#include <ceres/cost_function.h>

#include <Eigen/Core>

#include "rangesfm/range_geometry.h"
#include "rangesfm/robust_loss.h"

namespace rangesfm {

// An end of a distance that is itself a parameter block, such as a 3-D point or an anchor.
class PointEnd {
 public:
  static constexpr int kBlockSize = 3;

  class Now {
   public:
    Now(const PointEnd& /*end*/, const double* block) : in_world_(block) {}

    Eigen::Vector3d InWorld() const { return in_world_; }
    static Eigen::RowVector3d Gradient(const Eigen::Vector3d& direction) { return direction.transpose(); }

   private:
    Eigen::Map<const Eigen::Vector3d> in_world_;
  };
};

// An end that is fixed to a camera (in its rig frame), whose pose is the parameter block.
class CamEnd {
 public:
  static constexpr int kBlockSize = 7;

  explicit CamEnd(const Eigen::Vector3d& end_in_cam) : end_in_cam_(end_in_cam) {}

  class Now {
   public:
    Now(const CamEnd& end, const double* block) : position_(block, end.end_in_cam_) {}

    const Eigen::Vector3d& InWorld() const { return position_.InWorld(); }
    PoseGradient Gradient(const Eigen::Vector3d& direction) const { return position_.Gradient(direction); }

   private:
    TagPosition position_;
  };

 private:
  Eigen::Vector3d end_in_cam_;
};

// Robust error of a distance measured by tape or by radio, in standard deviations. The formula and the blocks are in
// the docstring of distance_cost (src/bindings.cc). Metres throughout.
template <typename EndA, typename EndB>
class DistanceCost final : public ceres::CostFunction {
 public:
  DistanceCost(double distance, const EndA& a, const EndB& b, double stddev, bool has_bias,
               RobustLoss loss = RobustLoss())
      : distance_(distance), a_(a), b_(b), inv_stddev_(1.0 / stddev), has_bias_(has_bias), loss_(loss) {
    set_num_residuals(1);
    *mutable_parameter_block_sizes() = {EndA::kBlockSize, EndB::kBlockSize};
    if (has_bias_) {
      mutable_parameter_block_sizes()->push_back(1);
    }
  }

  bool Evaluate(double const* const* parameters, double* residuals, double** jacobians) const override {
    const typename EndA::Now a(a_, parameters[0]);
    const typename EndB::Now b(b_, parameters[1]);
    const Eigen::Vector3d& b_in_world = b.InWorld();
    const AnchorToTag b_to_a(a.InWorld(), b_in_world.data());
    const double bias = has_bias_ ? *parameters[2] : 0.0;
    const RobustLoss::Robust robust = loss_((b_to_a.Distance() + bias - distance_) * inv_stddev_);
    residuals[0] = robust.value;
    if (jacobians == nullptr) {
      return true;
    }
    const double slope = robust.slope * inv_stddev_;
    const Eigen::Vector3d direction = b_to_a.Direction() * slope;
    if (jacobians[0] != nullptr) {
      Eigen::Map<Eigen::Matrix<double, 1, EndA::kBlockSize>>{jacobians[0]} = a.Gradient(direction);
    }
    if (jacobians[1] != nullptr) {
      Eigen::Map<Eigen::Matrix<double, 1, EndB::kBlockSize>>{jacobians[1]} = b.Gradient(-direction);
    }
    if (has_bias_ && jacobians[2] != nullptr) {
      jacobians[2][0] = slope;
    }
    return true;
  }

 private:
  const double distance_;
  const EndA a_;
  const EndB b_;
  const double inv_stddev_;
  const bool has_bias_;
  const RobustLoss loss_;
};

}  // namespace rangesfm
