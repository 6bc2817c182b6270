// Place of the tag when its ranges were measured: at a keyframe, or between two keyframes.
//
// A place has a number of pose blocks. Its class Now gives the position of the tag for each range at the present
// parameters, and the derivatives of direction . tag_in_world by them.

#pragma once

#include <Eigen/Core>
#include <utility>

#include "rangesfm/range_geometry.h"

namespace rangesfm {

// Parameters other than the poses that move the tag: its position in the rig frame, and by how many seconds its ranges
// were measured later than assumed.
struct TagMotion {
  Eigen::Vector3d tag_in_cam;
  double time_shift;
};

// Place at a keyframe: R^T (tag_in_cam - t), the same for all ranges.
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

// Place between two keyframes, with an offset and a weight for each range:
//
//   (1 - w) p_before + w p_after + offset_in_world,
//   p = R^T (tag_in_cam - t),  w = weight + time_shift / interval
//
// The straight line between the tag's two positions moves with both poses. The offset is the deviation of the curved
// path from that line. The interval is the time between the keyframes. A time shift may lead beyond the ends of the
// line, which is then extended.
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
