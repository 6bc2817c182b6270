// Python factories of the cost functions and of a manifold, with their documentation. Arguments are checked by
// argument_checks.h.
//
// No class is bound. The factories return ceres::CostFunction or ceres::Manifold, types that pyceres registers, and
// pass on the ownership: pyceres wraps the object in its own holder and deletes it. plugin/rangesfm/_cpp.pyi is made
// from the signatures, which pybind11 puts into the first line of each docstring (tests/solver/stub.py).

#include <ceres/cost_function.h>
#include <ceres/manifold.h>
#include <ceres/version.h>
#include <pybind11/numpy.h>
#include <pybind11/pybind11.h>
#include <pybind11/stl.h>

#include <Eigen/Core>
#include <limits>
#include <optional>
#include <string>
#include <type_traits>
#include <utility>

#include "argument_checks.h"
#include "rangesfm/direction_cost.h"
#include "rangesfm/distance_cost.h"
#include "rangesfm/elimination_order.h"
#include "rangesfm/inertial_cost.h"
#include "rangesfm/joint_prior_cost.h"
#include "rangesfm/position_cost.h"
#include "rangesfm/range_cost.h"
#include "rangesfm/robust_loss.h"
#include "rangesfm/tag_place.h"

namespace py = pybind11;

namespace rangesfm {
namespace {

using OptionalArray = std::optional<Array>;

constexpr double kLeastSquares = std::numeric_limits<double>::infinity();
constexpr auto kOwn = py::return_value_policy::take_ownership;

RobustLoss Loss(double loss_scale, bool is_bounded) {
  return {PositiveOrInfinite("loss_scale", loss_scale), is_bounded};
}

MeasuredRanges Measured(const Array& range_m, const Array& stddev_m, const Array& share,
                        const OptionalArray& loadings_m) {
  if (range_m.ndim() > 1 || range_m.size() == 0) {
    FailOnShape("range_m", range_m, "one number, or one dimension and one number or more");
  }
  const Eigen::Index num_ranges = range_m.size();
  return {ForEachRange("range_m", range_m, num_ranges, Positive),
          ForEachRange("stddev_m", stddev_m, num_ranges, Positive), ForEachRange("share", share, num_ranges, Positive),
          loadings_m ? FiniteMatrix("loadings_m", *loadings_m, num_ranges, Eigen::Dynamic)
                     : Eigen::MatrixXd(num_ranges, 0)};
}

RangeModel Model(const OptionalArray& tag_in_cam_m, std::optional<double> short_range_length_m, double loss_scale,
                 bool loss_is_bounded) {
  RangeModel model;
  if (tag_in_cam_m) {
    model.tag_in_cam = FiniteVector3("tag_in_cam_m", *tag_in_cam_m);
  }
  if (short_range_length_m) {
    model.short_range_length = Positive("short_range_length_m", *short_range_length_m);
  }
  model.loss = Loss(loss_scale, loss_is_bounded);
  return model;
}

constexpr auto kRangeCostDoc = R"(Make the cost of ranges measured at one keyframe to one anchor, a residual for each.

The error of a range is

``r = (d + bias + amplitude * exp(-d / short_range_length) + loadings * shared - range) / stddev``,
``d = ||R^T (tag_in_cam - t) - anchor||``.

The square of its residual is the robust loss of r times the range's share. Metres throughout. Parameter blocks:
rig_from_world (7,) as [qx qy qz qw tx ty tz]; anchor in the world (3,); range bias (1,), positive if the radio reads
too long. Then, in this order and as far as they are estimated: tag_in_cam (3,); amplitude (1,) of the short-range
error, positive if short ranges are too long; k numbers that all ranges share, in blocks (6,) and a last one of what
remains. Where the tag is at the anchor, the distance has no derivative, and that
part of the Jacobian is zero.

Args:
    range_m: measured range, or (n,) ranges, positive.
    stddev_m: standard deviation of the noise of all ranges, or (n,) of each, positive.
    tag_in_cam_m: (3,) lever arm, the tag's antenna in the rig frame; None makes it a parameter block.
    share: factor of the loss of all ranges, or (n,) of each, positive.
    loadings_m: (n, k) change of each range by each of the numbers that all ranges share; None: there are none.
    short_range_length_m: distance over which the short-range error decays, positive; None: there is no such error.
    loss_scale: scale of the robust loss in standard deviations, positive; infinity means least squares.
    loss_is_bounded: whether the loss is Geman and McClure's, ``r^2 / (1 + r^2 / scale^2)``, which never exceeds
        ``scale^2``; otherwise it is Cauchy's, ``scale^2 log(1 + r^2 / scale^2)``.

Raises:
    ValueError: a value is not finite or outside its limits, or an array has another shape.
)";

ceres::CostFunction* MakeRangeCost(const Array& range_m, const Array& stddev_m, const OptionalArray& tag_in_cam_m,
                                   const Array& share, const OptionalArray& loadings_m,
                                   std::optional<double> short_range_length_m, double loss_scale,
                                   bool loss_is_bounded) {
  return new RangeCost<KeyframePlace>(KeyframePlace(), Measured(range_m, stddev_m, share, loadings_m),
                                      Model(tag_in_cam_m, short_range_length_m, loss_scale, loss_is_bounded));
}

constexpr auto kInterpolatedRangeCostDoc = R"(Make the cost of ranges measured between two keyframes to one anchor.

It is like ``range_cost``, with the tag at ``(1 - w) * p_before + w * p_after + offset``, where
``p = R^T (tag_in_cam - t)`` for each pose and ``w = weight + time_shift / interval``. The time shift, in seconds, is
how much later the ranges were taken than assumed, and is to be added to the clock offset. Parameter blocks:
rig_from_world before (7,) and after (7,), of two different frames; anchor in the world (3,); range bias (1,). Then, in
this order and as far as they are estimated: tag_in_cam (3,); time shift (1,); amplitude (1,); shared numbers. The other
arguments and the errors are those of ``range_cost``.

Args:
    weight: interpolation weight of all ranges, or (n,) of each, from 0 (at the pose before) to 1 (at the pose after).
    offset_in_world_m: (3,) or (n, 3) deviation of a curved path from the straight line; it is constant, also if the
        lever arm is a parameter block.
    interval_s: time from the keyframe before to the one after, positive; if given, the time shift is a parameter block.
)";

