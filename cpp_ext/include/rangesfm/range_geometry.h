// Geometry of ranges and distances: the position of a point fixed to a camera, the distance between two points, and the
// derivatives of both.

#pragma once

#include <Eigen/Core>
#include <Eigen/Geometry>

namespace rangesfm {

using PoseGradient = Eigen::Matrix<double, 1, 7>;

// Position of the tag's antenna in the world, from COLMAP's pose block rig_from_world = [qx qy qz qw tx ty tz]:
//
//   tag_in_world = R^T d,  d = tag_in_cam - t
//
// ("cam" is the rig frame, that is, the frame of the rig's reference camera.) With q = (u, w), the rotation is the
// polynomial that Eigen evaluates for `conjugate(q) * d`,
//
//   R^T d = d - 2 w (u x d) + 2 u x (u x d),
//
// which is a rotation only for a unit quaternion. The derivative of the polynomial itself has no meaning off the unit
// sphere. Its projection to the tangent space by the quaternion's manifold is exact, as for any smooth function that
// agrees with the rotation on the sphere.
class TagPosition {
 public:
  TagPosition(const double* rig_from_world, const Eigen::Vector3d& tag_in_cam)
      : cam_from_world_(rig_from_world),
        tag_from_cam_(tag_in_cam - Eigen::Map<const Eigen::Vector3d>(rig_from_world + 4)),
        in_world_(cam_from_world_.conjugate() * tag_from_cam_) {}

  const Eigen::Vector3d& InWorld() const { return in_world_; }

  // Derivative of direction . tag_in_world with respect to the seven numbers of the pose block.
  PoseGradient Gradient(const Eigen::Vector3d& direction) const {
    const auto u = cam_from_world_.vec();
    const double w = cam_from_world_.w();
    const Eigen::Vector3d& d = tag_from_cam_;
    PoseGradient gradient;
    gradient.head<3>() =
        2.0 * (w * direction.cross(d) + u.dot(d) * direction + u.dot(direction) * d - 2.0 * direction.dot(d) * u);
    gradient(3) = -2.0 * direction.dot(u.cross(d));
    gradient.tail<3>() = -LeverArmGradient(direction);
    return gradient;
  }

  // Derivative of direction . tag_in_world with respect to tag_in_cam.
  Eigen::Vector3d LeverArmGradient(const Eigen::Vector3d& direction) const { return cam_from_world_ * direction; }

 private:
  Eigen::Map<const Eigen::Quaterniond> cam_from_world_;
  Eigen::Vector3d tag_from_cam_;  // d: vector from the world's origin to the tag, in the camera's axes
  Eigen::Vector3d in_world_;
};

// Distance and direction from the anchor to the tag.
class AnchorToTag {
 public:
  AnchorToTag(const Eigen::Vector3d& tag_in_world, const double* anchor_in_world)
      : AnchorToTag(Eigen::Vector3d(tag_in_world - Eigen::Map<const Eigen::Vector3d>(anchor_in_world))) {}

  double Distance() const { return distance_; }

  // Derivative of the distance with respect to the tag; with respect to the anchor it is the negative.
  const Eigen::Vector3d& Direction() const { return direction_; }

 private:
  // Where the two antennas coincide, the distance has no derivative. Below this distance the offset is a rounding error
  // with an arbitrary direction. Zero is the subgradient that causes no step, so that the result stays finite and the
  // other residuals decide.
  static constexpr double kMinDistance = 1e-12;  // metres

  explicit AnchorToTag(const Eigen::Vector3d& offset) : distance_(offset.norm()), direction_(Eigen::Vector3d::Zero()) {
    if (distance_ > kMinDistance) {
      direction_ = offset / distance_;
    }
  }

  double distance_;
  Eigen::Vector3d direction_;
};

}  // namespace rangesfm
