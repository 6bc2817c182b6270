// Definitions of the members that two base classes of Ceres have outside of their headers.
//
// With these definitions the extension is built from Ceres' headers alone. No Ceres library is linked, statically or
// dynamically, none is needed on the system that the extension is installed on, and none can conflict with the copies
// of Ceres in pycolmap and pyceres.

#include <ceres/cost_function.h>
#include <ceres/manifold.h>

namespace ceres {

CostFunction::CostFunction() : num_residuals_(0) {}
CostFunction::~CostFunction() = default;

Manifold::~Manifold() = default;

// Every manifold of the extension overrides this function.
bool Manifold::RightMultiplyByPlusJacobian(const double* /*x*/, const int /*num_rows*/,
                                           const double* /*ambient_matrix*/, double* /*tangent_matrix*/) const {
  return false;
}

}  // namespace ceres