ceres::CostFunction* MakeInterpolatedRangeCost(const Array& range_m, const Array& stddev_m,
                                               const OptionalArray& tag_in_cam_m, const Array& weight,
                                               const Array& offset_in_world_m, std::optional<double> interval_s,
                                               const Array& share, const OptionalArray& loadings_m,
                                               std::optional<double> short_range_length_m, double loss_scale,
                                               bool loss_is_bounded) {
  MeasuredRanges measured = Measured(range_m, stddev_m, share, loadings_m);
  RangeModel model = Model(tag_in_cam_m, short_range_length_m, loss_scale, loss_is_bounded);
  model.has_time_shift = interval_s.has_value();
  const Eigen::Index num_ranges = measured.range.size();
  InterpolatedPlace place(ForEachRange("weight", weight, num_ranges, Weight),
                          Vector3ForEachRange("offset_in_world_m", offset_in_world_m, num_ranges),
                          Positive("interval_s", interval_s.value_or(1.0)));
  return new RangeCost<InterpolatedPlace>(std::move(place), std::move(measured), std::move(model));
}

constexpr auto kDistanceCostDoc = R"(Make the cost of a distance between two ends a and b, measured by tape or by radio.

The residual is ``(||a - b|| + bias - distance) / stddev``. An end is a point in the world, or is fixed to a camera.
Parameter blocks: end a and end b, which must be different blocks, each a point (3,) or, if its position in the rig
frame is given, rig_from_world (7,); then the bias (1,), positive if the distance is measured too long, if there is one.

Args:
    distance_m: measured distance, positive.
    stddev_m: standard deviation of its noise, positive.
    a_in_cam_m, b_in_cam_m: (3,) position of the end in the rig frame; None for a point.
    has_bias: whether there is a parameter block of the bias.
    loss_scale: scale of Geman and McClure's loss (see ``range_cost``) in standard deviations, positive; infinity means
        least squares.

Raises:
    ValueError: see ``range_cost``.
)";

