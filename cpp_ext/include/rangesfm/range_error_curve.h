#ifndef RANGESFM_RANGE_ERROR_CURVE_H_
#define RANGESFM_RANGE_ERROR_CURVE_H_

#include <Eigen/Core>
#include <algorithm>
#include <cmath>
#include <utility>

namespace rangesfm {

// What a radio reads too long as a function of the distance, up to a factor, and how that changes with the distance.
class RangeErrorCurve {
 public:
  struct Point {
    double value;
    double slope;
  };

  RangeErrorCurve() = default;
  RangeErrorCurve(const RangeErrorCurve&) = delete;
  RangeErrorCurve& operator=(const RangeErrorCurve&) = delete;
  virtual ~RangeErrorCurve() = default;

  virtual Point At(double distance) const = 0;
};

// exp(-distance / length): 1 where the antennas meet, next to nothing some lengths away.
class ExponentialCurve final : public RangeErrorCurve {
 public:
  explicit ExponentialCurve(double length) : inv_length_(1.0 / length) {}

  Point At(double distance) const override {
    const double value = std::exp(-distance * inv_length_);
    return {value, -value * inv_length_};
  }

 private:
  const double inv_length_;
};

// Through a table of n >= 2 points, with a continuous slope: a cubic Hermite spline whose slopes are those of the
// parabolas through three neighbours, and zero at the ends, beyond which the curve stays as it is.
class TabulatedCurve final : public RangeErrorCurve {
 public:
  // Distances increase strictly.
  TabulatedCurve(Eigen::VectorXd distance, Eigen::VectorXd value)
      : distance_(std::move(distance)), value_(std::move(value)), slope_(Eigen::VectorXd::Zero(distance_.size())) {
    for (Eigen::Index i = 1; i + 1 < distance_.size(); ++i) {
      const double before = distance_[i] - distance_[i - 1];
      const double after = distance_[i + 1] - distance_[i];
      const double slope_before = (value_[i] - value_[i - 1]) / before;
      const double slope_after = (value_[i + 1] - value_[i]) / after;
      slope_[i] = (after * slope_before + before * slope_after) / (before + after);
    }
  }

  Point At(double distance) const override {
    const Eigen::Index last = distance_.size() - 1;
    if (distance <= distance_[0]) {
      return {value_[0], 0.0};
    }
    if (distance >= distance_[last]) {
      return {value_[last], 0.0};
    }
    const double* const begin = distance_.data();
    const Eigen::Index i = std::upper_bound(begin, begin + last, distance) - begin - 1;
    const double width = distance_[i + 1] - distance_[i];
    const double x = (distance - distance_[i]) / width;
    const double rise = value_[i + 1] - value_[i];
    // Hermite's cubic: value_i + a x + b x^2 + c x^3 on [0, 1].
    const double a = width * slope_[i];
    const double c = a + width * slope_[i + 1] - 2.0 * rise;
    const double b = rise - a - c;
    return {value_[i] + x * (a + x * (b + x * c)), (a + x * (2.0 * b + x * 3.0 * c)) / width};
  }

 private:
  const Eigen::VectorXd distance_;
  const Eigen::VectorXd value_;
  Eigen::VectorXd slope_;
};

}  // namespace rangesfm

#endif  // RANGESFM_RANGE_ERROR_CURVE_H_
