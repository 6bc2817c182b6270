"""MapProblem: a map and its measurements, as every step of a refinement has them (sections 1 and 2)."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import pycolmap
from scipy.optimize import approx_fprime

from rangesfm import solver
from rangesfm.arrays import Array, Indices
from rangesfm.colmap.calibrated_cameras import cameras_as_given
from rangesfm.errors import InputError
from rangesfm.measurements.kind import Block, MapState, Measurements
from rangesfm.measurements.lengths.tape import Marker
from rangesfm.options import CameraOptions, RefineOptions
from rangesfm.solver.bundle_adjustment import BundleAdjustment, bundle_adjustment
from rangesfm.solver.normal_equations import NormalEquations
from rangesfm.util.geometry.numerics import ROUNDING
from rangesfm.util.geometry.poses import frames_in_order, model_poses
from rangesfm.util.geometry.trajectory import Trajectory, pose_of


@dataclass(frozen=True)
class MapProblem:
    """A model, which changes in place, and its measurements.

    Attributes:
        metric: the model.
        kinds: the measurements, priors among them.
        timed_ids: ids of the frames to whose indices the measurements refer, in this order.
        first_pose_is_fixed: the gauge.
        is_refined: whether the model was refined with its measurements before, which pull it from the photos' optimum.
        marker_ids: 3-D points of the model that are marks, by name.
        left_out_ids: 3-D points that do not take part.
        visible_m: movement of a camera that moves a feature by its standard deviation. It says what matters in a map
            without measurements, in the unit of the map.
        predicted: measurements of which none takes part, so that they are only predicted.
    """

    metric: pycolmap.Reconstruction
    kinds: tuple[Measurements, ...]
    timed_ids: Indices
    camera: CameraOptions
    options: RefineOptions
    first_pose_is_fixed: bool
    num_threads: int
    is_refined: bool = False
    marker_ids: Mapping[str, int] = field(default_factory=dict)
    left_out_ids: frozenset[int] = frozenset()
    visible_m: float = 0.0
    predicted: tuple[Measurements, ...] = ()

    @property
    def frame_ids(self) -> Indices:
        """Ids of all frames: those to whose indices the measurements refer, then the others."""
        return frames_in_order(self.metric, self.timed_ids)

    @property
    def markers(self) -> Mapping[str, Marker]:
        """Marks in photos to which the measurements refer, by name."""
        return {name: marker for kind in self.kinds for name, marker in kind.markers.items()}

    @property
    def measured(self) -> tuple[Measurements, ...]:
        """All measurements, also those that are only predicted."""
        return (*self.kinds, *self.predicted)

    @property
    def held_frame(self) -> int:
        """Index of the frame that is held while nothing else places the map; -1 where measurements do."""
        return 0 if self.first_pose_is_fixed or not any(kind.places_map for kind in self.kinds) else -1

    @property
    def start(self) -> MapState:
        """The model as it is, with the start values of all blocks."""
        return MapState(
            model_poses(self.metric, self.frame_ids), {name: at for of in self.kinds for name, at in of.blocks.items()}
        )

    def replaced(self, change: Callable[[int, Measurements], Measurements]) -> MapProblem:
        """Return the problem with each kind changed, given its index and the kind."""
        return replace(self, kinds=tuple(change(k, kind) for k, kind in enumerate(self.kinds)))

    def residuals(self, state: MapState) -> list[Array]:
        """Return the (g, d) residuals of each kind."""
        return [kind.linearize(state).residual for kind in self.kinds]

    def like(self, kinds: Sequence[Measurements]) -> MapProblem:
        """Return the problem with the noise that these have, which are the same measurements."""
        return self.replaced(lambda k, kind: kind.like(kinds[k]))

    def with_noise_of(self, state: MapState, num_absorbed: Sequence[float]) -> MapProblem:
        """Return the problem with the noise that the residuals of a state show; arguments as for each kind."""
        residuals = self.residuals(state)
        return self.replaced(lambda k, kind: kind.with_noise_of(residuals[k], num_absorbed[k]))

    def change(self, other: MapProblem) -> float:
        """Return the largest difference of the logarithms of the roots of a measurement's information."""
        return max((a.change(b) for a, b in zip(self.kinds, other.kinds, strict=True)), default=0.0)

    @property
    def smallest_stddev(self) -> float:
        """Smallest standard deviation of a measurement, metres; that of a camera's place without measurements."""
        return min(float(of.min()) for of in self._stddevs_m)

    @property
    def usual_stddev(self) -> float:
        """Smallest, among the kinds, of their median standard deviations, metres; without measurements as above."""
        return min(float(np.median(of)) for of in self._stddevs_m)

    @property
    def _stddevs_m(self) -> list[Array]:
        """Standard deviations of the measurements, the root of the mean variance of their coordinates, by kind."""
        roots = [kind.weights.root_information for kind in self.kinds if kind.counts_in_metres]
        if not roots:
            return [np.array([self.visible_m])]
        return [np.linalg.norm(np.linalg.inv(of), axis=(1, 2)) / np.sqrt(of.shape[1]) for of in roots]

    def of_photos(self, max_num_iterations: int) -> BundleAdjustment:
        """Set up the bundle adjustment of the photos alone."""
        return bundle_adjustment(
            self.metric,
            self.camera,
            self.options.changed(max_num_iterations=max_num_iterations),
            fixed_frame_ids=self.timed_ids[:1].tolist() if self.first_pose_is_fixed else (),
            num_threads=self.num_threads,
            marker_ids=self.marker_ids.values(),
            left_out_ids=self.left_out_ids - set(self.marker_ids.values()),
        )

    def add_to(self, adjustment: BundleAdjustment, start: Mapping[Block, Array]) -> dict[Block, Array]:
        """Add all measurements and priors of calibrated cameras, and return their blocks, at first at these values."""
        problem = adjustment.adjuster.problem
        poses = [pose_of(self.metric.frame(int(frame_id))).params for frame_id in self.timed_ids]
        marks = {("mark", name): self.metric.point3D(id_).xyz for name, id_ in self.marker_ids.items()}
        own = {name: np.array(at, dtype=np.float64) for name, at in start.items() if name[0] != "mark"}
        blocks: dict[Block, Array] = {**own, **marks}
        for kind in self.kinds:
            kind.add_to(adjustment, poses, blocks)
        fixed = frozenset[Block]().union(*(kind.fixed for kind in self.kinds))
        for name, block in blocks.items():
            if not problem.has_parameter_block(block):
                continue
            if name in fixed:
                problem.set_parameter_block_constant(block)
            else:
                adjustment.keep_from_elimination(block)
        add_calibration(adjustment, self.camera)
        return blocks

    def state(self, blocks: Mapping[Block, Array]) -> MapState:
        """Return the poses and the values of these parameter blocks as they are."""
        poses = model_poses(self.metric, [int(frame_id) for frame_id in self.frame_ids])
        return MapState(poses, {name: block.copy() for name, block in blocks.items()})


