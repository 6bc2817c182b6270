// What an inertial sensor measured between two keyframes.

#pragma once

#include <ceres/cost_function.h>

#include <Eigen/Core>
#include <Eigen/Geometry>
#include <Eigen/LU>
#include <array>
#include <cmath>
#include <cstdint>
#include <utility>

#include "rangesfm/robust_loss.h"

namespace rangesfm {

// Motion of the sensor, summed up between two keyframes in its own frame at the first, and its derivatives by the
// nineteen numbers of the sensor: biases of gyroscope and accelerometer, their scale errors, what axes of the
// accelerometer read of others, and the clock.
struct InertialMotion {
  static constexpr int kNumErrors = 9;
  static constexpr int kNumOfSensor = 19;
  using Errors = Eigen::Matrix<double, kNumErrors, 1>;
  using OfSensor = Eigen::Matrix<double, kNumOfSensor, 1>;

  double interval;
  Eigen::Matrix3d turn;
  Eigen::Vector3d speed;
  Eigen::Vector3d shift;
  OfSensor at;
  Eigen::Matrix<double, kNumErrors, kNumOfSensor> by_sensor;
  Eigen::Matrix<double, kNumErrors, kNumErrors> whitening;
};

inline Eigen::Matrix3d CrossMatrix(const Eigen::Vector3d& v) {
  Eigen::Matrix3d matrix;
  matrix << 0.0, -v.z(), v.y(), v.z(), 0.0, -v.x(), -v.y(), v.x(), 0.0;
  return matrix;
}

inline Eigen::Matrix3d Exponential(const Eigen::Vector3d& v) {
  return Eigen::AngleAxisd(v.norm(), v.stableNormalized()).toRotationMatrix();
}

inline Eigen::Vector3d Logarithm(const Eigen::Matrix3d& rotation) {
  const Eigen::AngleAxisd angle_axis(rotation);
  return angle_axis.angle() * angle_axis.axis();
}

// Left Jacobian of Exp(v): Solà et al., "A micro Lie theory for state estimation in robotics", eq. 145. The right one
// is that of -v.
inline Eigen::Matrix3d LeftJacobian(const Eigen::Vector3d& v) {
  const double angle = v.norm();
  const Eigen::Matrix3d cross = CrossMatrix(v);
  if (angle < 1e-4) {
    return Eigen::Matrix3d::Identity() + cross / 2.0 + cross * cross / 6.0;
  }
  return Eigen::Matrix3d::Identity() + (1.0 - std::cos(angle)) / (angle * angle) * cross +
         (angle - std::sin(angle)) / (angle * angle * angle) * cross * cross;
}

// Errors of a measured motion between two keyframes: nine whitened residuals, whose length is robust, times the root of
// a share. The formula, the blocks and their order are in the docstring of inertial_cost (src/bindings.cc).
class InertialCost final : public ceres::CostFunction {
 public:
  InertialCost(InertialMotion motion, const Eigen::Matrix3d& rig_from_imu, double share, RobustLoss loss)
      : motion_(std::move(motion)), rig_from_imu_(rig_from_imu), root_share_(std::sqrt(share)), loss_(loss) {
    set_num_residuals(kNum);
    mutable_parameter_block_sizes()->assign(kSizes.begin(), kSizes.end());
  }

