#include <ceres/autodiff_cost_function.h>
#include <ceres/problem.h>
#include <ceres/solver.h>
#include <gtest/gtest.h>

#include <array>
#include <cmath>
#include <vector>

#include "rangesfm/elimination_order.h"

namespace rangesfm {
namespace {

using Vector = std::vector<double>;

TEST(PaddedManifold, AddsTheFirstPartOfAStepAndNothingElse) {
  const PaddedManifold manifold(2, 5);
  EXPECT_EQ(manifold.AmbientSize(), 2);
  EXPECT_EQ(manifold.TangentSize(), 5);
  const Vector x = {1.0, 2.0};
  const Vector step = {0.5, -0.25, 7.0, 8.0, 9.0};
  Vector moved(2);
  EXPECT_TRUE(manifold.Plus(x.data(), step.data(), moved.data()));
  EXPECT_EQ(moved, Vector({1.5, 1.75}));
}

TEST(PaddedManifold, HasDerivativesThatAreZeroInThePadding) {
  const PaddedManifold manifold(2, 3);
  Vector jacobian(6, -1.0);
  EXPECT_TRUE(manifold.PlusJacobian(nullptr, jacobian.data()));
  EXPECT_EQ(jacobian, Vector({1, 0, 0, 0, 1, 0}));
  const Vector ambient = {1, 2, 3, 4};
  Vector tangent(6, -1.0);
  EXPECT_TRUE(manifold.RightMultiplyByPlusJacobian(nullptr, 2, ambient.data(), tangent.data()));
  EXPECT_EQ(tangent, Vector({1, 2, 0, 3, 4, 0}));
}

TEST(PaddedManifold, SubtractsWithoutAStepInThePadding) {
  const PaddedManifold manifold(2, 3);
  const Vector x = {1.0, 2.0};
  const Vector y = {4.0, 1.0};
  Vector difference(3, -1.0);
  EXPECT_TRUE(manifold.Minus(y.data(), x.data(), difference.data()));
  EXPECT_EQ(difference, Vector({3, -1, 0}));
  Vector jacobian(6, -1.0);
  EXPECT_TRUE(manifold.MinusJacobian(x.data(), jacobian.data()));
  EXPECT_EQ(jacobian, Vector({1, 0, 0, 1, 0, 0}));
}

struct SquareRootOfTwo {
  template <typename T>
  bool operator()(const T* x, T* residual) const {
    residual[0] = x[0] * x[0] - 2.0;
    residual[1] = x[1] - x[0];
    return true;
  }
};

TEST(PaddedManifold, LeavesASolutionWhereItIs) {
  for (const ceres::LinearSolverType type : {ceres::DENSE_NORMAL_CHOLESKY, ceres::DENSE_QR}) {
    std::array<double, 2> x = {1.0, 5.0};
    ceres::Problem problem;
    problem.AddResidualBlock(new ceres::AutoDiffCostFunction<SquareRootOfTwo, 2, 2>(new SquareRootOfTwo), nullptr,
                             x.data());
    problem.SetManifold(x.data(), new PaddedManifold(2, 6));
    ceres::Solver::Options options;
    options.linear_solver_type = type;
    options.initial_trust_region_radius = 1e16;
    options.function_tolerance = options.gradient_tolerance = options.parameter_tolerance = 1e-15;
    ceres::Solver::Summary summary;
    ceres::Solve(options, &problem, &summary);
    EXPECT_EQ(summary.termination_type, ceres::CONVERGENCE);
    EXPECT_NEAR(x[0], std::sqrt(2.0), 1e-9);
    EXPECT_NEAR(x[1], std::sqrt(2.0), 1e-9);
  }
}

}  // namespace
}  // namespace rangesfm
