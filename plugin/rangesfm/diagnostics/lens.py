"""Test of the lens: whether the photos ask for a richer camera model, and lengths in the map change with it.

A lens that does not fit its camera model bends the map, and the residuals of ranges or points hardly show it. So the
photos are asked themselves: all of them are adjusted again, first with the cameras as they are, then with a camera
model that has more parameters, all of them free.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pycolmap
from scipy import special
from scipy.spatial.distance import pdist

from rangesfm import solver
from rangesfm.colmap.reprojection import point_errors
from rangesfm.diagnostics.scale_bound import RISK
from rangesfm.errors import SolverError
from rangesfm.estimation.photo_bending import LARGEST_FACTOR, MEDIAN_FACTOR
from rangesfm.measurements.kind import Doubt
from rangesfm.options import CameraOptions, RefineOptions
from rangesfm.solver.bundle_adjustment import bundle_adjustment, keyframe_centers
from rangesfm.util.geometry.numerics import DOUBTFUL_ABOVE
from rangesfm.util.geometry.similarity import align_points

# For each of COLMAP's camera models one that contains it. All others are tested with other parameters of their own.
_RICHER = {
    "SIMPLE_PINHOLE": "OPENCV",
    "PINHOLE": "OPENCV",
    "SIMPLE_RADIAL": "OPENCV",
    "RADIAL": "OPENCV",
    "OPENCV": "FULL_OPENCV",
    "SIMPLE_RADIAL_FISHEYE": "OPENCV_FISHEYE",
    "RADIAL_FISHEYE": "OPENCV_FISHEYE",
    "OPENCV_FISHEYE": "THIN_PRISM_FISHEYE",
}
# Parameters that the richer models have more of: f is fx and fy, and a single k is k1.
_ORIGIN = {"fx": "f", "fy": "f", "k1": "k"}
# Trust region with which a free lens begins. Parameters of a rational distortion can hardly be told apart, so that
# free steps fail; a chain of 600 photos still bends as it does in them.
_TRUST_REGION_RADIUS = 1e6


def doubts_of_lens(model: pycolmap.Reconstruction, bending_factor: float, half_width_95: float) -> tuple[Doubt, ...]:
    """Return a doubt if the lens does not fit, and lengths are wrong by more than a good map's because of it.

    They are if they change by more than the scale's interval, or by more than any good scale's. Nothing is said where
    the points are too few to tell, or the solver fails.

    Errors of real features are alike in neighbouring photos, so that they bend a map by a multiple of what independent
    errors would. The gain, by how much a richer lens lowers the sum of squares over its variance, grows with the square
    of that: with the true lens of Strecha's fountain it is 10 to 13 times what independent errors give. So much may be
    gained with a lens that fits.

    Args:
        model: with points; it is not changed.
        bending_factor: that multiple, as the refinement has learnt it.
        half_width_95: of the scale's interval, relative.
    """
    own, richer = pycolmap.Reconstruction(model), pycolmap.Reconstruction(model)
    for camera in richer.cameras.values():
        _enrich(camera)
    least_change = min(half_width_95, DOUBTFUL_ABOVE)
    try:
        after = _adjust(richer, lens_is_free=True)
        if _change_of_lengths(model, richer) <= least_change:
            return ()
        before = _adjust(own, lens_is_free=False)
    except SolverError:
        return ()
    gain = (before.final_cost - after.final_cost) * after.num_residuals / after.final_cost
    factor = float(np.clip(bending_factor, MEDIAN_FACTOR, LARGEST_FACTOR))
    num_params = sum(len(camera.params) for camera in richer.cameras.values())
    change_95 = _change_of_lengths(own, richer)
    if gain < factor**2 * special.chdtri(num_params, RISK) or change_95 <= least_change:
        return ()
    name, richer_name = _names_of_models(own), _names_of_models(richer)
    is_richer = name != richer_name
    reason = (
        f"the lens is not as the camera model {name} has it: with {richer_name if is_richer else 'other parameters'}, "
        f"the map fits the photos to {point_errors(richer).median_px:.2f} px instead of "
        f"{point_errors(own).median_px:.2f} px, and lengths in it change by up to {100 * change_95:.1f} %"
    )
    calibrate = "calibrate the camera and give model and params in [camera]"
    again = f"map the photos again with --camera_model {richer_name}, or " if is_richer else ""
    return (Doubt(reason, again + calibrate),)


def _enrich(camera: pycolmap.Camera) -> None:
    """Give a camera the model that contains its own, with parameters that mean the same."""
    if (name := _RICHER.get(camera.model_name)) is None:
        return
    known = dict(zip(_names_of_params(camera), camera.params, strict=True))
    other = pycolmap.Camera.create_from_model_name(camera.camera_id, name, 1.0, camera.width, camera.height)
    params = [known.get(param, known.get(_ORIGIN.get(param, ""), 0.0)) for param in _names_of_params(other)]
    camera.model, camera.params = other.model, params


def _names_of_params(camera: pycolmap.Camera) -> list[str]:
    return [name.strip() for name in camera.params_info.split(",")]


def _names_of_models(model: pycolmap.Reconstruction) -> str:
    return " and ".join(sorted({camera.model_name for camera in model.cameras.values()}))


def _adjust(model: pycolmap.Reconstruction, *, lens_is_free: bool) -> Any:
    """Adjust all photos of a model in place and return Ceres' summary.

    Raises:
        SolverError: too little takes part, the photos fit without any error, or the solver fails.
    """
    lens = dict.fromkeys(("refine_focal_length", "refine_extra_params", "refine_principal_point"), lens_is_free)
    # By this loss, wrong matches do not outweigh a lens.
    of_solver = {"function_tolerance": 1e-3}
    if lens_is_free:
        of_solver["initial_trust_region_radius"] = _TRUST_REGION_RADIUS
    ceres_options = {"loss_function_type": "SOFT_L1", "solver_options": of_solver}
    options = RefineOptions(
        max_num_iterations=30,
        bundle_adjustment={**lens, "refine_sensor_from_rig": False, "ceres": ceres_options},
    )
    frame_id = min(model.reg_frame_ids())
    adjuster = bundle_adjustment(model, CameraOptions(), options, fixed_frame_ids=(frame_id,), num_threads=1).adjuster
    if adjuster.problem.num_residuals() <= adjuster.problem.num_parameters():
        raise SolverError("the photos see too few points to tell anything of the lens")
    summary = solver.solve_adjuster(adjuster, lambda step: False)
    if not (summary.IsSolutionUsable() and summary.final_cost > 0):
        raise SolverError(f"the adjustment for the lens failed: {summary.message}")
    return summary


def _change_of_lengths(model: pycolmap.Reconstruction, other: pycolmap.Reconstruction) -> float:
    """Return the relative change of lengths in the map that 95 % of the longer half do not exceed.

    Lengths are between points, of those that many photos see. Keyframes alone would hide what pixels of another height
    do to photos that were taken upright: the map becomes higher, and a level path stays as it was. The size of the
    whole map does not count, because ranges or positions on the path give it.
    """
    to_model = align_points(keyframe_centers(other), keyframe_centers(model))
    by_id = sorted(model.points3D.items())
    lengths_of_tracks = np.array([point.track.length() for _, point in by_id])
    often_seen = np.flatnonzero(lengths_of_tracks >= np.median(lengths_of_tracks))
    some = often_seen[np.unique(np.linspace(0, len(often_seen) - 1, 300).astype(np.int64))]
    places = np.array([by_id[k][1].xyz for k in some])
    others = to_model.apply(np.array([other.point3D(by_id[k][0]).xyz for k in some]))
    lengths, other_lengths = pdist(places), pdist(others)
    is_long = lengths >= np.median(lengths)
    return float(np.quantile(np.abs(other_lengths[is_long] / lengths[is_long] - 1), 0.95))
