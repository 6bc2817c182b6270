"""Everything that the stages after the reconstruction found, in memory; the files of a result are made from it."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
import pycolmap

from rangesfm.arrays import Array
from rangesfm.colmap.transform import rescale
from rangesfm.diagnostics.place import Place
from rangesfm.estimation.scale.scale_estimate import ScaleEstimate
from rangesfm.estimation.with_ranges import RangesInMap, RefineSummary
from rangesfm.measurements.joint_map import JointMap, KindOnMap, upward_by
from rangesfm.measurements.kind import Doubt, Measurements
from rangesfm.measurements.mistakes import MistakeTests
from rangesfm.measurements.ranges.anchors.anchor import AnchorEstimate
from rangesfm.measurements.ranges.range_observations import RangeObservations
from rangesfm.sfm.loops.rounds import LoopClosure
from rangesfm.survey.inputs import RangingInputs
from rangesfm.survey.survey_run import PathOfModel
from rangesfm.util.geometry.georeference import Georeference
from rangesfm.util.geometry.gravity import Gravity
from rangesfm.util.geometry.map_errors import UNKNOWN_ERRORS, MapErrors
from rangesfm.util.geometry.similarity import Similarity
from rangesfm.util.geometry.trajectory import Trajectory


class Rivals(NamedTuple):
    """Other likely time offsets between the clocks.

    Attributes:
        doubts: sentences for the user.
        stddev: relative standard deviation of the scale that comes from the choice among them.
    """

    doubts: tuple[str, ...]
    stddev: float


@dataclass(frozen=True)
class ModelVerdict:
    """Outcome for one of the models that were to be joined.

    Attributes:
        name: name for the user, such as "sparse/0".
        estimate: estimate of its scale by its own ranges; None if they do not determine it.
        joined_from_sfm: transformation from its unscaled world to that of the joined unscaled model; None if the model
            is left out.
        reason: why it is left out; empty if it is not.
    """

    name: str
    num_images: int
    estimate: ScaleEstimate | None
    joined_from_sfm: Similarity | None
    reason: str


@dataclass(frozen=True, kw_only=True, repr=False)
class RefinedMap(RefineSummary):
    """A refined map, with the summary of its refinement.

    Attributes:
        model: the map.
        kinds: the measurements of the refinement, with their noise at rest.
        on_map: all that is measured in the map at rest, before it is moved to its estimate; the map before the
            refinement, without kinds, where nothing is known of the scale's error.
        scale: metres per SfM unit: at the estimate of all that is measured, or of a broken map its own.
        why_broken: reasons why it cannot be right; empty if there are none.
        loops: those that were closed in it; None where none were looked for.
    """

    model: pycolmap.Reconstruction
    kinds: tuple[Measurements, ...]
    on_map: JointMap
    scale: float
    why_broken: tuple[str, ...] = ()
    loops: LoopClosure | None = None

    @property
    def bending_factor(self) -> float:
        """Learnt bending over that which the photos' residuals let expect; 1 if unknown."""
        return self.on_map.problem.bending_factor if self.on_map.is_at_rest else 1.0


