#ifndef RANGESFM_PADDED_MANIFOLD_H_
#define RANGESFM_PADDED_MANIFOLD_H_

#include <ceres/manifold.h>

#include <Eigen/Core>

namespace rangesfm {

// Numbers that add up as usual, in a tangent space with further directions that move nothing: a block of k numbers that
// takes as many columns of the Jacobian as a pose, the last of them zero.
//
// Ceres' Schur eliminator has kernels for blocks of fixed size. All blocks that share a residual with an eliminated
// point must be of one size for them; poses have 6 columns, and one anchor (3) or bias (1) that is tied to a point to
// keep it from elimination (zero_tie_cost.h) would make them all be handled as of any size. Levenberg-Marquardt's
// damping has a floor (Solver::Options::min_lm_diagonal), so that directions that move nothing get a step of zero.
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

#endif  // RANGESFM_PADDED_MANIFOLD_H_
