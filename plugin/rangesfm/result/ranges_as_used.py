"""``ranges.csv``: every range of the log with what became of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import numpy.typing as npt

from rangesfm.arrays import Array
from rangesfm.ranging.observations import RangeStatus
from rangesfm.result.metric_result import USED, MetricResult
from rangesfm.result.table_file import Numbers, NumbersOrEmpty, RoundedOrEmpty, TableFile, Texts, TextsOrEmpty

Rows = npt.NDArray[np.int64]


@dataclass(frozen=True)
class RangesAsUsed(TableFile):
    """n ranges, in the order of the log; a peer of its kind stands in a range's other column.

    Attributes:
        timestamp_s: (n,) on the radio's clock, NaN where the log gives photos instead.
        image_name: n names, empty where the log gives times.
        anchor_id, tag_id: n ids.
        range_m: (n,) measured.
        range_stddev_m: (n,) noise as weighted last; NaN without a place.
        keyframe_before, keyframe_after: n photos between which each range was taken; empty without a place.
        weight: (n,) of the later one, in [0, 1]; NaN without a place.
        predicted_scaled_m, predicted_refined_m: (n,) with the scaled and with the refined model; NaN where not
            applicable.
        residual_m: (n,) predicted with the final model minus measured.
        robust_weight: (n,) in [0, 1] by that residual; NaN for ranges that have no say.
        status: n labels of RangeStatus.
    """

    NAME: ClassVar = "ranges.csv"
    timestamp_s: NumbersOrEmpty
    image_name: TextsOrEmpty
    anchor_id: Texts
    tag_id: Texts
    range_m: Numbers
    range_stddev_m: RoundedOrEmpty
    keyframe_before: TextsOrEmpty
    keyframe_after: TextsOrEmpty
    weight: RoundedOrEmpty
    predicted_scaled_m: RoundedOrEmpty
    predicted_refined_m: RoundedOrEmpty
    residual_m: RoundedOrEmpty
    robust_weight: RoundedOrEmpty
    status: Texts

    @classmethod
    def of(cls, found: MetricResult) -> RangesAsUsed | None:
        observations, log = found.observations, found.observations.log
        if not len(log):
            return None
        unknown = np.full(len(log), np.nan)
        has_say = np.isin(observations.status, (*USED, RangeStatus.OUTLIER))
        labels = {int(status): status.label for status in RangeStatus}
        names = (*found.trajectory.image_names, "")
        tag_ids, anchor_ids = log.end_ids()
        return cls(
            timestamp_s=unknown if log.timestamp_s is None else log.timestamp_s,
            image_name=("",) * len(log) if log.image_name is None else log.image_name,
            anchor_id=tuple(anchor_ids),
            tag_id=tuple(tag_ids),
            range_m=log.range_m,
            range_stddev_m=found.range_stddev_m,
            keyframe_before=tuple(names[i] for i in observations.before),
            keyframe_after=tuple(names[i] for i in observations.after),
            weight=np.where(observations.before >= 0, observations.weight, np.nan),
            predicted_scaled_m=found.predicted_scaled_m,
            predicted_refined_m=unknown if found.kept_refinement is None else found.kept_refinement.predicted_m,
            residual_m=found.residuals_m,
            robust_weight=np.where(has_say, found.weights, np.nan),
            status=tuple(labels[status] for status in observations.status.tolist()),
        )

    def places_on(self, image_names: Sequence[str]) -> tuple[Rows, Rows, npt.NDArray[np.bool_]]:
        """(n,) which of a path's keyframes are before and after each range, -1 for none; and whether it has a place."""
        index_of = {name: i for i, name in enumerate(image_names)}
        before, after = (
            np.array([index_of.get(name, -1) for name in names], dtype=np.int64)
            for names in (self.keyframe_before, self.keyframe_after)
        )
        return before, after, (before >= 0) & (after >= 0) & np.isfinite(self.weight)

    @property
    def residuals_by_model_m(self) -> dict[str, Array]:
        """(n,) predicted minus measured, with the "scaled" model and, if there is one, with the "refined"."""
        refined = self.predicted_refined_m - self.range_m
        both = {"scaled": self.predicted_scaled_m - self.range_m, "refined": refined}
        return both if np.isfinite(refined).any() else {"scaled": both["scaled"]}

    @property
    def is_used(self) -> npt.NDArray[np.bool_]:
        """(n,) ranges with a say in the final model, however small."""
        return np.isin(np.array(self.status, dtype=str), [status.label for status in USED])
