#include "rangesfm/inertial_cost.h"

#include <gtest/gtest.h>

#include <Eigen/Core>
#include <Eigen/Geometry>
#include <algorithm>
#include <vector>

#include "cost_testing.h"
#include "rangesfm/robust_loss.h"

namespace rangesfm {
namespace {

// A motion and the state that it was measured at, but for errors of a given size.
struct Measured {
  InertialMotion motion;
  Eigen::Matrix3d rig_from_imu;
  std::vector<Block> blocks;

  Measured(Random& random, double error) : rig_from_imu(random.Rotation().toRotationMatrix()) {
    const Eigen::Quaterniond before = random.Rotation();
    const Eigen::Quaterniond after = random.Rotation();
    const Eigen::Vector3d velocity = random.Vector(2.0);
    const Eigen::Vector3d gravity = random.Vector(6.0);
    const Eigen::Vector3d turn = random.Vector(0.3);
    const Eigen::Vector3d arm = random.Vector(0.2);
    const Eigen::Vector3d place = random.Vector(5.0);
    const Eigen::Vector3d moved = random.Vector(1.0);
    const Eigen::Vector3d faster = random.Vector(1.0);
    motion.interval = random.Uniform(0.2, 2.0);
    const double dt = motion.interval;
    const Eigen::Matrix3d mounted = rig_from_imu * Eigen::AngleAxisd(turn.norm(), turn.normalized()).toRotationMatrix();
    const Eigen::Matrix3d to_imu = mounted.transpose() * before.toRotationMatrix();
    motion.turn = to_imu * after.toRotationMatrix().transpose() * mounted * Exponential(random.Vector(error));
    motion.speed = to_imu * (faster - gravity * dt) + random.Vector(error);
    motion.shift = to_imu * (moved - velocity * dt - gravity * dt * dt / 2.0) + random.Vector(error);
    motion.at.setZero();
    for (double& value : motion.at) {
      value = random.Uniform(-0.1, 0.1);
    }
    for (double& value : motion.by_sensor.reshaped()) {
      value = random.Uniform(-1.0, 1.0);
    }
    for (double& value : motion.whitening.reshaped()) {
      value = random.Uniform(-3.0, 3.0);
    }
    const auto joined = [](const Eigen::Vector3d& a, const Eigen::Vector3d& b) {
      return Block{a.x(), a.y(), a.z(), b.x(), b.y(), b.z()};
    };
    const auto center = [&arm](const Eigen::Quaterniond& rig_from_world, const Eigen::Vector3d& imu) {
      return Eigen::Vector3d(imu - rig_from_world.conjugate() * arm);
    };
    const Eigen::Matrix<double, 19, 1> at = motion.at;
    blocks = {PoseBlock(before, center(before, place)),
              PoseBlock(after, center(after, place + moved)),
              ToBlock(velocity),
              ToBlock(velocity + faster),
              ToBlock(gravity),
              joined(at.segment<3>(0), at.segment<3>(3)),
              joined(at.segment<3>(6), at.segment<3>(9)),
              joined(at.segment<3>(12), at.segment<3>(15)),
              {at[18]},
              joined(turn, arm)};
  }
};

TEST(InertialCost, IsZeroWhereTheMotionWasMeasured) {
  Random random(1);
  for (int i = 0; i < 10; ++i) {
    const Measured measured(random, 0.0);
    const Evaluation evaluation =
        Evaluate(InertialCost(measured.motion, measured.rig_from_imu, 1.0, RobustLoss()), measured.blocks);
    ExpectAllFinite(evaluation);
    for (const double residual : evaluation.residuals) {
      EXPECT_NEAR(residual, 0.0, 1e-12);
    }
  }
}

TEST(InertialCost, AFreeFallMeasuresNothingButTheTurn) {
  // For 2 s the sensor falls from rest and turns by 0.1 rad about its x axis; its accelerometer reads 0.
  InertialMotion motion = {2.0,
                           Eigen::Matrix3d::Identity(),
                           Eigen::Vector3d::Zero(),
                           Eigen::Vector3d::Zero(),
                           InertialMotion::OfSensor::Zero(),
                           Eigen::Matrix<double, 9, 19>::Zero(),
                           Eigen::Matrix<double, 9, 9>::Identity() / 0.05};
  const Eigen::Quaterniond turned(Eigen::AngleAxisd(-0.1, Eigen::Vector3d::UnitX()));
  const std::vector<Block> blocks = {PoseBlock(Eigen::Quaterniond::Identity(), {0.0, 0.0, 100.0}),
                                     PoseBlock(turned, {0.0, 0.0, 80.0}),
                                     {0.0, 0.0, 0.0},
                                     {0.0, 0.0, -20.0},
                                     {0.0, 0.0, -10.0},
                                     Block(6, 0.0),
                                     Block(6, 0.0),
                                     Block(6, 0.0),
                                     {0.0},
                                     Block(6, 0.0)};
  const InertialCost cost(motion, Eigen::Matrix3d::Identity(), 0.25, RobustLoss());
  const std::vector<double> residuals = Evaluate(cost, blocks).residuals;
  EXPECT_NEAR(residuals[0], 0.5 * 0.1 / 0.05, 1e-12);
  for (int i = 1; i < 9; ++i) {
    EXPECT_NEAR(residuals[i], 0.0, 1e-12);
  }
}

TEST(InertialCost, GradientsAreRightAtRandomPoints) {
  Random random(2);
  for (int i = 0; i < 20; ++i) {
    const bool is_robust = i % 2 == 1;
    Measured measured(random, 0.2);
    for (std::size_t block = 5; block < 8; ++block) {  // the sensor's numbers are not those of the sums
      std::for_each(measured.blocks[block].begin(), measured.blocks[block].end(),
                    [&random](double& value) { value += random.Uniform(-0.1, 0.1); });
    }
    ExpectGradientsAreRight(
        InertialCost(measured.motion, measured.rig_from_imu, 0.7, RobustLoss(is_robust ? 3.0 : kInfinity, true)),
        measured.blocks, 1e-7);
  }
}

TEST(InertialCost, ALossLimitsWhatAnOutlierCosts) {
  Random random(3);
  Measured measured(random, 0.0);
  measured.motion.speed.x() += 1e6;
  const InertialCost cost(measured.motion, measured.rig_from_imu, 1.0, RobustLoss(3.0, true));
  const std::vector<double> residuals = Evaluate(cost, measured.blocks).residuals;
  EXPECT_NEAR((Eigen::Map<const Eigen::VectorXd>(residuals.data(), 9).norm()), 3.0, 1e-5);
}

TEST(InertialCost, AnyJacobianMayBeLeftOut) {
  Random random(4);
  const Measured measured(random, 0.2);
  ExpectAnyJacobianMayBeLeftOut(InertialCost(measured.motion, measured.rig_from_imu, 0.5, RobustLoss(4.0, true)),
                                measured.blocks);
}

}  // namespace
}  // namespace rangesfm
