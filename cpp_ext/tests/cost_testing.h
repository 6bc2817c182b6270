// Common parts of the cost tests: random poses, evaluation, and the gradient check on COLMAP's manifolds.

#pragma once

#include <ceres/cost_function.h>
#include <ceres/gradient_checker.h>
#include <ceres/manifold.h>
#include <ceres/product_manifold.h>
#include <gtest/gtest.h>

#include <Eigen/Core>
#include <Eigen/Geometry>
#include <algorithm>
#include <cmath>
#include <cstddef>
#include <limits>
#include <random>
#include <vector>

namespace rangesfm {

constexpr double kInfinity = std::numeric_limits<double>::infinity();

using Block = std::vector<double>;

// COLMAP's parametrization of a frame by seven numbers: the quaternion, then the translation.
using PoseManifold = ceres::ProductManifold<ceres::EigenQuaternionManifold, ceres::EuclideanManifold<3>>;

class Random {
 public:
  explicit Random(unsigned seed) : generator_(seed) {}

  double Uniform(double min, double max) { return std::uniform_real_distribution<double>(min, max)(generator_); }

  Eigen::Vector3d Vector(double stddev) {
    std::normal_distribution<double> normal(0.0, stddev);
    return {normal(generator_), normal(generator_), normal(generator_)};
  }

  Eigen::Quaterniond Rotation() {
    std::normal_distribution<double> normal;
    return Eigen::Quaterniond(normal(generator_), normal(generator_), normal(generator_), normal(generator_))
        .normalized();
  }

 private:
  std::mt19937 generator_;
};

inline Block ToBlock(const Eigen::Vector3d& v) { return {v.x(), v.y(), v.z()}; }

// Returns the pose block of a camera with a given centre c: t = -R c.
inline Block PoseBlock(const Eigen::Quaterniond& cam_from_world, const Eigen::Vector3d& cam_in_world) {
  const Eigen::Vector3d t = -(cam_from_world * cam_in_world);
  return {cam_from_world.x(), cam_from_world.y(), cam_from_world.z(), cam_from_world.w(), t.x(), t.y(), t.z()};
}

inline Block RandomPose(Random& random, double extent) { return PoseBlock(random.Rotation(), random.Vector(extent)); }

inline std::vector<const double*> Pointers(const std::vector<Block>& blocks) {
  std::vector<const double*> pointers;
  pointers.reserve(blocks.size());
  for (const Block& block : blocks) {
    pointers.push_back(block.data());
  }
  return pointers;
}

struct Evaluation {
  std::vector<double> residuals;
  std::vector<std::vector<double>> jacobians;  // row-major, one for each block
};

inline Evaluation Evaluate(const ceres::CostFunction& cost, const std::vector<Block>& blocks) {
  Evaluation evaluation;
  evaluation.residuals.resize(cost.num_residuals());
  std::vector<double*> jacobians;
  jacobians.reserve(blocks.size());
  evaluation.jacobians.reserve(blocks.size());
  for (const Block& block : blocks) {
    // The initial value is one that no Jacobian has, so that an entry which is not written is noticed.
    jacobians.push_back(evaluation.jacobians.emplace_back(cost.num_residuals() * block.size(), 1e300).data());
  }
  EXPECT_TRUE(cost.Evaluate(Pointers(blocks).data(), evaluation.residuals.data(), jacobians.data()));
  return evaluation;
}

// Expects the analytic Jacobians to agree with numeric ones by Ridders' method, in the tangent spaces. The first step
// that gives the best accuracy depends on the curvature of the residuals, so several are tried. A wrong Jacobian fails
// with all of them.
inline void ExpectGradientsAreRight(const ceres::CostFunction& cost, const std::vector<Block>& blocks,
                                    double tolerance = 1e-8) {
  const PoseManifold pose_manifold;
  std::vector<const ceres::Manifold*> manifolds;
  manifolds.reserve(blocks.size());
  for (const Block& block : blocks) {
    manifolds.push_back(block.size() == 7 ? &pose_manifold : nullptr);
  }
  ceres::GradientChecker::ProbeResults results;
  for (const double first_step : {1e-3, 1e-2, 1e-4, 1e-5}) {
    ceres::NumericDiffOptions options;
    options.ridders_relative_initial_step_size = first_step;
    ceres::GradientChecker checker(&cost, &manifolds, options);
    if (checker.Probe(Pointers(blocks).data(), tolerance, &results)) {
      return;
    }
  }
  ADD_FAILURE() << results.error_log;
}

// Expects the same results if Jacobians are not requested: Ceres requests only residuals in line searches, and no
// Jacobians of constant blocks.
inline void ExpectAnyJacobianMayBeLeftOut(const ceres::CostFunction& cost, const std::vector<Block>& blocks) {
  const Evaluation all = Evaluate(cost, blocks);
  std::vector<double> residuals(cost.num_residuals());
  ASSERT_TRUE(cost.Evaluate(Pointers(blocks).data(), residuals.data(), nullptr));
  EXPECT_EQ(residuals, all.residuals);
  for (size_t wanted = 0; wanted < blocks.size(); ++wanted) {
    std::vector<double> jacobian(all.jacobians[wanted].size());
    std::vector<double*> jacobians(blocks.size(), nullptr);
    jacobians[wanted] = jacobian.data();
    ASSERT_TRUE(cost.Evaluate(Pointers(blocks).data(), residuals.data(), jacobians.data()));
    EXPECT_EQ(jacobian, all.jacobians[wanted]);
  }
}

inline void ExpectAllFinite(const Evaluation& evaluation) {
  const auto finite = [](double value) { return std::isfinite(value) && value != 1e300; };
  EXPECT_TRUE(std::all_of(evaluation.residuals.begin(), evaluation.residuals.end(), finite));
  for (const std::vector<double>& jacobian : evaluation.jacobians) {
    EXPECT_TRUE(std::all_of(jacobian.begin(), jacobian.end(), finite));
  }
}

}  // namespace rangesfm
