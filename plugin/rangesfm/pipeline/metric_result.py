"""Everything that the stages after the reconstruction found, in memory; the files of a result are made from it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
import pycolmap

from rangesfm.arrays import Array
from rangesfm.colmap.transform import rescale
from rangesfm.diagnostics.finished_map import Place
from rangesfm.estimation.scale.scale_diagnostics import ScaleDiagnostics, scale_diagnostics
from rangesfm.estimation.scale.scale_estimate import ScaleEstimate
from rangesfm.estimation.with_ranges import RefineSummary
from rangesfm.measurements.joint_map import JointMap, KindOnMap, upward_by
from rangesfm.measurements.lengths.tape import Tape
from rangesfm.measurements.positions.surveyed_positions import SurveyedPositions
from rangesfm.measurements.ranges.anchors.anchor import AnchorEstimate
from rangesfm.measurements.ranges.anchors.site import Site
from rangesfm.measurements.ranges.clock.offset import TimeOffset
from rangesfm.measurements.ranges.mistakes.diagnosis import Diagnosis
from rangesfm.measurements.ranges.range_observations import RangeObservations
from rangesfm.pipeline.join_models import ModelVerdict
from rangesfm.sfm.loops.loop_closure import LoopClosure
from rangesfm.util.geometry.map_errors import MapErrors
from rangesfm.util.geometry.similarity import Similarity, align_points
from rangesfm.util.geometry.trajectory import Trajectory


class Rivals(NamedTuple):
    """Other likely time offsets between the clocks.

    Attributes:
        doubts: sentences for the user.
        stddev: relative standard deviation of the scale that comes from the choice among them.
    """

    doubts: tuple[str, ...]
    stddev: float


NO_RIVALS = Rivals((), 0.0)


@dataclass(frozen=True)
class MetricResult:
    """A scaled and perhaps refined map with its ranges. The log has n ranges.

    Attributes:
        trajectory: keyframes of the unscaled model.
        time_offset: estimate of the time offset; None where it was given or is not needed.
        time_offset_s: time offset used, image time minus range time; None where the log names photos.
        estimate: of the scale.
        scaled: the model after rescaling.
        predicted_scaled_m: (n,) ranges predicted by the scaled model; NaN for ranges without a place on the path.
        scaled_weights: (n,) robust weights by the scaled model.
        refined: the model after the refinement; None without one.
        refinement: summary of the refinement; None without one.
        why_broken: reasons why the refined model cannot be right; empty if there are none. If there are any, the scaled
            model is the result.
        place: how well the place of the map in the site frame is known; None where the frame is that of the first
            camera, or where it has not been judged yet.
        models: all models that were to be joined to this one; empty where there was only one.
        diagnosis: result of the tests of mistakes on the final map; empty before.
        tape: the measured lengths, with those left out that cannot be in the map; empty without any.
        positions: the known positions, with those left out that contradict the others.
        rivals: other likely time offsets.
        at_refined: the map at rest with all that is measured in it, before it is moved to its estimate; None without
            a refinement.
        loops: the loops that were closed in the refined map; None where none were looked for.
    """

    trajectory: Trajectory
    time_offset: TimeOffset | None
    time_offset_s: float | None
    estimate: ScaleEstimate
    scaled: pycolmap.Reconstruction
    predicted_scaled_m: Array
    scaled_weights: Array
    refined: pycolmap.Reconstruction | None = None
    refinement: RefineSummary | None = None
    why_broken: tuple[str, ...] = ()
    place: Place | None = None
    models: tuple[ModelVerdict, ...] = ()
    diagnosis: Diagnosis = field(default_factory=Diagnosis)
    tape: Tape = field(default_factory=Tape)
    positions: SurveyedPositions = field(default_factory=SurveyedPositions)
    rivals: Rivals = NO_RIVALS
    at_refined: JointMap | None = None
    loops: LoopClosure | None = None

    @property
    def final(self) -> pycolmap.Reconstruction:
        """Return the refined model, or the scaled one where there is no refined one or it is broken."""
        return self.scaled if self.refined is None or self.why_broken else self.refined

    @property
    def kept_refinement(self) -> RefineSummary | None:
        """Return the summary of the refinement; None where the final model is the scaled one."""
        return None if self.why_broken else self.refinement

    @property
    def all_measured(self) -> JointMap:
        """Return the map from which the final one was moved to its estimate, with all that is measured in it.

        It has no kinds where nothing is known of the scale's error.
        """
        return (self.at_refined if self.kept_refinement is not None else None) or self.estimate.on_map

    @property
    def kinds(self) -> tuple[KindOnMap, ...]:
        """Return the measurements on that map."""
        return self.all_measured.kinds

    @property
    def _stage(self) -> ScaleEstimate | RefineSummary:
        """Return what the final model comes from: the kept refinement, or the estimate of the scale."""
        return self.kept_refinement or self.estimate

    @property
    def anchors(self) -> tuple[AnchorEstimate, ...]:
        return self._stage.anchors

    @property
    def observations(self) -> RangeObservations:
        """Return the ranges with their final status."""
        return self._stage.observations

    @property
    def predicted_m(self) -> Array:
        """Return the ranges predicted by the final model, (n,) metres."""
        return self.predicted_scaled_m if self.kept_refinement is None else self.kept_refinement.predicted_m

    @property
    def weights(self) -> Array:
        """Return the robust weights of the ranges by the final model, (n,) in [0, 1]."""
        return self.scaled_weights if self.kept_refinement is None else self.kept_refinement.weights

    @property
    def range_stddev_m(self) -> Array:
        """Return the last noise stddev of each range, (n,) metres; NaN for ranges without a place on the path."""
        return self._stage.errors.stddev_m

    @property
    def residuals_m(self) -> Array:
        """Return predicted minus measured ranges by the final model, (n,) metres."""
        return self.predicted_m - self.observations.log.range_m

    @property
    def center_covariance_m2(self) -> dict[str, Array]:
        """Return the covariance (3, 3) of each keyframe's projection centre by photo; empty if it is not known."""
        found = None if self.kept_refinement is None else self.kept_refinement.covariance
        if found is None:
            return {}
        index = np.searchsorted(found.frame_ids, self.trajectory.frame_ids)
        return dict(zip(self.trajectory.image_names, found.centers[index], strict=True))

    @property
    def upward(self) -> Array | None:
        """Return the upward unit vector (3,) in the final map as it was measured; None if it was not."""
        on_map = self.all_measured
        if (gravity := upward_by(on_map.kinds, None)) is None:
            return None
        return np.asarray(on_map.estimate.rotation @ on_map.path.world_from_cam[0] @ gravity.up_in_first_camera)

    @property
    def map_errors(self) -> MapErrors | None:
        """Return how the parts of the refined map err together; None if that is not known."""
        found = None if self.kept_refinement is None else self.kept_refinement.covariance
        return None if found is None else found.errors

    @cached_property
    def diagnostics(self) -> ScaleDiagnostics:
        """Return the scale candidates of the ranges and how many ranges agree with each scale."""
        return scale_diagnostics(self.estimate, self.trajectory)

    @property
    def refined_scale(self) -> float | None:
        """Return metres per SfM unit after the refinement, by least squares over all centres; None without one."""
        if self.refined is None:
            return None
        if self.at_refined is not None:
            return self.at_refined.metres_per_unit if self.why_broken else self.at_refined.scale.value
        return align_points(self.trajectory.centers, self.trajectory.as_in(self.refined).centers).scale

    def in_site(self, site: Site) -> MetricResult:
        """Return the same result in the coordinates of a site in whose local frame it is, if they are metres."""
        offset_m = site.offset_m
        if self.estimate.frame != "site" or not offset_m.any():
            return self
        shift = Similarity(1.0, np.eye(3), offset_m)
        estimate = replace(
            self.estimate,
            metric_from_sfm=shift @ self.estimate.metric_from_sfm,
        ).with_anchors(tuple(_moved_anchor(anchor, offset_m) for anchor in self.estimate.anchors))
        refinement = self.refinement and replace(
            self.refinement, anchors=tuple(_moved_anchor(anchor, offset_m) for anchor in self.refinement.anchors)
        )
        return replace(
            self,
            estimate=estimate,
            scaled=rescale(self.scaled, shift),
            refined=None if self.refined is None else rescale(self.refined, shift),
            positions=self.positions.moved(offset_m),
            refinement=refinement,
            loops=self.loops and self.loops.moved(offset_m),
        )

    def doubted(self, reasons: Sequence[str], advice: Sequence[str] = ()) -> MetricResult:
        """Return the result as doubtful for further reasons, with advice on them; unchanged if there are no reasons."""
        if not reasons:
            return self
        estimate = self.estimate
        kept = estimate.reasons if estimate.verdict == "doubtful" else ()
        all_advice = tuple(dict.fromkeys((*advice, *estimate.advice)))
        doubted = replace(estimate, verdict="doubtful", reasons=(*reasons, *kept), advice=all_advice)
        return replace(self, estimate=doubted)


def _moved_anchor(anchor: AnchorEstimate, offset_m: Array) -> AnchorEstimate:
    places = {name: getattr(anchor, name) for name in ("position_m", "prior_position_m", "mirror_position_m")}
    return replace(anchor, **{name: at + offset_m for name, at in places.items() if at is not None})
