"""The compiled cost functions and pyceres. No other package imports either of them.

A range residual goes into the problem of one of pycolmap's bundle adjusters::

    adjuster = pycolmap.create_default_ceres_bundle_adjuster(options, config, reconstruction)
    cost = range_cost(range_m=4.2, tag_in_cam_m=[0, -0.09, -0.066], stddev_m=0.1, loss_scale=2.4)
    pose = reconstruction.frame(frame_id).rig_from_world.params
    add_residual_block(adjuster, cost, None, [pose, anchor_in_world, range_bias])
    adjuster.solve()

Poses are COLMAP's parameter blocks: rig_from_world as [qx qy qz qw tx ty tz]. "cam" is the rig frame (the frame of the
rig's reference camera). Units are metres, residuals are in standard deviations, and every value is checked when a cost
is created.

pycolmap, pyceres and the compiled part exchange C++ objects, which only works between the versions pinned in
``pyproject.toml``. The first use of anything here checks this, with a residual whose cost is known.
"""

from typing import TYPE_CHECKING, Any

from rangesfm.solver.adjuster_problem import (
    Step,
    add_residual_block,
    keep_from_elimination,
    num_columns,
    solve_adjuster,
    tangent_jacobian,
)
from rangesfm.solver.installation_checks import check_compatibility

if TYPE_CHECKING:
    from rangesfm._cpp import (
        direction_cost,
        distance_cost,
        inertial_cost,
        interpolated_range_cost,
        joint_prior_cost,
        position_cost,
        range_cost,
    )

__all__ = [
    "Step",
    "add_residual_block",
    "check_compatibility",
    "direction_cost",
    "distance_cost",
    "inertial_cost",
    "interpolated_range_cost",
    "joint_prior_cost",
    "keep_from_elimination",
    "num_columns",
    "position_cost",
    "range_cost",
    "solve_adjuster",
    "tangent_jacobian",
]

if not TYPE_CHECKING:

    def __getattr__(name: str) -> Any:
        """Return a compiled cost function, after checking that types are shared; it is documented where it is bound.

        Raises:
            SolverError: see ``check_compatibility``.
        """
        if name not in __all__:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        check_compatibility()
        from rangesfm import _cpp

        return getattr(_cpp, name)
