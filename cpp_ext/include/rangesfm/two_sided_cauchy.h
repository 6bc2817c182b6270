#ifndef RANGESFM_TWO_SIDED_CAUCHY_H_
#define RANGESFM_TWO_SIDED_CAUCHY_H_

#include <cmath>

namespace rangesfm {

// A robust loss inside a cost function, so that each of its residuals is judged for itself (one of Ceres' would judge
// the whole residual block by its sum of squares).
//
// Half the square of the value below is Cauchy's loss of the residual r, c^2 / 2 log(1 + r^2 / c^2), with a scale c of
// its own for ranges that are too long (predicted less than measured: r < 0), which reflections make likelier, and for
// those that are too short. An infinite scale is least squares. Value and slope are continuous also where the sides
// meet: value = r g, slope = 1 / ((1 + x) g), with x = r^2 / c^2 and g = sqrt(log(1 + x) / x), which is 1 at 0.
class TwoSidedCauchy {
 public:
  struct Robust {
    double value;
    double slope;  // derivative of the value with respect to the residual
  };

  TwoSidedCauchy() = default;
  TwoSidedCauchy(double scale_too_long, double scale_too_short)
      : inv_scale_too_long_(1.0 / scale_too_long), inv_scale_too_short_(1.0 / scale_too_short) {}

  Robust operator()(double residual) const {
    const double in_scales = residual * (residual < 0.0 ? inv_scale_too_long_ : inv_scale_too_short_);
    const double x = in_scales * in_scales;
    if (x < kTiny) {
      return {residual, 1.0};
    }
    const double g = std::sqrt(std::log1p(x) / x);
    return {residual * g, 1.0 / ((1.0 + x) * g)};
  }

 private:
  // Below it, g is 1 to the last digit.
  static constexpr double kTiny = 1e-17;

  double inv_scale_too_long_ = 0.0;
  double inv_scale_too_short_ = 0.0;
};

}  // namespace rangesfm

#endif  // RANGESFM_TWO_SIDED_CAUCHY_H_
