#include "rangesfm/direction_cost.h"

#include <gtest/gtest.h>

#include <cmath>

#include "cost_testing.h"

namespace rangesfm {
namespace {

TEST(DirectionCost, IsZeroWhereTheCameraSeesTheDirectionWhereItIs) {
  Random random(1);
  const Eigen::Quaterniond cam_from_world = random.Rotation();
  const Eigen::Vector3d up = random.Vector(1.0).normalized();
  const Evaluation evaluation =
      Evaluate(DirectionCost(up, cam_from_world * up, 0.05), {PoseBlock(cam_from_world, random.Vector(10.0))});
  for (const double residual : evaluation.residuals) {
    EXPECT_NEAR(residual, 0.0, 1e-12);
  }
}

TEST(DirectionCost, CountsAnglesInStddevs) {
  const double stddev = 0.05;
  const Eigen::Quaterniond tilted(Eigen::AngleAxisd(0.01, Eigen::Vector3d::UnitX()));
  const DirectionCost cost(Eigen::Vector3d::UnitZ(), Eigen::Vector3d::UnitZ(), stddev);
  const Evaluation evaluation = Evaluate(cost, {PoseBlock(tilted, Eigen::Vector3d::Zero())});
  EXPECT_NEAR(std::hypot(evaluation.residuals[0], evaluation.residuals[1]), 0.01 / stddev, 1e-5);
}

TEST(DirectionCost, ATurnAboutTheDirectionChangesNothing) {
  const Eigen::Quaterniond turned(Eigen::AngleAxisd(2.0, Eigen::Vector3d::UnitZ()));
  const DirectionCost cost(Eigen::Vector3d::UnitZ(), Eigen::Vector3d::UnitZ(), 0.05);
  for (const double residual : Evaluate(cost, {PoseBlock(turned, Eigen::Vector3d::Zero())}).residuals) {
    EXPECT_NEAR(residual, 0.0, 1e-12);
  }
}

// A rotation about an axis does not change the component along it. That derivative is zero up to rounding, and the
// shared check would compare rounding errors. Linear combinations of the three components have no such derivative.
class MixedDirectionCost final : public ceres::CostFunction {
 public:
  MixedDirectionCost(const DirectionCost& cost, const Eigen::Matrix3d& mixture) : cost_(cost), mixture_(mixture) {
    set_num_residuals(3);
    mutable_parameter_block_sizes()->push_back(7);
  }

  bool Evaluate(double const* const* parameters, double* residuals, double** jacobians) const override {
    if (!cost_.Evaluate(parameters, residuals, jacobians)) {
      return false;
    }
    Eigen::Map<Eigen::Vector3d> mixed{residuals};
    mixed = (mixture_ * mixed).eval();
    if (jacobians != nullptr && jacobians[0] != nullptr) {
      Eigen::Map<Eigen::Matrix<double, 3, 7, Eigen::RowMajor>> jacobian{jacobians[0]};
      jacobian = (mixture_ * jacobian).eval();
    }
    return true;
  }

 private:
  const DirectionCost& cost_;
  const Eigen::Matrix3d mixture_;
};

TEST(DirectionCost, GradientsAreRight) {
  Random random(2);
  for (int i = 0; i < 20; ++i) {
    const DirectionCost cost(random.Vector(1.0).normalized(), random.Vector(1.0).normalized(),
                             random.Uniform(0.01, 1.0));
    const Block pose = PoseBlock(random.Rotation(), random.Vector(10.0));
    ExpectGradientsAreRight(MixedDirectionCost(cost, random.Rotation().toRotationMatrix()), {pose});
    ExpectAnyJacobianMayBeLeftOut(cost, {pose});
  }
}

}  // namespace
}  // namespace rangesfm
