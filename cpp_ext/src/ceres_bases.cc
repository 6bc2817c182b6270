// What the two base classes of Ceres that the extension derives from have outside their headers.
//
// Defined here, the extension is built from Ceres' headers alone: no Ceres is linked, static or shared, none needs to
// be on the system that it is installed on, and none meets the copies inside pycolmap and pyceres.

#include <ceres/cost_function.h>
#include <ceres/manifold.h>

namespace ceres {

CostFunction::CostFunction() : num_residuals_(0) {}
CostFunction::~CostFunction() = default;

Manifold::~Manifold() = default;

// Every manifold of the extension has its own.
bool Manifold::RightMultiplyByPlusJacobian(const double* /*x*/, const int /*num_rows*/,
                                           const double* /*ambient_matrix*/, double* /*tangent_matrix*/) const {
  return false;
}

}  // namespace ceres
