#ifndef RANGESFM_TWO_SIDED_LOSS_H_
#define RANGESFM_TWO_SIDED_LOSS_H_

#include <cmath>

namespace rangesfm {

// A robust loss inside a cost function, so that each of its residuals is judged for itself (one of Ceres' would judge
// the whole residual block by its sum of squares).
//
// Half the square of the value below is the loss of the residual r: Cauchy's, c^2 / 2 log(1 + r^2 / c^2), which grows
// on and so leads to a minimum from further away, or Geman and McClure's, 1/2 r^2 / (1 + r^2 / c^2), which no outlier
// raises beyond c^2 / 2. The scale c may be one of its own for ranges that are too long (predicted less than measured:
// r < 0), which reflections make likelier, and for those that are too short. An infinite scale is least squares. Value
// and slope are continuous also where the sides meet. With x = r^2 / c^2:
//
//   Cauchy          value = r g,              slope = 1 / ((1 + x) g),  g = sqrt(log(1 + x) / x), which is 1 at 0
//   Geman-McClure   value = r / sqrt(1 + x),  slope = (1 + x)^-3/2
class TwoSidedLoss {
 public:
  struct Robust {
    double value;
    double slope;  // derivative of the value with respect to the residual
  };

  TwoSidedLoss() = default;
  TwoSidedLoss(double scale_too_long, double scale_too_short, bool is_bounded = false)
      : inv_scale_too_long_(1.0 / scale_too_long),
        inv_scale_too_short_(1.0 / scale_too_short),
        is_bounded_(is_bounded) {}

  Robust operator()(double residual) const {
    const double in_scales = residual * (residual < 0.0 ? inv_scale_too_long_ : inv_scale_too_short_);
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

  double inv_scale_too_long_ = 0.0;
  double inv_scale_too_short_ = 0.0;
  bool is_bounded_ = false;
};

}  // namespace rangesfm

#endif  // RANGESFM_TWO_SIDED_LOSS_H_
