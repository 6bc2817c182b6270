// Tools that keep anchors and biases out of the elimination of the 3-D points, which stays as fast as without them.

#pragma once

#include <ceres/cost_function.h>
#include <ceres/manifold.h>

#include <Eigen/Core>
#include <algorithm>

namespace rangesfm {

// Two residuals that are always zero and only connect two parameter blocks. The reason why an anchor is connected to a
// point is given at keep_from_elimination in plugin/rangesfm/ceres/adjuster_problem.py. There are two residuals because
// a reprojection has two, and Ceres' specialised kernels need residual blocks of one size for all points.
//
// Blocks: any two, for example anchor_in_world (3) and a 3-D point (3).
class ZeroTieCost final : public ceres::CostFunction {
 public:
  ZeroTieCost(int size_a, int size_b) {
    set_num_residuals(kNumResiduals);
    *mutable_parameter_block_sizes() = {size_a, size_b};
  }

  bool Evaluate(double const* const* /*parameters*/, double* residuals, double** jacobians) const override {
    std::fill_n(residuals, kNumResiduals, 0.0);
    if (jacobians != nullptr) {
      for (int i = 0; i < 2; ++i) {
        if (jacobians[i] != nullptr) {
          std::fill_n(jacobians[i], kNumResiduals * parameter_block_sizes()[i], 0.0);
        }
      }
    }
    return true;
  }

 private:
  static constexpr int kNumResiduals = 2;
};

// Euclidean manifold of k numbers whose tangent space has additional directions that move nothing. A block of k numbers
// then has as many columns in the Jacobian as a pose, the last of them zero.
//
// All blocks that share a residual with an eliminated point are then of the poses' size, for which Ceres has
// specialised kernels. The damping of Levenberg-Marquardt has a lower bound (Solver::Options::min_lm_diagonal), so that
// the step in the additional directions is zero.
class PaddedManifold final : public ceres::Manifold {
 public:
  PaddedManifold(int ambient_size, int tangent_size) : ambient_size_(ambient_size), tangent_size_(tangent_size) {}

  [[nodiscard]] int AmbientSize() const override { return ambient_size_; }
  [[nodiscard]] int TangentSize() const override { return tangent_size_; }

  bool Plus(const double* x, const double* delta, double* x_plus_delta) const override {
    Ambient(x_plus_delta) = Ambient(x) + Ambient(delta);
    return true;
  }

  bool PlusJacobian(const double* /*x*/, double* jacobian) const override {
    Matrix(jacobian, ambient_size_, tangent_size_).setIdentity();
    return true;
  }

  bool RightMultiplyByPlusJacobian(const double* /*x*/, const int num_rows, const double* ambient_matrix,
                                   double* tangent_matrix) const override {
    Matrix tangent(tangent_matrix, num_rows, tangent_size_);
    tangent.setZero();
    tangent.leftCols(ambient_size_) = ConstMatrix(ambient_matrix, num_rows, ambient_size_);
    return true;
  }

  bool Minus(const double* y, const double* x, double* y_minus_x) const override {
    Eigen::Map<Eigen::VectorXd> difference(y_minus_x, tangent_size_);
    difference.setZero();
    difference.head(ambient_size_) = Ambient(y) - Ambient(x);
    return true;
  }

  bool MinusJacobian(const double* /*x*/, double* jacobian) const override {
    Matrix(jacobian, tangent_size_, ambient_size_).setIdentity();
    return true;
  }

 private:
  using RowMajor = Eigen::Matrix<double, Eigen::Dynamic, Eigen::Dynamic, Eigen::RowMajor>;
  using Matrix = Eigen::Map<RowMajor>;
  using ConstMatrix = Eigen::Map<const RowMajor>;

  [[nodiscard]] Eigen::Map<Eigen::VectorXd> Ambient(double* x) const { return {x, ambient_size_}; }
  [[nodiscard]] Eigen::Map<const Eigen::VectorXd> Ambient(const double* x) const { return {x, ambient_size_}; }

  int ambient_size_;
  int tangent_size_;
};

}  // namespace rangesfm