  bool Evaluate(double const* const* parameters, double* residuals, double** jacobians) const override {
    const Pose before(parameters[kBefore]);
    const Pose after(parameters[kAfter]);
    const Eigen::Map<const Eigen::Vector3d> velocity_before(parameters[kVelocityBefore]);
    const Eigen::Map<const Eigen::Vector3d> velocity_after(parameters[kVelocityAfter]);
    const Eigen::Map<const Eigen::Vector3d> gravity(parameters[kGravity]);
    const Eigen::Map<const Eigen::Vector3d> turn(parameters[kMounting]);
    const Eigen::Map<const Eigen::Vector3d> arm(parameters[kMounting] + 3);
    InertialMotion::OfSensor sensor;
    sensor << Eigen::Map<const Vector6>(parameters[kBiases]), Eigen::Map<const Vector6>(parameters[kScales]),
        Eigen::Map<const Vector6>(parameters[kCrossAxes]), *parameters[kClock];

    const double dt = motion_.interval;
    const Eigen::Matrix3d mounted = rig_from_imu_ * Exponential(turn);
    const Eigen::Matrix3d from_world = mounted.transpose() * before.rig_from_world;
    const Eigen::Matrix3d turned = from_world * after.rig_from_world.transpose() * mounted;
    const Eigen::Vector3d speed = from_world * (velocity_after - velocity_before - gravity * dt);
    const Eigen::Vector3d shift =
        from_world * (after.InWorld(arm) - before.InWorld(arm) - velocity_before * dt - gravity * dt * dt / 2.0);
    const InertialMotion::Errors change = motion_.by_sensor * (sensor - motion_.at);
    const Eigen::Matrix3d off = (motion_.turn * Exponential(change.head<3>())).transpose() * turned;
    InertialMotion::Errors error;
    error << Logarithm(off), speed - motion_.speed - change.segment<3>(3), shift - motion_.shift - change.tail<3>();

    const InertialMotion::Errors whitened = motion_.whitening * error;
    const RobustLoss::OfVector robust = loss_.ForLength(whitened.norm());
    Eigen::Map<InertialMotion::Errors>{residuals} = root_share_ * robust.factor * whitened;
    if (jacobians == nullptr) {
      return true;
    }
    using Square = Eigen::Matrix<double, kNum, kNum>;
    const Square by_error = root_share_ *
                            (robust.factor * Square::Identity() + robust.along * whitened * whitened.transpose()) *
                            motion_.whitening;
    // Derivatives of the errors, of which those of the angles are by a turn at the end of the interval.
    const Eigen::Matrix3d spread = LeftJacobian(-error.head<3>()).inverse();
    const Eigen::Matrix3d to_imu = mounted.transpose();
    By3 by_mounting;
    by_mounting << spread - spread * turned.transpose(), CrossMatrix(speed), CrossMatrix(shift);
    By3 by_turn = by_mounting * to_imu;
    by_turn.topRows<3>() = -spread * turned.transpose() * to_imu;
    by_turn.bottomRows<3>() += to_imu * CrossMatrix(arm);
    By3 by_center = By3::Zero();
    by_center.bottomRows<3>() = -from_world;
    WritePose(kBefore, before, by_error * by_turn, by_error * by_center, jacobians);
    by_turn << spread * to_imu, Eigen::Matrix3d::Zero(),
        -from_world * after.rig_from_world.transpose() * CrossMatrix(arm);
    WritePose(kAfter, after, by_error * by_turn, by_error * -by_center, jacobians);
    By3 by_velocity = By3::Zero();
    by_velocity.middleRows<3>(3) = from_world;
    Write<3>(kVelocityAfter, by_error * by_velocity, jacobians);
    Write<3>(kVelocityBefore, by_error * (dt * by_center - by_velocity), jacobians);
    Write<3>(kGravity, by_error * (dt * dt / 2.0 * by_center - dt * by_velocity), jacobians);
    Eigen::Matrix<double, kNum, InertialMotion::kNumOfSensor> by_sensor = -motion_.by_sensor;
    by_sensor.topRows<3>() =
        (spread * off.transpose() * LeftJacobian(-change.head<3>()) * by_sensor.topRows<3>()).eval();
    by_sensor = (by_error * by_sensor).eval();
    Write<6>(kBiases, by_sensor.leftCols<6>(), jacobians);
    Write<6>(kScales, by_sensor.middleCols<6>(6), jacobians);
    Write<6>(kCrossAxes, by_sensor.middleCols<6>(12), jacobians);
    Write<1>(kClock, by_sensor.rightCols<1>(), jacobians);
    Eigen::Matrix<double, kNum, 6> by_turn_and_arm = Eigen::Matrix<double, kNum, 6>::Zero();
    // A change of the rotation vector turns the mounting in its own frame by the right Jacobian.
    by_turn_and_arm.leftCols<3>() = by_mounting * LeftJacobian(-turn);
    by_turn_and_arm.bottomRightCorner<3, 3>() = from_world * (after.rig_from_world - before.rig_from_world).transpose();
    Write<6>(kMounting, by_error * by_turn_and_arm, jacobians);
    return true;
  }

 private:
  static constexpr int kNum = InertialMotion::kNumErrors;
  using By3 = Eigen::Matrix<double, kNum, 3>;
  using Vector6 = Eigen::Matrix<double, 6, 1>;
  enum Block : std::uint8_t {
    kBefore,
    kAfter,
    kVelocityBefore,
    kVelocityAfter,
    kGravity,
    kBiases,
    kScales,
    kCrossAxes,
    kClock,
    kMounting
  };
  static constexpr std::array<int, 10> kSizes = {7, 7, 3, 3, 3, 6, 6, 6, 1, 6};

  // COLMAP's rig_from_world.
  struct Pose {
    explicit Pose(const double* block)
        : quaternion(block), translation(block + 4), rig_from_world(quaternion.toRotationMatrix()) {}

    Eigen::Vector3d InWorld(const Eigen::Vector3d& in_rig) const {
      return rig_from_world.transpose() * (in_rig - translation);
    }

    Eigen::Map<const Eigen::Quaterniond> quaternion;
    Eigen::Map<const Eigen::Vector3d> translation;
    Eigen::Matrix3d rig_from_world;
  };

  template <int kSize>
  static void Write(int block, const Eigen::Matrix<double, kNum, kSize>& values, double** jacobians) {
    if (jacobians[block] != nullptr) {
      constexpr int kOrder = kSize == 1 ? Eigen::ColMajor : Eigen::RowMajor;
      Eigen::Map<Eigen::Matrix<double, kNum, kSize, kOrder>>{jacobians[block]} = values;
    }
  }

  // Writes the derivatives by a pose's seven numbers, given those by a turn of the rig in its own frame and by its
  // origin in the world. Off the unit sphere of quaternions they have no meaning; along it they are exact, as in
  // range_geometry.h. A step of the quaternion's manifold is half a turn of the world seen from the rig, whose columns
  // have length 1, and moves the origin, which is -R^T t.
  static void WritePose(int block, const Pose& pose, const By3& by_turn, const By3& by_center, double** jacobians) {
    const Eigen::Matrix3d world_from_rig = pose.rig_from_world.transpose();
    Eigen::Matrix<double, 4, 3> step;
    step << pose.quaternion.w() * Eigen::Matrix3d::Identity() - CrossMatrix(pose.quaternion.vec()),
        -pose.quaternion.vec().transpose();
    const By3 by_step = -2.0 * (by_turn + by_center * world_from_rig * CrossMatrix(pose.translation));
    Eigen::Matrix<double, kNum, 7> by_pose;
    by_pose << by_step * step.transpose(), -by_center * world_from_rig;
    Write<7>(block, by_pose, jacobians);
  }

  const InertialMotion motion_;
  const Eigen::Matrix3d rig_from_imu_;
  const double root_share_;
  const RobustLoss loss_;
};

}  // namespace rangesfm