ceres::CostFunction* MakeDistanceCost(double distance_m, double stddev_m, const OptionalArray& a_in_cam_m,
                                      const OptionalArray& b_in_cam_m, bool has_bias, double loss_scale) {
  Positive("distance_m", distance_m);
  Positive("stddev_m", stddev_m);
  const RobustLoss loss = Loss(loss_scale, true);
  const auto between = [&](const auto& a, const auto& b) -> ceres::CostFunction* {
    using Cost = DistanceCost<std::decay_t<decltype(a)>, std::decay_t<decltype(b)>>;
    return new Cost(distance_m, a, b, stddev_m, has_bias, loss);
  };
  const auto from = [&](const auto& a) {
    return b_in_cam_m ? between(a, CamEnd(FiniteVector3("b_in_cam_m", *b_in_cam_m))) : between(a, PointEnd());
  };
  return a_in_cam_m ? from(CamEnd(FiniteVector3("a_in_cam_m", *a_in_cam_m))) : from(PointEnd());
}

constexpr auto kPositionCostDoc = R"(Make the cost of known positions of an antenna at one keyframe, or between two.

The error of a position is ``r = whitening (p - position)``, with the antenna at ``p = R^T (tag_in_cam - t)``, or
between two keyframes as in ``interpolated_range_cost``. The squared length of its three residuals is the robust loss of
the length of r times the position's share. Metres throughout. Parameter blocks: rig_from_world (7,) as
[qx qy qz qw tx ty tz], or those before and after. Then, in this order and as far as they are estimated: tag_in_cam
(3,); time shift (1,), only between two keyframes.

Args:
    position_m: (n, 3) known positions.
    whitening: (n, 3, 3) matrices such that ``whitening^T whitening`` is the inverse of a position's covariance.
    tag_in_cam_m: (3,) lever arm, the antenna in the rig frame; None makes it a parameter block.
    weight: (n,) interpolation weights between two keyframes, as in ``interpolated_range_cost``; None: at a keyframe.
    offset_in_world_m: (3,) or (n, 3) deviation of a curved path from the straight line between two keyframes; None: 0.
    interval_s: as in ``interpolated_range_cost``.
    share: factor of the loss of all positions, or (n,) of each, positive.
    loss_scale: scale of Geman and McClure's loss (see ``range_cost``) in standard deviations, positive; infinity means
        least squares.

Raises:
    ValueError: see ``range_cost``.
)";

ceres::CostFunction* MakePositionCost(const Array& position_m, const Array& whitening,
                                      const OptionalArray& tag_in_cam_m, const OptionalArray& weight,
                                      const OptionalArray& offset_in_world_m, std::optional<double> interval_s,
                                      const Array& share, double loss_scale) {
  if (position_m.ndim() != 2 || position_m.shape(0) == 0) {
    FailOnShape("position_m", position_m, "3 numbers for each of one position or more");
  }
  const Eigen::Index num = position_m.shape(0);
  KnownPositions known = {Vector3ForEachRange("position_m", position_m, num),
                          Matrix3ForEach("whitening", whitening, num), ForEachRange("share", share, num, Positive)};
  std::optional<Eigen::Vector3d> tag_in_cam;
  if (tag_in_cam_m) {
    tag_in_cam = FiniteVector3("tag_in_cam_m", *tag_in_cam_m);
  }
  const RobustLoss loss = Loss(loss_scale, true);
  if (!weight) {
    return new PositionCost<KeyframePlace>(KeyframePlace(), std::move(known), tag_in_cam, false, loss);
  }
  Eigen::Matrix3Xd offset = Eigen::Matrix3Xd::Zero(3, num);
  if (offset_in_world_m) {
    offset = Vector3ForEachRange("offset_in_world_m", *offset_in_world_m, num);
  }
  InterpolatedPlace place(ForEachRange("weight", *weight, num, Weight), std::move(offset),
                          Positive("interval_s", interval_s.value_or(1.0)));
  return new PositionCost<InterpolatedPlace>(std::move(place), std::move(known), tag_in_cam, interval_s.has_value(),
                                             loss);
}

constexpr auto kDirectionCostDoc = R"(Make the cost of a direction in the world that was measured in a camera's frame.

An example is the vertical. The three residuals are ``(R direction_in_world - direction_in_cam) / stddev``, with two
degrees of freedom. Parameter block: rig_from_world (7,).

Args:
    direction_in_world, direction_in_cam: (3,) vectors of any length except 0 ("cam" is the rig frame).
    stddev_rad: standard deviation of the direction as an angle, positive.

Raises:
    ValueError: see ``range_cost``.
)";

ceres::CostFunction* MakeDirectionCost(const Array& direction_in_world, const Array& direction_in_cam,
                                       double stddev_rad) {
  return new DirectionCost(Direction3("direction_in_world", direction_in_world),
                           Direction3("direction_in_cam", direction_in_cam), Positive("stddev_rad", stddev_rad));
}