def map_problem(
    metric: pycolmap.Reconstruction,
    kinds: Sequence[Measurements],
    trajectory: Trajectory,
    *,
    camera: CameraOptions,
    options: RefineOptions,
    first_pose_is_fixed: bool,
    is_refined: bool,
    num_threads: int,
) -> MapProblem:
    """Return the problem of a metric model and its measurements with their priors.

    Args:
        kinds: with the noise to begin with. trajectory: of the unscaled model. Others as in the problem.

    Raises:
        InputError: the offset of a clock is to be estimated without times.
    """
    if options.time_offset_stddev_s and trajectory.timestamps_s is None:
        raise InputError("[refine] time_offset_stddev_s needs a log with times, this one names photos")
    used = [kind for kind in kinds if kind.takes_part]
    return MapProblem(
        metric,
        (*used, *(prior for kind in used for prior in kind.priors())),
        trajectory.frame_ids,
        camera,
        options,
        first_pose_is_fixed,
        num_threads,
        is_refined,
        predicted=tuple(kind for kind in kinds if not kind.takes_part),
    )


def equations_of(adjustment: BundleAdjustment, blocks: Mapping[Block, Array]) -> NormalEquations:
    """Return the normal equations of a bundle adjustment with parameter blocks of measurements, at its state."""
    return NormalEquations.of(
        adjustment.adjuster.problem,
        adjustment.metric,
        adjustment.num_reprojections,
        [block for (what, _), block in blocks.items() if what == "anchor"],
        [block for (what, _), block in blocks.items() if what not in ("anchor", "mark")],
    )


def add_calibration(bundle: BundleAdjustment, options: CameraOptions) -> None:
    """Add priors for the parameters of each camera that was given calibrated, if the adjustment refines it."""
    metric, problem = bundle.metric, bundle.adjuster.problem
    images = [metric.image(image_id) for image_id in metric.reg_image_ids()]
    as_given = cameras_as_given(options, ((image.name, metric.camera(image.camera_id)) for image in images))
    for camera_id, (table, given) in as_given.items():
        params = metric.camera(camera_id).params
        if problem.has_parameter_block(params) and not problem.is_parameter_block_constant(params):
            stddev = parameter_stddevs(given, table.calibration_stddev_px(given.mean_focal_length()))
            whitening = np.diag(bundle.pixel_stddev / stddev)
            cost = solver.joint_prior_cost(mean=given.params[None], whitening=whitening)
            solver.add_residual_block(bundle.adjuster, cost, None, [params])


def parameter_stddevs(camera: pycolmap.Camera, focal_length_stddev_px: float) -> Array:
    """Return the (n,) standard deviations of a camera's parameters, given that of the focal length.

    One standard deviation of any parameter moves a feature at the photo's edge equally far, because an error of the
    calibration seen there does not tell which parameter is wrong.
    """
    focal_length = camera.mean_focal_length()
    edge = np.array([[0.5 * camera.width / focal_length, 0.5 * camera.height / focal_length, 1.0]])

    def image_of_edge(params: Array) -> Array:
        other = pycolmap.Camera(camera.todict())
        other.params[:] = params
        return np.ravel(other.img_from_cam(edge))

    shifts_px = np.linalg.norm(approx_fprime(camera.params, image_of_edge, 1e-6), axis=0)
    of_focal_lengths = np.linalg.norm(shifts_px[list(camera.focal_length_idxs())])
    smallest = ROUNDING * of_focal_lengths  # a parameter without any effect gets a very large stddev
    stddevs: Array = focal_length_stddev_px * of_focal_lengths / np.maximum(shifts_px, smallest)
    stddevs[list(camera.focal_length_idxs())] = focal_length_stddev_px
    return stddevs
