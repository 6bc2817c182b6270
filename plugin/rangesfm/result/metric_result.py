"""MetricResult: all that the stages after the reconstruction found, in memory; what is written follows from it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
import pycolmap

from rangesfm.arrays import Array
from rangesfm.colmap.transform import rescale
from rangesfm.distances.tape import Tape
from rangesfm.geometry.similarity import Similarity, align_most
from rangesfm.geometry.trajectory import Trajectory
from rangesfm.join.models import ModelVerdict
from rangesfm.ranging.anchors.anchor import AnchorEstimate
from rangesfm.ranging.clock.estimate import TimeOffset
from rangesfm.ranging.observations import RangeObservations, RangeStatus
from rangesfm.refine.with_ranges import RefineSummary
from rangesfm.scale.at_map import MapWithRanges
from rangesfm.scale.diagnostics import ScaleDiagnostics, scale_diagnostics
from rangesfm.scale.estimate import ScaleEstimate
from rangesfm.trust.finished_map import Place
from rangesfm.trust.linearized import RangesOnMap
from rangesfm.trust.verdict import TrustVerdict

USED = (RangeStatus.USED, RangeStatus.DOWN_WEIGHTED)
"""Of ranges with a say in the final model, however small."""


class Rivals(NamedTuple):
    """Other offsets of the clocks: doubts in words, and the relative stddev of the scale by the choice among them."""

    doubts: tuple[str, ...]
    stddev: float


@dataclass(frozen=True)
class MetricResult:
    """A scaled and perhaps refined map with its ranges.

    Attributes:
        trajectory: keyframes of the unscaled model.
        time_offset: as estimated; None where it was given or is not needed.
        time_offset_s: as used; None where the log names photos.
        estimate: of the scale.
        scaled: the model after rescaling.
        predicted_scaled_m: (n,) ranges by that model; NaN without a place.
        scaled_weights: (n,) robust weights by it.
        refined: the model after refinement; None without.
        refinement: its summary; None without.
        why_broken: what the refined model cannot be; empty if nothing speaks against it. Where it is broken, the scaled
            one is the result.
        place: of the map in the site's frame; None where the frame is the first camera's, or nobody judged it yet.
        models: that were to be joined to what is one model here; empty where there was only one.
        trust: what the tests of mistakes say of the final map.
        tape: the measured lengths, those that cannot belong to the map as left out; None: there are none.
        rivals: of the clocks' offset; None: there are none.
        on_map: the ranges on the scaled map; None where that is only the start of a refinement, or there are none.
        refined_with_ranges: the refined map as ranges lie on it; None without.
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
    trust: TrustVerdict | None = None
    tape: Tape | None = None
    rivals: Rivals | None = None
    on_map: RangesOnMap | None = None
    refined_with_ranges: MapWithRanges | None = None

    @property
    def final(self) -> pycolmap.Reconstruction:
        """The best metric model there is."""
        return self.scaled if self.refined is None or self.why_broken else self.refined

    @property
    def kept_refinement(self) -> RefineSummary | None:
        """That of the final model; None where it is the scaled one."""
        return None if self.why_broken else self.refinement

    @property
    def _stage(self) -> ScaleEstimate | RefineSummary:
        """The one that the final model comes from."""
        return self.kept_refinement or self.estimate

    @property
    def anchors(self) -> tuple[AnchorEstimate, ...]:
        return self._stage.anchors

    @property
    def observations(self) -> RangeObservations:
        """With the final status of each range."""
        return self._stage.observations

    @property
    def predicted_m(self) -> Array:
        """(n,) ranges by the final model."""
        return self.predicted_scaled_m if self.kept_refinement is None else self.kept_refinement.predicted_m

    @property
    def weights(self) -> Array:
        """(n,) robust weights by the final model."""
        return self.scaled_weights if self.kept_refinement is None else self.kept_refinement.weights

    @property
    def range_stddev_m(self) -> Array:
        """(n,) noise of each range as weighted last; NaN without a place."""
        return self._stage.errors.stddev_m

    @property
    def residuals_m(self) -> Array:
        """(n,) predicted minus measured, by the final model."""
        return self.predicted_m - self.observations.log.range_m

    @property
    def center_covariance_m2(self) -> dict[str, Array]:
        """(3, 3) of each keyframe's projection centre, by its photo; empty where it was not found."""
        found = None if self.kept_refinement is None else self.kept_refinement.covariance
        if found is None:
            return {}
        index = np.searchsorted(found.frame_ids, self.trajectory.frame_ids)
        return dict(zip(self.trajectory.image_names, found.centers[index], strict=True))

    @cached_property
    def diagnostics(self) -> ScaleDiagnostics:
        """How the scale came about."""
        return scale_diagnostics(self.estimate, self.trajectory)

    @property
    def refined_scale(self) -> float | None:
        """Metres per SfM unit after refinement, by where most keyframe centres went."""
        if self.refined is None:
            return None
        if self.refined_with_ranges is not None:
            return self.refined_with_ranges.solution.fit.state.metric_from_model.scale
        return align_most(
            self.trajectory.centers, self.trajectory.as_in(self.refined).centers, self.estimate.metric_from_sfm
        ).scale

    def moved(self, offset_m: Array) -> MetricResult:
        """The same in a world whose coordinates are larger by ``offset_m`` (3,)."""
        if not offset_m.any():
            return self
        shift = Similarity(1.0, np.eye(3), offset_m)
        estimate = replace(
            self.estimate,
            metric_from_sfm=shift @ self.estimate.metric_from_sfm,
            anchors=tuple(_moved_anchor(anchor, offset_m) for anchor in self.estimate.anchors),
        )
        refinement = self.refinement and replace(
            self.refinement, anchors=tuple(_moved_anchor(anchor, offset_m) for anchor in self.refinement.anchors)
        )
        return replace(
            self,
            estimate=estimate,
            scaled=rescale(self.scaled, shift),
            refined=None if self.refined is None else rescale(self.refined, shift),
            refinement=refinement,
        )

    def doubted(self, reasons: Sequence[str], advice: Sequence[str] = ()) -> MetricResult:
        """The same with further reasons to doubt it, if there are any, and what to do about them."""
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
