#pragma once

#include <cmath>

namespace rangesfm {

// A robust loss inside a cost function. It applies to each residual separately, while a loss function of Ceres applies
// to the sum of squares of a whole residual block.
//
// Half the square of the value below is the loss of the residual r. Cauchy's loss, c^2 / 2 log(1 + r^2 / c^2), keeps
// growing and so leads to a minimum from farther away. Geman and McClure's loss, 1/2 r^2 / (1 + r^2 / c^2), never
// exceeds c^2 / 2. An infinite scale c means least squares. With x = r^2 / c^2:
//
//   Cauchy          value = r g,              slope = 1 / ((1 + x) g),  g = sqrt(log(1 + x) / x), which is 1 at 0
//   Geman-McClure   value = r / sqrt(1 + x),  slope = (1 + x)^-3/2
class RobustLoss {
 public:
  struct Robust {
    double value;
    double slope;  // derivative of the value with respect to the residual
  };

  // The robust residuals of a vector r are factor * r, with the derivative factor * I + along * r r^T.
  struct OfVector {
    double factor;
    double along;
  };

  RobustLoss() = default;
  RobustLoss(double scale, bool is_bounded) : inv_scale_(1.0 / scale), is_bounded_(is_bounded) {}

  Robust operator()(double residual) const {
    const double in_scales = residual * inv_scale_;
    const double x = in_scales * in_scales;
    if (x < kTiny) {
      return {residual, 1.0};
    }
    if (is_bounded_) {
      const double shrink = 1.0 / std::sqrt(1.0 + x);
      return {residual * shrink, shrink * shrink * shrink};
    }
    const double g = std::sqrt(std::log1p(x) / x);
    return {residual * g, 1.0 / ((1.0 + x) * g)};
  }

  // Makes the length n of a vector robust. With its robust value v and slope v': factor = v / n, along = (v' - v / n) /
  // n^2.
  OfVector ForLength(double length) const {
    if (length < kTinyLength) {
      return {1.0, 0.0};
    }
    const Robust robust = (*this)(length);
    const double factor = robust.value / length;
    return {factor, (robust.slope - factor) / (length * length)};
  }

 private:
  // For smaller x, value and slope equal those of least squares to the last digit.
  static constexpr double kTiny = 1e-17;
  static constexpr double kTinyLength = 1e-8;

  double inv_scale_ = 0.0;
  bool is_bounded_ = false;
};

}  // namespace rangesfm
