#pragma once

#include <ceres/cost_function.h>

#include <Eigen/Core>
#include <utility>

namespace rangesfm {

// Error of n correlated numbers relative to their prior. The formula is in the docstring of joint_prior_cost
// (src/bindings.cc).
class JointPriorCost final : public ceres::CostFunction {
 public:
  JointPriorCost(Eigen::VectorXd mean, Eigen::MatrixXd whitening)
      : mean_(std::move(mean)), whitening_(std::move(whitening)) {
    set_num_residuals(static_cast<int>(mean_.size()));
    mutable_parameter_block_sizes()->assign(static_cast<std::size_t>(mean_.size()), 1);
  }

  bool Evaluate(double const* const* parameters, double* residuals, double** jacobians) const override {
    const Eigen::Index size = mean_.size();
    Eigen::VectorXd off(size);
    for (Eigen::Index i = 0; i < size; ++i) {
      off[i] = *parameters[i] - mean_[i];
    }
    Eigen::Map<Eigen::VectorXd>(residuals, size) = whitening_ * off;
    for (Eigen::Index i = 0; jacobians != nullptr && i < size; ++i) {
      if (jacobians[i] != nullptr) {
        Eigen::Map<Eigen::VectorXd>(jacobians[i], size) = whitening_.col(i);
      }
    }
    return true;
  }

 private:
  const Eigen::VectorXd mean_;
  const Eigen::MatrixXd whitening_;
};

}  // namespace rangesfm