@dataclass(frozen=True)
class MetricResult:
    """A scaled and perhaps refined map with its ranges. The log has n ranges.

    Attributes:
        path: the unscaled model with its path and the ranges on it.
        inputs: what was measured, without what contradicts all else in the map.
        estimate: of the scale.
        scaled: the model after rescaling.
        rivals: other likely time offsets.
        refined: the map after the refinement; None without one.
        place: how well the place of the map in the site frame is known; None where the frame is that of the first
            camera, or where it has not been judged yet.
        models: all models that were to be joined to this one; empty where there was only one.
        diagnosis: result of the tests of mistakes on the final map; empty before.
    """

    path: PathOfModel
    inputs: RangingInputs
    estimate: ScaleEstimate
    scaled: pycolmap.Reconstruction
    rivals: Rivals
    refined: RefinedMap | None = None
    place: Place | None = None
    models: tuple[ModelVerdict, ...] = ()
    diagnosis: MistakeTests = field(default_factory=MistakeTests)

    @property
    def trajectory(self) -> Trajectory:
        """Return the keyframes of the unscaled model."""
        return self.path.trajectory

    @property
    def kept(self) -> RefinedMap | None:
        """Return the refined map; None where there is none or it is broken, so that the scaled one is the result."""
        return None if self.refined is None or self.refined.why_broken else self.refined

    @property
    def final(self) -> pycolmap.Reconstruction:
        """Return the refined model if it is kept, and else the scaled one."""
        return self.scaled if self.kept is None else self.kept.model

    @property
    def all_measured(self) -> JointMap:
        """Return the map from which the final one was moved to its estimate, with all that is measured in it.

        It has no kinds where nothing is known of the scale's error.
        """
        return self.estimate.on_map if self.kept is None else self.kept.on_map

    @property
    def kinds(self) -> tuple[KindOnMap, ...]:
        """Return the measurements on that map."""
        return self.all_measured.kinds

    @cached_property
    def scaled_ranges(self) -> RangesInMap:
        """The ranges as the scaled map has them."""
        of = self.estimate.ranges
        predicted_m = of.predicted_m(self.estimate.metric_from_sfm)
        return RangesInMap(of.observations, of.errors, of.anchors, predicted_m, self.inputs.tag_in_cam_m)

    @property
    def ranges(self) -> RangesInMap:
        """Return the ranges as the final map has them."""
        return self.scaled_ranges if self.kept is None else self.kept.ranges

    @property
    def anchors(self) -> tuple[AnchorEstimate, ...]:
        return self.ranges.anchors

    @property
    def observations(self) -> RangeObservations:
        """Return the ranges with their final status."""
        return self.ranges.observations

    @property
    def center_covariance_m2(self) -> dict[str, Array]:
        """Return the covariance (3, 3) of each keyframe's projection centre by photo; empty if it is not known."""
        if not self.map_errors.are_known:
            return {}
        return dict(
            zip(self.trajectory.image_names, self.map_errors.centers_m2(self.trajectory.frame_ids), strict=True)
        )

    def upward(self, given: Gravity | None) -> Array | None:
        """Return the upward unit vector (3,) in the final map, as it was measured or else as given; None if unknown."""
        on_map = self.all_measured
        if (gravity := upward_by(on_map.kinds, given)) is None:
            return None
        return np.asarray(on_map.estimate.rotation @ on_map.path.world_from_cam[0] @ gravity.up_in_first_camera)

    @property
    def map_errors(self) -> MapErrors:
        """Return how the parts of the refined map err together."""
        return UNKNOWN_ERRORS if self.kept is None else self.kept.covariance

    @property
    def georeference(self) -> Georeference | None:
        """Return that of the map, which is that of the anchors if the map is in their frame; None without one."""
        return self.inputs.site.georeference if self.estimate.frame == "site" else None

    def in_given_coordinates(self) -> MetricResult:
        """Return the same result in the coordinates of the site in whose local frame it is, if they are metres."""
        offset_m, estimate, refined = self.inputs.site.offset_m, self.estimate, self.refined
        if estimate.frame != "site" or not offset_m.any():
            return self
        shift = Similarity(1.0, np.eye(3), offset_m)
        moved = replace(estimate, metric_from_sfm=shift @ estimate.metric_from_sfm)
        if refined is not None:
            refined = replace(
                refined.with_anchors(tuple(each.moved(shift) for each in refined.ranges.anchors)),
                model=rescale(refined.model, shift),
                loops=refined.loops and refined.loops.moved(offset_m),
            )
        return replace(
            self,
            estimate=moved.with_anchors(tuple(each.moved(shift) for each in estimate.ranges.anchors)),
            scaled=rescale(self.scaled, shift),
            inputs=replace(self.inputs, positions=self.inputs.positions.moved(offset_m)),
            refined=refined,
        )

    def doubted(self, *doubts: Doubt) -> MetricResult:
        """Return the result as doubtful for further reasons, with advice on them; unchanged if there are none."""
        if not doubts:
            return self
        estimate = self.estimate
        kept = estimate.reasons if estimate.verdict == "doubtful" else ()
        reasons = (*(doubt.reason for doubt in doubts), *kept)
        advice = (*(doubt.advice for doubt in doubts if doubt.advice), *estimate.advice)
        doubted = replace(estimate, verdict="doubtful", reasons=reasons, advice=tuple(dict.fromkeys(advice)))
        return replace(self, estimate=doubted)
