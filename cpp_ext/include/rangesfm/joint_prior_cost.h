#pragma once

#include <ceres/cost_function.h>

#include <Eigen/Core>
#include <utility>

namespace rangesfm {

// Errors of correlated numbers relative to their prior, of m blocks of one size. The formula is in the docstring of
// joint_prior_cost (src/bindings.cc). All numbers of the first block come first in mean and whitening, which need not
// be square.
class JointPriorCost final : public ceres::CostFunction {
 public:
  JointPriorCost(int block_size, Eigen::VectorXd mean, Eigen::MatrixXd whitening)
      : block_size_(block_size), mean_(std::move(mean)), whitening_(std::move(whitening)) {
    set_num_residuals(static_cast<int>(whitening_.rows()));
    mutable_parameter_block_sizes()->assign(static_cast<std::size_t>(mean_.size() / block_size), block_size);
  }

  bool Evaluate(double const* const* parameters, double* residuals, double** jacobians) const override {
    const Eigen::Index num_blocks = mean_.size() / block_size_;
    Eigen::VectorXd off = -mean_;
    for (Eigen::Index i = 0; i < num_blocks; ++i) {
      off.segment(i * block_size_, block_size_) += Eigen::Map<const Eigen::VectorXd>(parameters[i], block_size_);
    }
    Eigen::Map<Eigen::VectorXd>(residuals, whitening_.rows()) = whitening_ * off;
    for (Eigen::Index i = 0; jacobians != nullptr && i < num_blocks; ++i) {
      if (jacobians[i] != nullptr) {
        using RowMajor = Eigen::Matrix<double, Eigen::Dynamic, Eigen::Dynamic, Eigen::RowMajor>;
        Eigen::Map<RowMajor>(jacobians[i], whitening_.rows(), block_size_) =
            whitening_.middleCols(i * block_size_, block_size_);
      }
    }
    return true;
  }

 private:
  const Eigen::Index block_size_;
  const Eigen::VectorXd mean_;
  const Eigen::MatrixXd whitening_;
};

}  // namespace rangesfm
