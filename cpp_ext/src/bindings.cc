// Factories of the cost functions and of a manifold for Python, checked at the gate.
//
// No class is bound. The factories return ceres::CostFunction or ceres::Manifold, types that pyceres registers, and
// give the object away: pyceres wraps it in the holder it chose itself, owns it and deletes it.

#include <ceres/cost_function.h>
#include <ceres/manifold.h>
#include <ceres/version.h>
#include <pybind11/numpy.h>
#include <pybind11/pybind11.h>
#include <pybind11/stl.h>

#include <Eigen/Core>
#include <limits>
#include <memory>
#include <optional>
#include <string>
#include <utility>

#include "gate.h"
#include "rangesfm/direction_cost.h"
#include "rangesfm/distance_cost.h"
#include "rangesfm/joint_prior_cost.h"
#include "rangesfm/normal_prior_cost.h"
#include "rangesfm/padded_manifold.h"
#include "rangesfm/range_cost.h"
#include "rangesfm/range_error_curve.h"
#include "rangesfm/tag_place.h"
#include "rangesfm/two_sided_loss.h"
#include "rangesfm/zero_tie_cost.h"

namespace py = pybind11;

namespace rangesfm {
namespace {

using OptionalArray = std::optional<Array>;

MeasuredRanges Measured(const Array& range_m, const Array& stddev_m, const Array& share) {
  if (range_m.ndim() > 1 || range_m.size() == 0) {
    FailOnShape("range_m", range_m, "one number, or one dimension and one number or more");
  }
  const Eigen::Index num_ranges = range_m.size();
  return {ForEachRange("range_m", range_m, num_ranges, Positive),
          ForEachRange("stddev_m", stddev_m, num_ranges, Positive), ForEachRange("share", share, num_ranges, Positive)};
}

// Distance and error in the two columns.
std::shared_ptr<const RangeErrorCurve> Tabulated(const Array& error_curve_m) {
  if (error_curve_m.ndim() != 2 || error_curve_m.shape(0) < 2 || error_curve_m.shape(1) != 2) {
    FailOnShape("error_curve_m", error_curve_m, "two columns and two rows or more");
  }
  const Eigen::Map<const Eigen::Matrix2Xd> columns(error_curve_m.data(), 2, error_curve_m.shape(0));
  CheckEach("error_curve_m", columns.reshaped(), Finite);
  const Eigen::VectorXd distance = columns.row(0);
  const Eigen::Index num_steps = distance.size() - 1;
  if ((distance.tail(num_steps).array() <= distance.head(num_steps).array()).any()) {
    throw py::value_error("error_curve_m: expected distances that increase from row to row");
  }
  return std::make_shared<TabulatedCurve>(distance, columns.row(1));
}

// What the three range costs have in common.
RangeModel Model(bool has_common_bias, std::optional<double> short_range_length_m, const OptionalArray& error_curve_m,
                 double loss_scale_too_long, double loss_scale_too_short, bool loss_is_bounded) {
  RangeModel model;
  model.has_common_bias = has_common_bias;
  if (short_range_length_m && error_curve_m) {
    throw py::value_error("short_range_length_m and error_curve_m are both given, expected one of them");
  }
  if (short_range_length_m) {
    model.error_curve = std::make_shared<ExponentialCurve>(Positive("short_range_length_m", *short_range_length_m));
  } else if (error_curve_m) {
    model.error_curve = Tabulated(*error_curve_m);
  }
  model.loss = TwoSidedLoss(PositiveOrInfinite("loss_scale_too_long", loss_scale_too_long),
                            PositiveOrInfinite("loss_scale_too_short", loss_scale_too_short), loss_is_bounded);
  return model;
}

std::optional<Eigen::Vector3d> LeverArm(const OptionalArray& tag_in_cam_m) {
  if (!tag_in_cam_m) {
    return std::nullopt;
  }
  return FiniteVector3("tag_in_cam_m", *tag_in_cam_m);
}

ceres::CostFunction* MakeFixedPoseRangeCost(MeasuredRanges measured, RangeModel model, const Array& tag_in_world_m) {
  const KnownPlace place(FiniteVector3("tag_in_world_m", tag_in_world_m));
  return new RangeCost<KnownPlace>(place, std::move(measured), std::move(model));
}

ceres::CostFunction* MakeRangeCost(MeasuredRanges measured, RangeModel model, const OptionalArray& tag_in_cam_m) {
  model.tag_in_cam = LeverArm(tag_in_cam_m);
  return new RangeCost<KeyframePlace>(KeyframePlace(), std::move(measured), std::move(model));
}

ceres::CostFunction* MakeInterpolatedRangeCost(MeasuredRanges measured, RangeModel model,
                                               const OptionalArray& tag_in_cam_m, const Array& weight,
                                               const Array& offset_in_world_m, std::optional<double> interval_s,
                                               const OptionalArray& offset_velocity_in_world_m_per_s) {
  const Eigen::Index num_ranges = measured.range.size();
  model.tag_in_cam = LeverArm(tag_in_cam_m);
  model.has_time_shift = interval_s.has_value();
  Eigen::Matrix3Xd offset_velocity = Eigen::Matrix3Xd::Zero(3, num_ranges);
  if (offset_velocity_in_world_m_per_s) {
    offset_velocity =
        Vector3ForEachRange("offset_velocity_in_world_m_per_s", *offset_velocity_in_world_m_per_s, num_ranges);
  }
  InterpolatedPlace place(ForEachRange("weight", weight, num_ranges, Weight),
                          Vector3ForEachRange("offset_in_world_m", offset_in_world_m, num_ranges),
                          Positive("interval_s", interval_s.value_or(1.0)), std::move(offset_velocity));
  return new RangeCost<InterpolatedPlace>(std::move(place), std::move(measured), std::move(model));
}

template <typename EndA, typename EndB>
ceres::CostFunction* MakeDistanceCostBetween(double distance_m, const EndA& a, const EndB& b, double stddev_m,
                                             bool has_bias, double loss_scale) {
  PositiveOrInfinite("loss_scale", loss_scale);
  return new DistanceCost<EndA, EndB>(Positive("distance_m", distance_m), a, b, Positive("stddev_m", stddev_m),
                                      has_bias, TwoSidedLoss(loss_scale, loss_scale, true));
}

ceres::CostFunction* MakeDistanceCost(double distance_m, double stddev_m, const OptionalArray& a_in_cam_m,
                                      const OptionalArray& b_in_cam_m, bool has_bias, double loss_scale) {
  if (a_in_cam_m && b_in_cam_m) {
    return MakeDistanceCostBetween(distance_m, CamEnd(FiniteVector3("a_in_cam_m", *a_in_cam_m)),
                                   CamEnd(FiniteVector3("b_in_cam_m", *b_in_cam_m)), stddev_m, has_bias, loss_scale);
  }
  if (a_in_cam_m) {
    return MakeDistanceCostBetween(distance_m, CamEnd(FiniteVector3("a_in_cam_m", *a_in_cam_m)), PointEnd(), stddev_m,
                                   has_bias, loss_scale);
  }
  if (b_in_cam_m) {
    return MakeDistanceCostBetween(distance_m, PointEnd(), CamEnd(FiniteVector3("b_in_cam_m", *b_in_cam_m)), stddev_m,
                                   has_bias, loss_scale);
  }
  return MakeDistanceCostBetween(distance_m, PointEnd(), PointEnd(), stddev_m, has_bias, loss_scale);
}

ceres::CostFunction* MakeDirectionCost(const Array& direction_in_world, const Array& direction_in_cam,
                                       double stddev_rad) {
  return new DirectionCost(Direction3("direction_in_world", direction_in_world),
                           Direction3("direction_in_cam", direction_in_cam), Positive("stddev_rad", stddev_rad));
}

ceres::CostFunction* MakeNormalPriorCost(const Array& mean, const Array& stddev) {
  const Eigen::VectorXd means = FiniteVector("mean", mean);
  const Eigen::VectorXd stddevs = FiniteVector("stddev", stddev);
  if (means.size() != stddevs.size()) {
    throw py::value_error("mean has " + std::to_string(means.size()) + " numbers and stddev " +
                          std::to_string(stddevs.size()) + ", expected as many");
  }
  CheckEach("stddev", stddevs, Positive);
  return new NormalPriorCost(means, stddevs);
}

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
  if (BlockSize("size", size) > BlockSize("tangent_size", tangent_size)) {
    throw py::value_error("tangent_size is " + std::to_string(tangent_size) + ", expected at least the block's size, " +
                          std::to_string(size));
  }
  return new PaddedManifold(size, tangent_size);
}

constexpr double kLeastSquares = std::numeric_limits<double>::infinity();
constexpr auto kOwn = py::return_value_policy::take_ownership;

// A factory of range costs at one kind of place: the ranges, what is particular to the place, and the model that all
// have in common.
template <typename... OfPlace, typename... PlaceArguments>
void DefineRangeCost(py::module_& m, const char* name,
                     ceres::CostFunction* (*make)(MeasuredRanges, RangeModel, OfPlace...),
                     const PlaceArguments&... place_arguments) {
  m.def(
      name,
      [make](const Array& range_m, const Array& stddev_m, OfPlace... of_place, const Array& share, bool has_common_bias,
             std::optional<double> short_range_length_m, const OptionalArray& error_curve_m, double loss_scale_too_long,
             double loss_scale_too_short, bool loss_is_bounded) {
        return make(Measured(range_m, stddev_m, share),
                    Model(has_common_bias, short_range_length_m, error_curve_m, loss_scale_too_long,
                          loss_scale_too_short, loss_is_bounded),
                    of_place...);
      },
      kOwn, py::kw_only(), py::arg("range_m"), py::arg("stddev_m"), place_arguments..., py::arg("share") = 1.0,
      py::arg("has_common_bias") = false, py::arg("short_range_length_m") = py::none(),
      py::arg("error_curve_m") = py::none(), py::arg("loss_scale_too_long") = kLeastSquares,
      py::arg("loss_scale_too_short") = kLeastSquares, py::arg("loss_is_bounded") = false);
}

}  // namespace
}  // namespace rangesfm

