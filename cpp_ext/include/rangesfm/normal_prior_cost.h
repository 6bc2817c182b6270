#ifndef RANGESFM_NORMAL_PRIOR_COST_H_
#define RANGESFM_NORMAL_PRIOR_COST_H_

#include <ceres/cost_function.h>

#include <Eigen/Core>

namespace rangesfm {

// n-DoF error of what was known of a block beforehand, (x - mean) / stddev for each of its n numbers.
// Block: anything without a manifold, in the unit of mean and stddev (an anchor, a range bias, a lever arm).
class NormalPriorCost final : public ceres::CostFunction {
 public:
  NormalPriorCost(const Eigen::VectorXd& mean, const Eigen::VectorXd& stddev)
      : mean_(mean), inv_stddev_(stddev.cwiseInverse()) {
    set_num_residuals(static_cast<int>(mean.size()));
    mutable_parameter_block_sizes()->push_back(num_residuals());
  }

  bool Evaluate(double const* const* parameters, double* residuals, double** jacobians) const override {
    const Eigen::Index size = mean_.size();
    const Eigen::Map<const Eigen::VectorXd> x(parameters[0], size);
    Eigen::Map<Eigen::VectorXd>(residuals, size) = (x - mean_).cwiseProduct(inv_stddev_);
    if (jacobians != nullptr && jacobians[0] != nullptr) {
      Eigen::Map<Eigen::MatrixXd>(jacobians[0], size, size) = inv_stddev_.asDiagonal();
    }
    return true;
  }

 private:
  const Eigen::VectorXd mean_;
  const Eigen::VectorXd inv_stddev_;
};

}  // namespace rangesfm

#endif  // RANGESFM_NORMAL_PRIOR_COST_H_
