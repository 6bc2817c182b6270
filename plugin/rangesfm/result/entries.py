"""Entries of ``result.json``: plain data, whose fields are its keys."""

from __future__ import annotations

import math
from datetime import datetime
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import AfterValidator, AliasChoices, AliasPath, BeforeValidator, Field
from scipy.spatial.transform import Rotation

from rangesfm.measurements.ranges.scale.sensitivity import ScaleSensitivity
from rangesfm.measurements.ranges.scale.two_candidate import Branch
from rangesfm.options import COORDINATE_M, RangesOptions
from rangesfm.util.files.records import (
    Count,
    Flag,
    IntervalOrNull,
    Number,
    NumberOrNull,
    Record,
    Text,
    Vector,
    VectorOrNull,
)
from rangesfm.util.geometry.georeference import Georeference
from rangesfm.util.geometry.similarity import Similarity


def _unit(quaternion: tuple[float, ...]) -> tuple[float, ...]:
    if not abs(np.linalg.norm(quaternion) - 1.0) < 1e-6:
        raise ValueError("a unit quaternion")
    return quaternion


def _iso_time(text: str) -> str:
    try:
        datetime.fromisoformat(text)
    except ValueError:
        raise ValueError("a date and time (ISO 8601)") from None
    return text


Time = Annotated[Text, AfterValidator(_iso_time)]
Quaternion = Annotated[tuple[Number, Number, Number, Number], AfterValidator(_unit)]


class SimilarityEntry(Record):
    """A similarity, ``x -> scale * R x + translation_m``, with R as a unit quaternion whose real part is last."""

    scale: Number
    rotation_xyzw: Quaternion
    translation_m: Vector

    @property
    def similarity(self) -> Similarity:
        return Similarity(
            self.scale, Rotation.from_quat(self.rotation_xyzw).as_matrix(), np.array(self.translation_m, np.float64)
        )


class TwoCandidateEntry(Record):
    """Both branches of the paper's two-candidate estimate; see TwoCandidate."""

    alpha0: Branch
    alpha1: Branch
    chosen: Text
    num_without_root: Count


class RelativeStddevEntry(Record):
    """Relative standard deviations of the scale; see ScaleUncertainty. ``formal`` is null where nothing is known."""

    formal: NumberOrNull
    components: dict[Text, Number]


class ScaleByKindEntry(Record):
    """The scale by one kind of measurement alone, such as "ranges", in metres per unit of the unscaled model.

    Attributes:
        value: middle of its interval. stddev: null where it is not determined.
    """

    value: Number
    stddev: NumberOrNull


def _of_ranges(key: str, *path: str) -> AliasChoices:
    """Return where a number is found: under its key, or in what an estimate says of the ranges, as there by default."""
    return AliasChoices(key, AliasPath("ranges", *(path or (key,))))


class ScaleEntry(Record):
    """The scale in metres per unit of the unscaled model, and how reliable it is; see ScaleEstimate."""

    value: Number
    stddev_formal: NumberOrNull
    stddev_empirical: NumberOrNull
    interval_95: IntervalOrNull
    relative_stddev: RelativeStddevEntry = Field(validation_alias=AliasChoices("relative_stddev", "uncertainty"))
    error_stddevs: dict[Text, Number] = Field(default_factory=dict, validation_alias=_of_ranges("error_stddevs"))
    """Learnt standard deviations of the components of the range errors: metres (slope: fraction of the distance)."""
    method: Text
    verdict: Literal["good", "doubtful"]
    reasons: tuple[Text, ...]
    advice: tuple[Text, ...]
    sensitivity: ScaleSensitivity = Field(validation_alias=_of_ranges("sensitivity"))
    per_anchor: dict[Text, NumberOrNull] = Field(validation_alias=_of_ranges("per_anchor"))
    range_noise_stddev_m: NumberOrNull = Field(validation_alias=_of_ranges("range_noise_stddev_m", "noise_stddev_m"))
    """Standard deviation of a range about the scaled map, all its errors together. (The test "range noise" compares
    each range with those right before and after, which have the same lasting errors.)"""
    correlation_inflation: NumberOrNull = Field(
        validation_alias=_of_ranges("correlation_inflation", "errors", "inflation")
    )
    two_candidate: TwoCandidateEntry | None = Field(validation_alias=_of_ranges("two_candidate"))
    by_kind: dict[Text, ScaleByKindEntry] = Field(default_factory=dict)

    @property
    def half_width_95(self) -> float | None:
        """Return half the width of the 95 % interval, in the logarithm of the scale; None if it is unknown."""
        low, high = self.interval_95 or (0.0, 0.0)
        return 0.5 * (math.log(high) - math.log(low)) if 0 < low < high else None

    @property
    def in_words(self) -> str:
        """Return the interval as a client reads it: "10 m in this map are 9.88 to 10.12 m"."""
        if self.interval_95 is None or self.half_width_95 is None or not self.value:
            return "how long 10 m in this map are is open"
        low_m, high_m = (10 * bound / self.value for bound in self.interval_95)
        decimals = min(max(1 - math.floor(math.log10(10 * self.half_width_95)), 0), 6)  # two digits of half the width
        return f"10 m in this map are {low_m:.{decimals}f} to {high_m:.{decimals}f} m"

    @property
    def relative_stddev_empirical(self) -> float:
        """Return the relative stddev that the scale gives every length in the metric models; inf if unknown."""
        return self.stddev_empirical / self.value if self.stddev_empirical is not None and self.value else math.inf


