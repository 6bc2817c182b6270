// Factories of the cost functions and of a manifold for Python: documented here, checked at the gate.
//
// No class is bound. The factories return ceres::CostFunction or ceres::Manifold, types that pyceres registers, and
// give the object away: pyceres wraps it in the holder it chose itself, owns it and deletes it. The first line of each
// docstring, its signature, is what plugin/rangesfm/_cpp.pyi is made of (tests/ceres/stub.py).

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

#include "gate.h"
#include "rangesfm/beside_points.h"
#include "rangesfm/direction_cost.h"
#include "rangesfm/distance_cost.h"
#include "rangesfm/joint_prior_cost.h"
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

MeasuredRanges Measured(const Array& range_m, const Array& stddev_m, const Array& share) {
  if (range_m.ndim() > 1 || range_m.size() == 0) {
    FailOnShape("range_m", range_m, "one number, or one dimension and one number or more");
  }
  const Eigen::Index num_ranges = range_m.size();
  return {ForEachRange("range_m", range_m, num_ranges, Positive),
          ForEachRange("stddev_m", stddev_m, num_ranges, Positive), ForEachRange("share", share, num_ranges, Positive)};
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

constexpr auto kRangeCostDoc = R"(Ranges measured at one keyframe to one anchor; each is a residual,

``(d + bias + amplitude * exp(-d / short_range_length) - range) / stddev``, ``d = ||R^T (tag_in_cam - t) - anchor||``,

made robust for itself: half the sum of squares is the sum of the losses, each times its share. Blocks: rig_from_world
(7,) as [qx qy qz qw tx ty tz], anchor in the world (3,), range bias (1,): what the radio reads too long. Then, as far
as they are asked for and in this order: tag_in_cam (3,), amplitude (1,) of what short ranges read too long. With the
tag on the anchor, where a distance has no derivative, that part of the Jacobian is zero.

Args:
    range_m: one, or (n,) ranges as measured, positive.
    stddev_m: noise of all ranges, or (n,) of each, positive.
    tag_in_cam_m: (3,) lever arm, the tag's antenna in the rig frame; None makes it a block.
    share: by how much all ranges count beside their noise, or (n,) each, positive.
    short_range_length_m: distance over which the short-range error fades, positive; None: there is none.
    loss_scale: of the robust loss, in stddevs, positive; infinite: least squares.
    loss_is_bounded: Geman and McClure's loss, ``r^2 / (1 + r^2 / scale^2)``, which no outlier raises beyond
        ``scale^2``; otherwise Cauchy's, ``scale^2 log(1 + r^2 / scale^2)``.

Raises:
    ValueError: a value is not finite, or outside its limits, or not of its shape.
)";

ceres::CostFunction* MakeRangeCost(const Array& range_m, const Array& stddev_m, const OptionalArray& tag_in_cam_m,
                                   const Array& share, std::optional<double> short_range_length_m, double loss_scale,
                                   bool loss_is_bounded) {
  return new RangeCost<KeyframePlace>(KeyframePlace(), Measured(range_m, stddev_m, share),
                                      Model(tag_in_cam_m, short_range_length_m, loss_scale, loss_is_bounded));
}

constexpr auto kInterpolatedRangeCostDoc = R"(Ranges measured between two keyframes to one anchor.

As ``range_cost``, with the tag at ``(1 - w) * p_before + w * p_after + offset``, ``p = R^T (tag_in_cam - t)`` of either
pose, and ``w = weight + time_shift / interval``. The time shift is how much later than thought the ranges were taken:
what to add to the clock offset. Blocks: rig_from_world before (7,) and after (7,), two different frames; anchor in the
world (3,); range bias (1,). Then, as far as they are asked for and in this order: tag_in_cam (3,), time shift (1,),
amplitude (1,). Arguments and errors as for ``range_cost``, and

Args:
    weight: of all, or (n,) of each: from 0 (at the pose before) to 1 (at the pose after).
    offset_in_world_m: (3,) or (n, 3), what a curved path has beyond the straight line; it stays as it is, also where
        the lever arm is a block.
    interval_s: time from the keyframe before to that after, positive; given, the time shift is a block.
)";

ceres::CostFunction* MakeInterpolatedRangeCost(const Array& range_m, const Array& stddev_m,
                                               const OptionalArray& tag_in_cam_m, const Array& weight,
                                               const Array& offset_in_world_m, std::optional<double> interval_s,
                                               const Array& share, std::optional<double> short_range_length_m,
                                               double loss_scale, bool loss_is_bounded) {
  MeasuredRanges measured = Measured(range_m, stddev_m, share);
  RangeModel model = Model(tag_in_cam_m, short_range_length_m, loss_scale, loss_is_bounded);
  model.has_time_shift = interval_s.has_value();
  const Eigen::Index num_ranges = measured.range.size();
  InterpolatedPlace place(ForEachRange("weight", weight, num_ranges, Weight),
                          Vector3ForEachRange("offset_in_world_m", offset_in_world_m, num_ranges),
                          Positive("interval_s", interval_s.value_or(1.0)));
  return new RangeCost<InterpolatedPlace>(std::move(place), std::move(measured), std::move(model));
}

constexpr auto kDistanceCostDoc = R"(A distance between two ends a and b, by tape or by radio.