PYBIND11_MODULE(_cpp, m) {
  m.doc() = "Cost functions of rangesfm; rangesfm._ceres documents and wraps them.";
  m.attr("version") = RANGESFM_VERSION;
  m.attr("ceres_version") = CERES_VERSION_STRING;
  m.attr("pybind11_version") = PYBIND11_TOSTRING(PYBIND11_VERSION_MAJOR) "." PYBIND11_TOSTRING(
      PYBIND11_VERSION_MINOR) "." PYBIND11_TOSTRING(PYBIND11_VERSION_PATCH);
  m.attr("pybind11_internals_version") = PYBIND11_INTERNALS_VERSION;

  rangesfm::DefineRangeCost(m, "fixed_pose_range_cost", &rangesfm::MakeFixedPoseRangeCost, py::arg("tag_in_world_m"));
  rangesfm::DefineRangeCost(m, "range_cost", &rangesfm::MakeRangeCost, py::arg("tag_in_cam_m"));
  rangesfm::DefineRangeCost(m, "interpolated_range_cost", &rangesfm::MakeInterpolatedRangeCost, py::arg("tag_in_cam_m"),
                            py::arg("weight"), py::arg("offset_in_world_m"), py::arg("interval_s") = py::none(),
                            py::arg("offset_velocity_in_world_m_per_s") = py::none());
  m.def("distance_cost", &rangesfm::MakeDistanceCost, rangesfm::kOwn, py::kw_only(), py::arg("distance_m"),
        py::arg("stddev_m"), py::arg("a_in_cam_m"), py::arg("b_in_cam_m"), py::arg("has_bias"), py::arg("loss_scale"));
  m.def("direction_cost", &rangesfm::MakeDirectionCost, rangesfm::kOwn, py::kw_only(), py::arg("direction_in_world"),
        py::arg("direction_in_cam"), py::arg("stddev_rad"));
  m.def("normal_prior_cost", &rangesfm::MakeNormalPriorCost, rangesfm::kOwn, py::kw_only(), py::arg("mean"),
        py::arg("stddev"));
  m.def("joint_prior_cost", &rangesfm::MakeJointPriorCost, rangesfm::kOwn, py::kw_only(), py::arg("mean"),
        py::arg("whitening"));
  m.def("zero_tie_cost", &rangesfm::MakeZeroTieCost, rangesfm::kOwn, py::kw_only(), py::arg("size_a"),
        py::arg("size_b"));
  m.def("padded_manifold", &rangesfm::MakePaddedManifold, rangesfm::kOwn, py::kw_only(), py::arg("size"),
        py::arg("tangent_size"));
}