class ModelScaleEntry(Record):
    """The scale of one of several models, from its own ranges; its numbers are null where they do not determine it."""

    value: NumberOrNull
    stddev_empirical: NumberOrNull
    interval_95: IntervalOrNull
    verdict: Literal["good", "doubtful", "refused"]
    reasons: tuple[Text, ...]


class ModelEntry(Record):
    """One of several models that were to be joined: its own scale, and its place in the joined map."""

    name: Text
    num_images: Count
    joined: Flag
    reason: Text | None
    scale: ModelScaleEntry
    metric_from_sfm: SimilarityEntry | None


class MapEntry(Record):
    """The size of the final model."""

    num_photos: Count
    num_points3D: Count  # noqa: N815 (as COLMAP has it)


def _place(position_m: Any) -> Any:
    """Return the position of an anchor; None beyond all coordinates: an anchor that no range holds has no place."""
    is_place = position_m is not None and np.all([COORDINATE_M.hold(float(number)) for number in position_m])
    return position_m if is_place else None


_PlaceOrNull = Annotated[VectorOrNull, BeforeValidator(_place)]


class AnchorEntry(Record):
    """An anchor in the world of the metric models; see AnchorEstimate. What is unknown or does not exist is null."""

    position_m: _PlaceOrNull
    stddev_m: NumberOrNull = Field(validation_alias=AliasChoices("stddev_m", "position_stddev_m"))
    range_bias_m: NumberOrNull
    mirror_position_m: _PlaceOrNull
    surveyed_position_m: VectorOrNull = Field(validation_alias=AliasChoices("surveyed_position_m", "prior_position_m"))


class TimeOffsetEntry(Record):
    """The time offset between the clocks: image time = range time + ``value_s``.

    It is null where the log names photos. All keys after ``estimated`` but the note are null unless it was estimated.
    """

    value_s: NumberOrNull
    stddev_s: NumberOrNull
    estimated: Flag
    offset_matters: Flag | None = None
    drift_ppm: NumberOrNull = None
    drift_stddev_ppm: NumberOrNull = None
    drift_is_followed: Flag | None = None
    note: Text | None


class ResidualEntry(Record):
    """Numbers of ranges between tag and anchor, and residuals in the final model of those that are used."""

    num: Count
    num_used: Count
    num_rejected: Count
    rms_m: NumberOrNull
    median_abs_m: NumberOrNull


class RangesEntry(ResidualEntry):
    """All ranges, together and by anchor. Ranges between two anchors or two tags are only counted."""

    num_anchor_anchor: Count
    num_tag_tag: Count
    per_anchor: dict[Text, ResidualEntry]


class CheckEntry(Record):
    """Ranges that were held out of all estimates, and their residuals in the final model."""

    num: Count
    rms_m: NumberOrNull
    median_m: NumberOrNull


class CheckRangesEntry(CheckEntry):
    """All held-out ranges, together and by anchor."""

    per_anchor: dict[Text, CheckEntry]


class LoopsEntry(Record):
    """Summary of the closing of loops; see LoopClosure. ``loops.csv`` names the pairs.

    Attributes:
        num_proposed: pairs of photos that the refined map predicted to see the same.
        num_verified: pairs of these that match.
        num_closed: pairs of these that fit the measurements and were used.
        num_contradicted: pairs of these that the measurements contradict.
        moved_m: root mean square movement of the keyframes.
    """

    num_proposed: Count
    num_verified: Count
    num_closed: Count
    num_contradicted: Count
    moved_m: Number


