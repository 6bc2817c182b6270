#pragma once

#include <ceres/cost_function.h>

#include <Eigen/Core>
#include <Eigen/Geometry>

namespace rangesfm {

// Error of a direction in the world that was measured in a camera's frame, in standard deviations. The formula and the
// block are in the docstring of direction_cost (src/bindings.cc). The three residuals have two degrees of freedom,
// because the residual along the direction is of second order in the angle. Both directions are unit vectors.
class DirectionCost final : public ceres::CostFunction {
 public:
  DirectionCost(const Eigen::Vector3d& direction_in_world, const Eigen::Vector3d& direction_in_cam, double stddev)
      : in_world_(direction_in_world), in_cam_(direction_in_cam), inv_stddev_(1.0 / stddev) {
    set_num_residuals(3);
    mutable_parameter_block_sizes()->push_back(7);
  }

  bool Evaluate(double const* const* parameters, double* residuals, double** jacobians) const override {
    const Eigen::Map<const Eigen::Quaterniond> cam_from_world(parameters[0]);
    Eigen::Map<Eigen::Vector3d>{residuals} = inv_stddev_ * (cam_from_world * in_world_ - in_cam_);
    if (jacobians != nullptr && jacobians[0] != nullptr) {
      Eigen::Map<Eigen::Matrix<double, 3, 7, Eigen::RowMajor>>{jacobians[0]} = inv_stddev_ * Jacobian(cam_from_world);
    }
    return true;
  }

 private:
  // Derivative of R v, which for a unit quaternion q = (u, w) is v + 2 w (u x v) + 2 u x (u x v).
  Eigen::Matrix<double, 3, 7> Jacobian(const Eigen::Quaterniond& q) const {
    const Eigen::Vector3d u = q.vec();
    const Eigen::Vector3d& v = in_world_;
    Eigen::Matrix<double, 3, 7> jacobian = Eigen::Matrix<double, 3, 7>::Zero();
    for (int axis = 0; axis < 3; ++axis) {
      const Eigen::Vector3d along = Eigen::Vector3d::Unit(axis);
      jacobian.col(axis) = 2.0 * (q.w() * along.cross(v) + u.dot(v) * along + v[axis] * u - 2.0 * u[axis] * v);
    }
    jacobian.col(3) = 2.0 * u.cross(v);
    return jacobian;
  }

  const Eigen::Vector3d in_world_;
  const Eigen::Vector3d in_cam_;
  const double inv_stddev_;
};

}  // namespace rangesfm
