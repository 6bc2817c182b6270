// Factories of the cost functions for Python, checked at the gate: what passes here never fails in the solver.
//
// No class is bound. The factories return ceres::CostFunction, a type that pyceres registers, and give the object
// away: pyceres wraps it in the holder it chose itself, owns it and deletes it.

#include <ceres/cost_function.h>
#include <ceres/version.h>
#include <pybind11/numpy.h>
#include <pybind11/pybind11.h>

#include <Eigen/Core>
#include <cmath>
#include <string>

#include "rangesfm/fixed_pose_range_cost.h"
#include "rangesfm/interpolated_range_cost.h"
#include "rangesfm/normal_prior_cost.h"
#include "rangesfm/range_cost.h"
#include "rangesfm/zero_tie_cost.h"

namespace py = pybind11;

namespace rangesfm {
namespace {

using Array = py::array_t<double, py::array::c_style | py::array::forcecast>;

double Finite(const std::string& name, double value) {
  if (!std::isfinite(value)) {
    throw py::value_error(name + " is " + std::to_string(value) + ", expected a finite number");
  }
  return value;
}

double Positive(const std::string& name, double value) {
  if (Finite(name, value) <= 0.0) {
    throw py::value_error(name + " is " + std::to_string(value) + ", expected more than 0");
  }
  return value;
}

double Weight(const std::string& name, double value) {
  if (Finite(name, value) < 0.0 || value > 1.0) {
    throw py::value_error(name + " is " + std::to_string(value) + ", expected a number from 0 to 1");
  }
  return value;
}

int BlockSize(const std::string& name, int value) {
  if (value <= 0) {
    throw py::value_error(name + " is " + std::to_string(value) + ", expected 1 or more");
  }
  return value;
}

Eigen::VectorXd FiniteVector(const std::string& name, const Array& array) {
  if (array.ndim() != 1 || array.size() == 0) {
    throw py::value_error(name + " has " + std::to_string(array.ndim()) + " dimensions and " +
                          std::to_string(array.size()) + " numbers, expected one dimension and one number or more");
  }
  const Eigen::Map<const Eigen::VectorXd> vector(array.data(), array.size());
  for (const double value : vector) {
    Finite(name, value);
  }
  return vector;
}

Eigen::Vector3d FiniteVector3(const std::string& name, const Array& array) {
  if (array.ndim() != 1 || array.size() != 3) {
    throw py::value_error(name + " has " + std::to_string(array.ndim()) + " dimensions and " +
                          std::to_string(array.size()) + " numbers, expected one dimension and 3 numbers");
  }
  return FiniteVector(name, array);
}

ceres::CostFunction* MakeRangeCost(double range_m, const Array& tag_in_cam_m, double stddev_m) {
  return new RangeCost(Positive("range_m", range_m), FiniteVector3("tag_in_cam_m", tag_in_cam_m),
                       Positive("stddev_m", stddev_m));
}

ceres::CostFunction* MakeFixedPoseRangeCost(double range_m, const Array& tag_in_world_m, double stddev_m) {
  return new FixedPoseRangeCost(Positive("range_m", range_m), FiniteVector3("tag_in_world_m", tag_in_world_m),
                                Positive("stddev_m", stddev_m));
}

ceres::CostFunction* MakeInterpolatedRangeCost(double range_m, const Array& tag_in_cam_m, double weight,
                                               const Array& offset_in_world_m, double stddev_m) {
  return new InterpolatedRangeCost(Positive("range_m", range_m), FiniteVector3("tag_in_cam_m", tag_in_cam_m),
                                   Weight("weight", weight), FiniteVector3("offset_in_world_m", offset_in_world_m),
                                   Positive("stddev_m", stddev_m));
}

ceres::CostFunction* MakeNormalPriorCost(const Array& mean, const Array& stddev) {
  const Eigen::VectorXd means = FiniteVector("mean", mean);
  const Eigen::VectorXd stddevs = FiniteVector("stddev", stddev);
  if (means.size() != stddevs.size()) {
    throw py::value_error("mean has " + std::to_string(means.size()) + " numbers and stddev " +
                          std::to_string(stddevs.size()) + ", expected as many");
  }
  for (const double value : stddevs) {
    Positive("stddev", value);
  }
  return new NormalPriorCost(means, stddevs);
}

ceres::CostFunction* MakeZeroTieCost(int size_a, int size_b) {
  return new ZeroTieCost(BlockSize("size_a", size_a), BlockSize("size_b", size_b));
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

  constexpr auto kOwn = py::return_value_policy::take_ownership;
  m.def("range_cost", &rangesfm::MakeRangeCost, kOwn, py::kw_only(), py::arg("range_m"), py::arg("tag_in_cam_m"),
        py::arg("stddev_m"));
  m.def("fixed_pose_range_cost", &rangesfm::MakeFixedPoseRangeCost, kOwn, py::kw_only(), py::arg("range_m"),
        py::arg("tag_in_world_m"), py::arg("stddev_m"));
  m.def("interpolated_range_cost", &rangesfm::MakeInterpolatedRangeCost, kOwn, py::kw_only(), py::arg("range_m"),
        py::arg("tag_in_cam_m"), py::arg("weight"), py::arg("offset_in_world_m"), py::arg("stddev_m"));
  m.def("normal_prior_cost", &rangesfm::MakeNormalPriorCost, kOwn, py::kw_only(), py::arg("mean"), py::arg("stddev"));
  m.def("zero_tie_cost", &rangesfm::MakeZeroTieCost, kOwn, py::kw_only(), py::arg("size_a"), py::arg("size_b"));
}
