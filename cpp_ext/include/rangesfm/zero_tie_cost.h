#ifndef RANGESFM_ZERO_TIE_COST_H_
#define RANGESFM_ZERO_TIE_COST_H_

#include <ceres/cost_function.h>

#include <algorithm>

namespace rangesfm {

// Two residuals that are always zero and depend on nothing: they say that two blocks belong together, no more.
//
// Ceres solves bundle adjustment by first eliminating a set of blocks no two of which share a residual, chosen greedily
// from the blocks with the fewest neighbours: the 3-D points. A free anchor meets no point and so joins the set; so
// does a free bias. Then the blocks to eliminate are no longer all of size 3 in rows of 2, Ceres falls back from its
// specialised kernels (2,3,6 or 2,3,d) to the general one (d,d,d), and eliminating the anchor couples all the poses it
// was ranged from. Tied to a 3-D point that is seen in fewer images than the block has neighbours, it stays out of the
// set, and padded_manifold.h makes it as wide as a pose. Every free anchor and every free bias needs a tie of its own.
// Two rows, since a reprojection has two: the rows of the points must all be of that size.
//
// Blocks: any two, for example anchor_in_world (3) and a 3-D point (3).
class ZeroTieCost final : public ceres::CostFunction {
 public:
  ZeroTieCost(int size_a, int size_b) {
    set_num_residuals(kNumResiduals);
    *mutable_parameter_block_sizes() = {size_a, size_b};
  }

  bool Evaluate(double const* const* /*parameters*/, double* residuals, double** jacobians) const override {
    std::fill_n(residuals, kNumResiduals, 0.0);
    if (jacobians != nullptr) {
      for (int i = 0; i < 2; ++i) {
        if (jacobians[i] != nullptr) {
          std::fill_n(jacobians[i], kNumResiduals * parameter_block_sizes()[i], 0.0);
        }
      }
    }
    return true;
  }

 private:
  static constexpr int kNumResiduals = 2;
};

}  // namespace rangesfm

#endif  // RANGESFM_ZERO_TIE_COST_H_