class RefineEntry(Record):
    """Summary of the refinement; see RefineSummary. What was not estimated is null.

    Attributes:
        converged: whether the solver did. message: of the solver.
        kept: whether the final map is the refined one. Otherwise it is the scaled one.
        why_not_kept: reasons why the refined map cannot be right; empty where it is kept.
        bending_factor: bend of the map before the refinement, divided by the bend that the residuals of the photos let
            expect.
        scale_value: the same as ``scale.value``, if the refined map is kept.
        relative_scale_stddev: of the scale by the residuals of the refinement alone, without the errors that it does
            not model; the scale's interval is ``scale.interval_95``.
    """

    kept: Flag
    why_not_kept: tuple[Text, ...]
    iterations: Count
    keyframe_graph_steps: Count
    bend_m: NumberOrNull
    bending_factor: NumberOrNull = None
    initial_cost: NumberOrNull
    final_cost: NumberOrNull
    reprojection_rms_px: NumberOrNull
    pixel_stddev: NumberOrNull
    correlation_inflation: NumberOrNull
    seconds: NumberOrNull
    converged: Flag
    message: Text
    scale_value: NumberOrNull
    relative_scale_stddev: NumberOrNull
    tag_in_cam_m: dict[Text, Vector]
    time_offset_change_s: NumberOrNull
    short_range_error_m: NumberOrNull


class DistanceRow(Record):
    """One measured length in metres: measured, in the map, and the difference map minus measurement."""

    from_: Text = Field(validation_alias=AliasChoices("from", "from_"), serialization_alias="from")
    to: Text
    kind: Text
    measured_m: Number
    stddev_m: Number
    estimated_m: NumberOrNull
    residual_m: NumberOrNull


class MistakeEntry(Record):
    """A mistake that may have been made, and what the ranges say about it; see MistakeTest."""

    name: Text
    subject: Text
    statistic: Number
    threshold: Number
    size: NumberOrNull
    stddev: NumberOrNull
    unit: Text
    smallest_detectable: NumberOrNull
    effect_on_scale: NumberOrNull
    effect_on_place_m: NumberOrNull
    redundancy: NumberOrNull = None
    is_checked: Flag | None = None
    rejected: Flag
    words: Text
    remedy: Text


class ReliabilityEntry(Record):
    """Largest error of the scale, even if one mistake was made and not found; see ``scale_bound``.

    Attributes:
        scale_within: largest relative error of the scale; null without a limit, or where a mistake was found.
        risk: probability with which it is exceeded.
        limited_by: mistake that may change the scale most unnoticed, in words; empty: none adds anything.
        unchecked: mistakes in what was given, in words, that the other observations cannot show.
    """

    scale_within: NumberOrNull
    risk: Number
    limited_by: Text
    unchecked: tuple[Text, ...]


class GeoreferenceEntry(Record):
    """Place of the metric models' world on the Earth; see Georeference."""

    lat_deg: Number
    lon_deg: Number
    height_m: Number
    crs: Text

    @property
    def georeference(self) -> Georeference:
        return Georeference(self.lat_deg, self.lon_deg, self.height_m, self.crs)


# Tables of a survey file as recorded; the classes name only the keys that are read again.


class ImageSettings(Record, extra="allow"):
    path: Text | None


class RangesSettings(Record, extra="allow"):
    max_interpolation_gap_s: Number
    max_time_difference_s: Number

    @property
    def association(self) -> RangesOptions:
        return RangesOptions(
            max_interpolation_gap_s=self.max_interpolation_gap_s, max_time_difference_s=self.max_time_difference_s
        )


class AnchorSettings(Record, extra="allow"):
    path: Text | None
    frame: Text | None
    crs: Text | None
    columns: dict[Text, Text] = Field(default_factory=dict)
    unit: Text | None = None


class TagSettings(Record, extra="allow"):
    tag_in_cam_m: Vector
    lever_arms_m: dict[Text, Vector]


class ReportSettings(Record, extra="allow"):
    title: Text | None = None
    by: Text | None = None


class Settings(Record, extra="allow"):
    """The settings of the survey as the run had them, by table and key."""

    images: ImageSettings
    ranges: RangesSettings
    anchors: AnchorSettings
    tag: TagSettings
    report: ReportSettings = ReportSettings()


class InputEntry(Record):
    """An input with its SHA-256 hash, by which it can be recognised later; see ``input_hashes``."""

    path: Text
    sha256: Text
    bytes: Count
    hashed: Text
