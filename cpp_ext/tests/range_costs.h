// Range costs for the tests.

#pragma once

#include <Eigen/Core>
#include <utility>

#include "rangesfm/range_cost.h"
#include "rangesfm/tag_place.h"

namespace rangesfm {

inline Eigen::Vector3d TagInCam() { return {-0.0012, -0.0900, -0.0663}; }

inline MeasuredRanges OneRange(double range, double stddev) {
  return {Eigen::VectorXd::Constant(1, range), Eigen::VectorXd::Constant(1, stddev), Eigen::VectorXd::Ones(1),
          Eigen::MatrixXd(1, 0)};
}

inline RangeModel WithLeverArm(const Eigen::Vector3d& tag_in_cam) {
  RangeModel model;
  model.tag_in_cam = tag_in_cam;
  return model;
}

inline RangeCost<KeyframePlace> AtKeyframe(double range, const Eigen::Vector3d& tag_in_cam, double stddev) {
  return {KeyframePlace(), OneRange(range, stddev), WithLeverArm(tag_in_cam)};
}

inline RangeCost<InterpolatedPlace> BetweenKeyframes(double range, const Eigen::Vector3d& tag_in_cam, double weight,
                                                     const Eigen::Vector3d& offset_in_world, double stddev) {
  InterpolatedPlace place(Eigen::VectorXd::Constant(1, weight), offset_in_world, 1.0);
  return {std::move(place), OneRange(range, stddev), WithLeverArm(tag_in_cam)};
}

}  // namespace rangesfm
