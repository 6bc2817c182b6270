#include <gtest/gtest.h>

#include "cost_testing.h"
#include "rangesfm/elimination_order.h"

namespace rangesfm {
namespace {

TEST(ZeroTieCost, IsZeroAndFlatWhateverTheBlocks) {
  const ZeroTieCost cost(1, 3);
  const std::vector<Block> blocks = {{7.0}, {1.0, -2.0, 1e6}};
  const Evaluation evaluation = Evaluate(cost, blocks);
  EXPECT_EQ(evaluation.residuals, std::vector<double>(2, 0.0));
  EXPECT_EQ(evaluation.jacobians[0], std::vector<double>(2, 0.0));
  EXPECT_EQ(evaluation.jacobians[1], std::vector<double>(6, 0.0));
  ExpectAnyJacobianMayBeLeftOut(cost, blocks);
}

}  // namespace
}  // namespace rangesfm
