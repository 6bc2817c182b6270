"""The content of ``result.json``, and its summary in words for the end of a run.

    python -m rangesfm.result.summary > examples/result.schema.json

writes its JSON schema.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import ClassVar, Literal

from rangesfm.arrays import Array
from rangesfm.diagnostics.place import Place
from rangesfm.errors import number_text
from rangesfm.measurements.imu.entry import ImuEntry
from rangesfm.measurements.kind_entry import KindEntry
from rangesfm.measurements.positions.entry import PointsEntry, PositionsEntry
from rangesfm.measurements.ranges.scale.sensitivity import ScaleSensitivity
from rangesfm.result import entries
from rangesfm.result.comparison_row import ComparisonRow, format_table
from rangesfm.util.files.records import NumberOrNull, Record, Text
from rangesfm.util.geometry.gravity import UP_IN_SITE, gravity_of
from rangesfm.util.geometry.numerics import NORMAL_95

# Change of the scale, in percent per centimetre of an error, above which the summary mentions it.
_NOTABLE_PERCENT = 0.5


class ResultSummary(Record):
    """Content of ``result.json``: what a run found, from which inputs, and how.

    Attributes:
        place: null where the frame is that of the first camera.
        metric_from_sfm: similarity from the world of ``sparse/0`` to the world of ``sparse_scaled/0``.
        frame: of the metric models.
        anchors: by id.
        refine: null without a refinement.
        loops: null where no loops were looked for.
        models: all models that were to be joined to this one; empty where there was only one.
        tests: of mistakes that may have been made; those that were found come first.
        reliability: of the scale with one unfound mistake; null where no mistakes were tested.
        positions: of an antenna; null without any.
        points: control and check points; null without any, or where the frame is that of the first camera.
        distances: lengths that were taped, or are known between cameras of a rig.
        comparison: empty without a reference.
        georeference: null if the anchors do not give one.
        versions: of the software, by name.
        seconds: by stage, also of stages that an earlier run did, and of this run in total ("total").
        computed: date and time of the end of the run, ISO 8601 in UTC; null for results of earlier versions.
        warnings: what may be wrong with the result.
        notes: how the inputs were understood.
    """

    NAME: ClassVar[str] = "result.json"

    scale: entries.ScaleEntry
    place: Place | None
    metric_from_sfm: entries.SimilarityEntry
    frame: Literal["site", "first_camera"]
    map: entries.MapEntry
    anchors: dict[Text, entries.AnchorEntry]
    time_offset: entries.TimeOffsetEntry
    ranges: entries.RangesEntry
    check_ranges: entries.CheckRangesEntry
    refine: entries.RefineEntry | None
    loops: entries.LoopsEntry | None = None
    models: tuple[entries.ModelEntry, ...]
    tests: tuple[entries.MistakeEntry, ...] = ()
    reliability: entries.ReliabilityEntry | None = None
    distances: tuple[entries.DistanceRow, ...]
    positions: PositionsEntry | None = None
    points: PointsEntry | None = None
    imu: ImuEntry | None = None
    comparison: tuple[ComparisonRow, ...] = ()
    georeference: entries.GeoreferenceEntry | None
    versions: dict[Text, Text]
    settings: entries.Settings
    inputs: tuple[entries.InputEntry, ...]
    seconds: dict[Text, NumberOrNull]
    computed: entries.Time | None = None
    warnings: tuple[Text, ...]
    notes: tuple[Text, ...] = ()

    def __repr__(self) -> str:
        """Return the accuracy and the verdict of the map on one line."""
        return f"<result: {self.scale.in_words} (95 % interval), {self.scale.verdict}>"

    @property
    def has_ranges(self) -> bool:
        """Return whether there are ranges; otherwise the scale comes from measured lengths or known positions alone."""
        return self.ranges.num > 0

    @property
    def of_kinds(self) -> dict[str, KindEntry]:
        """Return the entries of the kinds of measurement that have one of their own, by key."""
        of_keys = {key: getattr(self, key) for key in type(self).model_fields}
        return {key: entry for key, entry in of_keys.items() if isinstance(entry, KindEntry)}

    @property
    def up(self) -> tuple[Array, float] | None:
        """The upward unit vector (3,) of the map and its standard deviation (radians); None if unknown."""
        if self.frame == "site":
            return UP_IN_SITE, 0.0
        if measured := [up for entry in self.of_kinds.values() if (up := entry.up) is not None]:
            return measured[0]
        gravity = gravity_of(self.settings.to_json().get("scale", {}).get("up_in_first_camera"))
        return None if gravity is None else (gravity.up_in_first_camera, gravity.stddev_rad)

    def lines(self, folder: Path) -> Iterator[str]:
        """Yield the lines that the user sees at the end of a run; ``folder`` is that of the result."""
        scale, ranges, offset = self.scale, self.ranges, self.time_offset
        interval = "no interval"
        if scale.interval_95 is not None:
            yield f"accuracy: {scale.in_words} (95 % interval)"
            interval = "95 % interval " + " to ".join(number_text(end, ".6g") for end in scale.interval_95)
        yield f"scale: {scale.value:.6g} m per SfM unit, {interval}"
        yield f"verdict: {scale.verdict}: {'; '.join(scale.reasons)}"
        if self.place is not None:
            # Reasons that hold for both verdicts were given with that on the scale.
            reasons = [reason for reason in self.place.reasons if reason not in scale.reasons]
            yield f"place: {self.place.verdict}: {'; '.join(reasons) or 'for the same reasons as the scale'}"
        for advice in scale.advice:
            yield f"next time: {advice}"
        yield from _notable(scale.sensitivity)
        if self.refine is not None:
            yield _refined(self.refine)
        if self.reliability is not None and self.reliability.scale_within is not None:
            yield _reliable(self.reliability)
        if self.loops is not None:
            yield _closed(self.loops)
        if self.has_ranges:
            residuals = f"; they differ from the map by {_text(ranges.rms_m, '.3f')} m (rms)" if ranges.num_used else ""
            if ranges.num_used and ranges.median_abs_m is not None:
                residuals += f", half of them by less than {number_text(ranges.median_abs_m, '.3f')} m"
            yield f"ranges: {ranges.num_used} of {ranges.num} used{residuals}"
        if self.distances:
            control = [row.residual_m for row in self.distances if row.kind == "control"]
            held = [abs(residual_m) for residual_m in control if residual_m is not None]
            worst = f"; the map differs from these by {max(held):.3f} m at most" if held else ""
            yield f"measured lengths: {len(held)} of {len(self.distances)} used for the scale{worst}"
        for entry in self.of_kinds.values():
            yield from entry.lines()
        if offset.estimated:
            within_s = None if offset.stddev_s is None else NORMAL_95 * offset.stddev_s
            value, within = _text(offset.value_s, "+.3f"), _text(within_s, ".3f")
            yield f"time offset: image time = range time {value} s, within {within} s (95 %)"
        yield f"map: {self.map.num_photos} photos, {self.map.num_points3D} points, frame {self.frame}"
        if self.comparison:
            yield from ("", *format_table(self.comparison, self.frame).splitlines(), "")
        yield f"metric model: {folder / ('sparse_scaled/0' if self.refine is None else 'sparse_metric/0')}"
        yield f"all results: {folder / self.NAME}"


def _refined(refine: entries.RefineEntry) -> str:
    """Return the line that says what the refinement did."""
    if not refine.kept:
        return "the refinement broke the map: the result is the scaled map"
    bent = f"; it changed the shape of the camera's path by {refine.bend_m:.2g} m (rms)"
    return f"refined in {refine.iterations} iterations{bent if refine.bend_m else ''}"


def _reliable(reliability: entries.ReliabilityEntry) -> str:
    """Return the line about mistakes that were not found."""
    within = f"{100 * (reliability.scale_within or 0.0):.2g} % at most (risk of more: {reliability.risk:g})"
    limited = f"; worst case: {reliability.limited_by}" if reliability.limited_by else ""
    unchecked = f"; nothing checks: {', '.join(reliability.unchecked)}" if reliability.unchecked else ""
    return f"reliability: if one mistake was made and not noticed, the scale is off by {within}{limited}{unchecked}"


def _closed(loops: entries.LoopsEntry) -> str:
    """Return the line that says which loops were closed."""
    agree = loops.num_closed == 0 and loops.num_verified > loops.num_contradicted
    used = "the map agrees with these as it is" if agree else f"{loops.num_closed} were used to close loops"
    moved = f", which moved the map by {loops.moved_m:.2g} m (rms)" if loops.num_closed else ""
    contradicted = f"; {loops.num_contradicted} contradict the measurements and were not used"
    return (
        f"loops: the map suggests that {loops.num_proposed} pairs of photos show the same place; {loops.num_verified} "
        f"of them match; {used}{moved}"
        f"{contradicted if loops.num_contradicted else ''}"
    )


def _notable(sensitivity: ScaleSensitivity) -> Iterator[str]:
    """Yield a line that names the errors of which one centimetre changes the scale much, if there are any."""
    values = {
        "of error in the short ranges": sensitivity.short_range_per_cm,
        "of error in all ranges": sensitivity.common_bias_per_cm,
        **{f"of error in the lever arm's {axis}": value for axis, value in zip("xyz", sensitivity.lever_arm_per_cm)},
    }
    notable = [f"{number_text(v, '+.2f')} % per cm {what}" for what, v in values.items() if abs(v) > _NOTABLE_PERCENT]
    if notable:
        yield f"the scale depends strongly on single errors: it changes by {', by '.join(notable)}"


def _text(value: float | None, spec: str) -> str:
    return "unknown" if value is None else number_text(value, spec)


def schema() -> str:
    """Return the JSON schema of ``result.json``."""
    return json.dumps(ResultSummary.model_json_schema(mode="serialization"), indent=1) + "\n"


if __name__ == "__main__":
    sys.stdout.write(schema())
