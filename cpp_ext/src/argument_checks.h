// Conversion of arguments from Python to Eigen's types, with checks. Checked arguments never fail in the solver.

#pragma once

#include <pybind11/numpy.h>
#include <pybind11/pybind11.h>

#include <Eigen/Core>
#include <cmath>
#include <string>

namespace rangesfm {

using Array = pybind11::array_t<double, pybind11::array::c_style | pybind11::array::forcecast>;

// Returns the value if it is as expected, and throws if not.
template <typename Value>
Value Checked(const std::string& name, Value value, bool is_as_expected, const std::string& expected) {
  if (!is_as_expected) {
    throw pybind11::value_error(name + " is " + std::to_string(value) + ", expected " + expected);
  }
  return value;
}

inline double Finite(const std::string& name, double value) {
  return Checked(name, value, std::isfinite(value), "a finite number");
}

inline double Positive(const std::string& name, double value) {
  return Checked(name, Finite(name, value), value > 0.0, "more than 0");
}

// Checks a loss scale; infinity means least squares.
inline double PositiveOrInfinite(const std::string& name, double value) {
  return std::isinf(value) && value > 0.0 ? value : Positive(name, value);
}

inline double Weight(const std::string& name, double value) {
  return Checked(name, Finite(name, value), value >= 0.0 && value <= 1.0, "a number from 0 to 1");
}

inline int BlockSize(const std::string& name, int value) { return Checked(name, value, value > 0, "1 or more"); }

[[noreturn]] inline void FailOnShape(const std::string& name, const Array& array, const std::string& expected) {
  throw pybind11::value_error(name + " has " + std::to_string(array.ndim()) + " dimensions and " +
                              std::to_string(array.size()) + " numbers, expected " + expected);
}

// Applies `check` to each number.
template <typename Check>
void CheckEach(const std::string& name, const Eigen::VectorXd& values, const Check& check) {
  for (const double value : values) {
    check(name, value);
  }
}

inline Eigen::VectorXd FiniteVector(const std::string& name, const Array& array) {
  if (array.ndim() != 1 || array.size() == 0) {
    FailOnShape(name, array, "one dimension and one number or more");
  }
  Eigen::VectorXd vector = Eigen::Map<const Eigen::VectorXd>(array.data(), array.size());
  CheckEach(name, vector, Finite);
  return vector;
}

inline Eigen::Vector3d FiniteVector3(const std::string& name, const Array& array) {
  if (array.ndim() != 1 || array.size() != 3) {
    FailOnShape(name, array, "one dimension and 3 numbers");
  }
  return FiniteVector(name, array);
}

// Returns a matrix from an array (rows, columns), of which Eigen::Dynamic stands for any number.
inline Eigen::MatrixXd FiniteMatrix(const std::string& name, const Array& array, Eigen::Index rows,
                                    Eigen::Index columns) {
  const auto is_right = [&array](int axis, Eigen::Index size) {
    return size == Eigen::Dynamic || array.shape(axis) == size;
  };
  if (array.ndim() != 2 || !is_right(0, rows) || !is_right(1, columns)) {
    const auto number = [](Eigen::Index size) {
      return size == Eigen::Dynamic ? "any number of" : std::to_string(size);
    };
    FailOnShape(name, array, number(rows) + " rows of " + number(columns) + " numbers");
  }
  using RowMajor = Eigen::Matrix<double, Eigen::Dynamic, Eigen::Dynamic, Eigen::RowMajor>;
  Eigen::MatrixXd matrix = Eigen::Map<const RowMajor>(array.data(), array.shape(0), array.shape(1));
  CheckEach(name, matrix.reshaped(), Finite);
  return matrix;
}

// Returns the vector scaled to length 1.
inline Eigen::Vector3d Direction3(const std::string& name, const Array& array) {
  const Eigen::Vector3d vector = FiniteVector3(name, array);
  if (vector.stableNorm() == 0.0) {
    throw pybind11::value_error(name + " is zero, expected a direction");
  }
  return vector.stableNormalized();
}

// Returns a vector (n,) with a number for each of n ranges, from such an array or from one number for all.
template <typename Check>
Eigen::VectorXd ForEachRange(const std::string& name, const Array& array, Eigen::Index num_ranges, const Check& check) {
  Eigen::VectorXd vector;
  if (array.ndim() == 0) {
    vector = Eigen::VectorXd::Constant(num_ranges, *array.data());
  } else if (array.ndim() == 1 && array.size() == num_ranges) {
    vector = Eigen::Map<const Eigen::VectorXd>(array.data(), num_ranges);
  } else {
    FailOnShape(name, array, "one number, or one for each of " + std::to_string(num_ranges) + " ranges");
  }
  CheckEach(name, vector, check);
  return vector;
}

// Returns a column for each of n ranges, from an array (n, 3), or from one vector (3,) for all.
inline Eigen::Matrix3Xd Vector3ForEachRange(const std::string& name, const Array& array, Eigen::Index num_ranges) {
  Eigen::Matrix3Xd columns;
  if (array.ndim() == 1 && array.size() == 3) {
    columns = Eigen::Map<const Eigen::Vector3d>(array.data()).replicate(1, num_ranges);
  } else if (array.ndim() == 2 && array.shape(0) == num_ranges && array.shape(1) == 3) {
    columns = Eigen::Map<const Eigen::Matrix3Xd>(array.data(), 3, num_ranges);
  } else {
    FailOnShape(name, array, "3 numbers, or 3 for each of " + std::to_string(num_ranges) + " ranges");
  }
  CheckEach(name, columns.reshaped(), Finite);
  return columns;
}

// Returns three columns for each of n matrices (n, 3, 3).
inline Eigen::Matrix3Xd Matrix3ForEach(const std::string& name, const Array& array, Eigen::Index num) {
  if (array.ndim() != 3 || array.shape(0) != num || array.shape(1) != 3 || array.shape(2) != 3) {
    FailOnShape(name, array, "3 x 3 numbers for each of " + std::to_string(num) + " positions");
  }
  Eigen::Matrix3Xd columns(3, 3 * num);
  for (Eigen::Index i = 0; i < num; ++i) {
    // The array is in C order, so that Eigen's columns are its rows.
    columns.middleCols<3>(3 * i) = Eigen::Map<const Eigen::Matrix3d>(array.data() + 9 * i).transpose();
  }
  CheckEach(name, columns.reshaped(), Finite);
  return columns;
}

}  // namespace rangesfm
