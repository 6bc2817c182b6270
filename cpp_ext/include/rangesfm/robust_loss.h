#pragma once

#include <cmath>

namespace rangesfm {

// A robust loss inside a cost function, so that each of its residuals is judged for itself (one of Ceres' would judge
// the whole residual block by its sum of squares).
//
// Half the square of the value below is the loss of the residual r: Cauchy's, c^2 / 2 log(1 + r^2 / c^2), which grows
// on and so leads to a minimum from further away, or Geman and McClure's, 1/2 r^2 / (1 + r^2 / c^2), which no outlier
// raises beyond c^2 / 2. An infinite scale c is least squares. With x = r^2 / c^2:
//
//   Cauchy          value = r g,              slope = 1 / ((1 + x) g),  g = sqrt(log(1 + x) / x), which is 1 at 0
//   Geman-McClure   value = r / sqrt(1 + x),  slope = (1 + x)^-3/2
class RobustLoss {
 public:
  struct Robust {
    double value;
    double slope;  // derivative of the value with respect to the residual
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

 private:
  // Below it, value and slope are those of least squares to the last digit.
  static constexpr double kTiny = 1e-17;

  double inv_scale_ = 0.0;
  bool is_bounded_ = false;
};

}  // namespace rangesfm