The residual is ``(||a - b|| + bias - distance) / stddev``. An end is a point in the world or fixed to a camera. Blocks:
of end a, then of end b, each a point (3,) or, where its place in the rig frame is given, rig_from_world (7,); then the
bias (1,), what is read too long, if there is one. The two ends are different blocks.

Args:
    distance_m: measured, positive.
    stddev_m: its noise, positive.
    a_in_cam_m, b_in_cam_m: (3,) the end in the rig frame; None for a point.
    has_bias: whether a bias is a block.
    loss_scale: of Geman and McClure's loss (see ``range_cost``), in stddevs, positive; infinite: least squares.

Raises:
    ValueError: as ``range_cost``.
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

constexpr auto kDirectionCostDoc = R"(A direction of the world that was seen from a camera, such as the vertical.

Three residuals, ``(R direction_in_world - direction_in_cam) / stddev``, of two degrees of freedom.
Block: rig_from_world (7,).

Args:
    direction_in_world, direction_in_cam: (3,) of any length but 0 ("cam" is the rig frame).
    stddev_rad: of the direction, as an angle, positive.

Raises:
    ValueError: as ``range_cost``.
)";

ceres::CostFunction* MakeDirectionCost(const Array& direction_in_world, const Array& direction_in_cam,
                                       double stddev_rad) {
  return new DirectionCost(Direction3("direction_in_world", direction_in_world),
                           Direction3("direction_in_cam", direction_in_cam), Positive("stddev_rad", stddev_rad));
}

constexpr auto kJointPriorCostDoc = R"(What was known beforehand of n numbers that are not independent.

The n residuals are ``whitening (x - mean)``. Blocks: each number for itself (1,), as the range biases of anchors, which
share the tag's.

Args:
    mean: (n,) in the blocks' unit.
    whitening: (n, n) ``whitening^T whitening`` is the inverse of the numbers' covariance.

Raises:
    ValueError: as ``range_cost``.
)";

ceres::CostFunction* MakeJointPriorCost(const Array& mean, const Array& whitening) {
  const Eigen::VectorXd means = FiniteVector("mean", mean);
  const Eigen::Index size = means.size();
  if (whitening.ndim() != 2 || whitening.shape(0) != size || whitening.shape(1) != size) {
    FailOnShape("whitening", whitening, std::to_string(size) + " rows and columns");
  }
  // C order: what Eigen takes for columns are rows.
  const Eigen::MatrixXd matrix = Eigen::Map<const Eigen::MatrixXd>(whitening.data(), size, size).transpose();
  CheckEach("whitening", matrix.reshaped(), Finite);
  return new JointPriorCost(means, matrix);
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
  m.doc() = "Cost functions of rangesfm; its package rangesfm.ceres is the door to them.";
  m.attr("pybind11_version") = PYBIND11_TOSTRING(PYBIND11_VERSION_MAJOR) "." PYBIND11_TOSTRING(
      PYBIND11_VERSION_MINOR) "." PYBIND11_TOSTRING(PYBIND11_VERSION_PATCH);
  m.attr("ceres_version") = CERES_VERSION_STRING;
  m.attr("pybind11_internals_version") = PYBIND11_INTERNALS_VERSION;

  m.def("range_cost", &rangesfm::MakeRangeCost, kOwn, rangesfm::kRangeCostDoc, py::kw_only(), arg("range_m"),
        arg("stddev_m"), arg("tag_in_cam_m"), arg("share") = 1.0, arg("short_range_length_m") = py::none(),
        arg("loss_scale") = kLeastSquares, arg("loss_is_bounded") = false);
  m.def("interpolated_range_cost", &rangesfm::MakeInterpolatedRangeCost, kOwn, rangesfm::kInterpolatedRangeCostDoc,
        py::kw_only(), arg("range_m"), arg("stddev_m"), arg("tag_in_cam_m"), arg("weight"), arg("offset_in_world_m"),
        arg("interval_s") = py::none(), arg("share") = 1.0, arg("short_range_length_m") = py::none(),
        arg("loss_scale") = kLeastSquares, arg("loss_is_bounded") = false);
  m.def("distance_cost", &rangesfm::MakeDistanceCost, kOwn, rangesfm::kDistanceCostDoc, py::kw_only(),
        arg("distance_m"), arg("stddev_m"), arg("a_in_cam_m") = py::none(), arg("b_in_cam_m") = py::none(),
        arg("has_bias") = false, arg("loss_scale") = kLeastSquares);
  m.def("direction_cost", &rangesfm::MakeDirectionCost, kOwn, rangesfm::kDirectionCostDoc, py::kw_only(),
        arg("direction_in_world"), arg("direction_in_cam"), arg("stddev_rad"));
  m.def("joint_prior_cost", &rangesfm::MakeJointPriorCost, kOwn, rangesfm::kJointPriorCostDoc, py::kw_only(),
        arg("mean"), arg("whitening"));
  m.def("zero_tie_cost", &rangesfm::MakeZeroTieCost, kOwn, "See beside_points.h.", py::kw_only(), arg("size_a"),
        arg("size_b"));
  m.def("padded_manifold", &rangesfm::MakePaddedManifold, kOwn, "See beside_points.h.", py::kw_only(), arg("size"),
        arg("tangent_size"));
}
