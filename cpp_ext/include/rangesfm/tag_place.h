// Where the tag was when its ranges were measured: at a keyframe, or between two keyframes.
//
// A place says which parameter blocks of poses it has, how many ranges were measured there, and, as its class Now,
// where the tag is for each of them at the present parameters and how that moves with them. Each gradient is the
// derivative of direction . tag_in_world.

#pragma once

#include <Eigen/Core>
#include <utility>

#include "rangesfm/range_geometry.h"

namespace rangesfm {

// What moves the tag beside the poses: its place in the rig frame, and how much later its ranges were measured than
// was thought (seconds).
struct TagMotion {
  Eigen::Vector3d tag_in_cam;
  double time_shift;
};

// At a keyframe: R^T (tag_in_cam - t), the same for all its ranges.
class KeyframePlace {
 public:
  static constexpr int kNumPoses = 1;

  class Now {
   public:
    Now(const KeyframePlace& /*place*/, double const* const* poses, const TagMotion& motion)
        : tag_(poses[0], motion.tag_in_cam) {}

    const Eigen::Vector3d& TagInWorld(int /*range*/) const { return tag_.InWorld(); }
    PoseGradient OfPose(int /*pose*/, int /*range*/, const Eigen::Vector3d& direction) const {
      return tag_.Gradient(direction);
    }
    Eigen::Vector3d OfLeverArm(int /*range*/, const Eigen::Vector3d& direction) const {
      return tag_.LeverArmGradient(direction);
    }
    static double OfTimeShift(const Eigen::Vector3d& /*direction*/) { return 0.0; }

   private:
    TagPosition tag_;
  };
};

// Between two keyframes, one column and one weight a range:
//
//   (1 - w) p_before + w p_after + offset_in_world,
//   p = R^T (tag_in_cam - t),  w = weight + time_shift / interval
//
// The straight line between the tag's two places moves with both poses; the offset is what the path's curvature adds to
// it. The interval is the time between the keyframes; a line goes on beyond its ends where a time shift leads there.
class InterpolatedPlace {
 public:
  static constexpr int kNumPoses = 2;

  InterpolatedPlace(Eigen::VectorXd weight, Eigen::Matrix3Xd offset_in_world, double interval)
      : weight_(std::move(weight)), offset_(std::move(offset_in_world)), inv_interval_(1.0 / interval) {}

  class Now {
   public:
    Now(const InterpolatedPlace& place, double const* const* poses, const TagMotion& motion)
        : place_(place),
          before_(poses[0], motion.tag_in_cam),
          after_(poses[1], motion.tag_in_cam),
          time_shift_(motion.time_shift) {}

    Eigen::Vector3d TagInWorld(int range) const {
      const double weight = Weight(range);
      return (1.0 - weight) * before_.InWorld() + weight * after_.InWorld() + place_.offset_.col(range);
    }
    PoseGradient OfPose(int pose, int range, const Eigen::Vector3d& direction) const {
      const double weight = Weight(range);
      return pose == 0 ? before_.Gradient((1.0 - weight) * direction) : after_.Gradient(weight * direction);
    }
    Eigen::Vector3d OfLeverArm(int range, const Eigen::Vector3d& direction) const {
      const double weight = Weight(range);
      return before_.LeverArmGradient((1.0 - weight) * direction) + after_.LeverArmGradient(weight * direction);
    }
    double OfTimeShift(const Eigen::Vector3d& direction) const {
      return direction.dot(place_.inv_interval_ * (after_.InWorld() - before_.InWorld()));
    }

   private:
    double Weight(int range) const { return place_.weight_[range] + time_shift_ * place_.inv_interval_; }

    const InterpolatedPlace& place_;
    TagPosition before_;
    TagPosition after_;
    double time_shift_;
  };

 private:
  Eigen::VectorXd weight_;
  Eigen::Matrix3Xd offset_;
  double inv_interval_;
};

}  // namespace rangesfm