constexpr auto kInertialCostDoc = R"(Make the cost of what an inertial sensor measured between two keyframes.

Its motion is summed up in its own frame at the first keyframe (preintegration: Forster et al., "On-manifold
preintegration for real-time visual-inertial odometry", 2017, with scale errors and clock besides the biases). With M =
rig_from_imu Exp(mounting[:3]), a = mounting[3:], R the rotations from world to rig, p = R^T (a - t), g the gravity, and
turn, speed and shift corrected to the numbers of the sensor by ``by_sensor``, to first order, the nine errors are

``log(turn^T M^T R_before R_after^T M)``, ``M^T R_before (v_after - v_before - g dt) - speed``,
``M^T R_before (p_after - p_before - v_before dt - g dt^2 / 2) - shift``.

The squared length of the nine residuals is the robust loss of the length of ``whitening errors`` times the share.
Metres, seconds and radians throughout. Parameter blocks: rig_from_world before and after (7,) as [qx qy qz qw tx ty
tz]; velocities of the sensor in the world, before and after (3,); gravity in the world (3,), which points down; biases
(6,) of gyroscope and accelerometer; shares (6,) by which their axes read too much; shares (6,) by which those of the
accelerometer read of others (x of y, x of z, y of x, y of z, z of x, z of y); by how much later than assumed the sensor
measured (1,); mounting (6,), a rotation vector of the sensor in its own frame and its place in the rig.

Args:
    interval_s: time between the keyframes, positive.
    turn: (3, 3) rotation from the sensor's frame at the end into that at the start.
    speed: (3,) change of the velocity without gravity. shift: (3,) the same of the place, beyond that of the velocity.
    at: (19,) biases, shares and clock at which they were summed up.
    by_sensor: (9, 19) derivatives of turn (as a rotation vector at its end), speed and shift by these.
    whitening: (9, 9) matrix such that ``whitening^T whitening`` is the inverse of the errors' covariance.
    rig_from_imu: (3, 3) rotation.
    share: factor of the loss, positive.
    loss_scale: scale of Geman and McClure's loss (see ``range_cost``) in standard deviations, positive; infinity means
        least squares.

Raises:
    ValueError: see ``range_cost``.
)";

ceres::CostFunction* MakeInertialCost(double interval_s, const Array& turn, const Array& speed, const Array& shift,
                                      const Array& at, const Array& by_sensor, const Array& whitening,
                                      const Array& rig_from_imu, double share, double loss_scale) {
  constexpr int kErrors = InertialMotion::kNumErrors;
  constexpr int kOfSensor = InertialMotion::kNumOfSensor;
  if (at.size() != kOfSensor) {
    FailOnShape("at", at, std::to_string(kOfSensor) + " numbers");
  }
  InertialMotion motion = {Positive("interval_s", interval_s),
                           FiniteMatrix("turn", turn, 3, 3),
                           FiniteVector3("speed", speed),
                           FiniteVector3("shift", shift),
                           FiniteVector("at", at),
                           FiniteMatrix("by_sensor", by_sensor, kErrors, kOfSensor),
                           FiniteMatrix("whitening", whitening, kErrors, kErrors)};
  return new InertialCost(std::move(motion), FiniteMatrix("rig_from_imu", rig_from_imu, 3, 3), Positive("share", share),
                          Loss(loss_scale, true));
}

constexpr auto kJointPriorCostDoc = R"(Make the cost of a prior on numbers that are correlated.

The r residuals are ``whitening (x - mean)``, with x the numbers of all blocks one after the other. Parameter blocks: m
of the same size s. Examples are the range biases of anchors, which have the tag's bias in common, and a bias that
walks from one block to the next.

Args:
    mean: (m, s) prior mean of each block, in its unit; (m,) of blocks of one number.
    whitening: (r, m s) matrix such that ``whitening^T whitening`` is the information on the numbers.

Raises:
    ValueError: see ``range_cost``.
)";

ceres::CostFunction* MakeJointPriorCost(const Array& mean, const Array& whitening) {
  if (mean.ndim() == 0 || mean.ndim() > 2 || mean.size() == 0) {
    FailOnShape("mean", mean, "a number or a row for each of one block or more");
  }
  const Eigen::VectorXd means = Eigen::Map<const Eigen::VectorXd>(mean.data(), mean.size());
  CheckEach("mean", means, Finite);
  return new JointPriorCost(mean.ndim() == 2 ? static_cast<int>(mean.shape(1)) : 1, means,
                            FiniteMatrix("whitening", whitening, Eigen::Dynamic, means.size()));
}

