// What the base class of all manifolds has outside its header, for the extension.
//
// In Ceres' static library this stands in one object file with manifolds that need glog. Defined here, that file is not
// linked, and the extension goes on needing no library beyond the C++ runtime.

#include <ceres/manifold.h>

namespace ceres {

Manifold::~Manifold() = default;

// Every manifold of the extension has its own.
bool Manifold::RightMultiplyByPlusJacobian(const double* /*x*/, const int /*num_rows*/,
                                           const double* /*ambient_matrix*/, double* /*tangent_matrix*/) const {
  return false;
}

}  // namespace ceres