ceres::CostFunction* MakeZeroTieCost(int size_a, int size_b) {
  return new ZeroTieCost(BlockSize("size_a", size_a), BlockSize("size_b", size_b));
}

ceres::Manifold* MakePaddedManifold(int size, int tangent_size) {
  const std::string expected = "at least the block's size, " + std::to_string(BlockSize("size", size));
  Checked("tangent_size", BlockSize("tangent_size", tangent_size), tangent_size >= size, expected);
  return new PaddedManifold(size, tangent_size);
}

}  // namespace
}  // namespace rangesfm

PYBIND11_MODULE(_cpp, m) {
  using py::arg;
  using rangesfm::kLeastSquares;
  using rangesfm::kOwn;
  m.doc() = "Cost functions of rangesfm, to be used through the package rangesfm.solver.";
  m.attr("pybind11_version") = PYBIND11_TOSTRING(PYBIND11_VERSION_MAJOR) "." PYBIND11_TOSTRING(
      PYBIND11_VERSION_MINOR) "." PYBIND11_TOSTRING(PYBIND11_VERSION_PATCH);
  m.attr("ceres_version") = CERES_VERSION_STRING;
  m.attr("pybind11_internals_version") = PYBIND11_INTERNALS_VERSION;

  m.def("range_cost", &rangesfm::MakeRangeCost, kOwn, rangesfm::kRangeCostDoc, py::kw_only(), arg("range_m"),
        arg("stddev_m"), arg("tag_in_cam_m"), arg("share") = 1.0, arg("loadings_m") = py::none(),
        arg("short_range_length_m") = py::none(), arg("loss_scale") = kLeastSquares, arg("loss_is_bounded") = false);
  m.def("interpolated_range_cost", &rangesfm::MakeInterpolatedRangeCost, kOwn, rangesfm::kInterpolatedRangeCostDoc,
        py::kw_only(), arg("range_m"), arg("stddev_m"), arg("tag_in_cam_m"), arg("weight"), arg("offset_in_world_m"),
        arg("interval_s") = py::none(), arg("share") = 1.0, arg("loadings_m") = py::none(),
        arg("short_range_length_m") = py::none(), arg("loss_scale") = kLeastSquares, arg("loss_is_bounded") = false);
  m.def("distance_cost", &rangesfm::MakeDistanceCost, kOwn, rangesfm::kDistanceCostDoc, py::kw_only(),
        arg("distance_m"), arg("stddev_m"), arg("a_in_cam_m") = py::none(), arg("b_in_cam_m") = py::none(),
        arg("has_bias") = false, arg("loss_scale") = kLeastSquares);
  m.def("position_cost", &rangesfm::MakePositionCost, kOwn, rangesfm::kPositionCostDoc, py::kw_only(),
        arg("position_m"), arg("whitening"), arg("tag_in_cam_m"), arg("weight") = py::none(),
        arg("offset_in_world_m") = py::none(), arg("interval_s") = py::none(), arg("share") = 1.0,
        arg("loss_scale") = kLeastSquares);
  m.def("direction_cost", &rangesfm::MakeDirectionCost, kOwn, rangesfm::kDirectionCostDoc, py::kw_only(),
        arg("direction_in_world"), arg("direction_in_cam"), arg("stddev_rad"));
  m.def("inertial_cost", &rangesfm::MakeInertialCost, kOwn, rangesfm::kInertialCostDoc, py::kw_only(),
        arg("interval_s"), arg("turn"), arg("speed"), arg("shift"), arg("at"), arg("by_sensor"), arg("whitening"),
        arg("rig_from_imu"), arg("share") = 1.0, arg("loss_scale") = kLeastSquares);
  m.def("joint_prior_cost", &rangesfm::MakeJointPriorCost, kOwn, rangesfm::kJointPriorCostDoc, py::kw_only(),
        arg("mean"), arg("whitening"));
  m.def("zero_tie_cost", &rangesfm::MakeZeroTieCost, kOwn, "See elimination_order.h.", py::kw_only(), arg("size_a"),
        arg("size_b"));
  m.def("padded_manifold", &rangesfm::MakePaddedManifold, kOwn, "See elimination_order.h.", py::kw_only(), arg("size"),
        arg("tangent_size"));
}
