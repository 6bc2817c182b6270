"""Tables of the report, each made from Content."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from markupsafe import Markup

from rangesfm.arrays import median, rms
from rangesfm.measurements.kinds_in_words import component_words
from rangesfm.measurements.mistake_words import CHECKED_KINDS, mistake_in_words
from rangesfm.measurements.ranges.range_observations import RangeStatus
from rangesfm.report.content import Content
from rangesfm.report.facts import frame_in_words
from rangesfm.report.text import count, duration, fixed, keyed, percent, plain, rough, sentence, signed
from rangesfm.result.comparison_row import rmse_heading
from rangesfm.result.entries import AnchorEntry
from rangesfm.survey.settings import KEYS
from rangesfm.util.files.folders import natural_order
from rangesfm.util.geometry.numerics import NORMAL_95

_Columns = Mapping[str, Callable[[Any], str]]
_WAYS = ("to the right", "downward", "forward")
_REFINEMENT = {
    "kept": "refined map kept",
    "why_not_kept": "why not kept",
    "iterations": "iterations",
    "keyframe_graph_steps": "iterations of the adjustment of poses alone before",
    "bend_m": "change of the path's shape (RMS), m",
    "bending_factor": "bending of the map, over that expected from the photos' residuals",
    "initial_cost": "cost before",
    "final_cost": "cost after",
    "reprojection_rms_px": "reprojection RMS, px",
    "pixel_stddev": "standard deviation of a feature's position, px",
    "correlation_inflation": "factor on the ranges' standard deviations, as their errors last",
    "seconds": "time, s",
    "converged": "solver converged",
    "message": "solver's message",
    "tag_in_cam_m": "lever arm, m",
    "time_offset_change_s": "change of the time offset, s",
    "short_range_error_m": "error of short ranges, m",
}

_STATUSES = {
    RangeStatus.DOWN_WEIGHTED.label: "used with less weight, because its residual is large",
    RangeStatus.OUTLIER.label: "rejected, because its residual is too large",
    RangeStatus.NO_KEYFRAME_NEAR.label: "taken between photos too far apart in time to know the camera's position",
    RangeStatus.OUTSIDE_PATH.label: "taken before the first or after the last photo of the map",
    RangeStatus.UNKNOWN_IMAGE.label: "its photo is not in the map",
    RangeStatus.UNKNOWN_ANCHOR.label: "to an anchor that is not used",
    RangeStatus.CHECK.label: "takes no part in the estimate, and is compared with the result",
}
_ALIGNED = {
    "site": "in the site's frame, without any alignment",
    "first_camera": "after alignment by the pose of the first keyframe, because the map has no place in the site",
}


@dataclass(frozen=True)
class ReportTable:
    """A table of the page. The page leaves it out if it has no rows.

    Attributes:
        header: names of the columns; empty for a table without a header.
        rows: cells of each row, the first of which names the row. Text that is not Markup is escaped.
        kind: class of the table's own CSS style; empty: that of all tables.
        is_narrow: whether it can stand beside other narrow tables.
    """

    caption: str
    header: Sequence[str]
    rows: Sequence[Sequence[str]]
    note: str = ""
    kind: str = ""
    is_narrow: bool = False


def range_statuses(content: Content) -> ReportTable:
    """Return the table of how many ranges of the log have each status."""
    statuses = Counter(content.ranges.status)
    rows = [[name, count(num), fixed(100.0 * num / statuses.total(), 1, "%")] for name, num in statuses.most_common()]
    meanings = [f"{name}: {_STATUSES[name]}" for name in statuses if name in _STATUSES]
    note = sentence("; ".join(meanings)) if meanings else ""
    return ReportTable("What became of the ranges", ["status", "ranges", "of all"], rows, note)


def ranges_per_anchor(content: Content) -> ReportTable:
    """Return the table of each anchor's ranges: how many, and their residuals before and after the refinement."""
    ranges, rows = content.ranges, []
    for anchor_id in sorted({*ranges.anchor_id}, key=natural_order):
        mine = np.array(ranges.anchor_id, dtype=str) == anchor_id
        used = mine & ranges.is_used
        row = [anchor_id, count(int(mine.sum())), count(int(used.sum()))]
        for predicted in (ranges.predicted_scaled_m, ranges.predicted_refined_m):
            residuals = (predicted - ranges.range_m)[used]
            known = residuals[np.isfinite(residuals)]
            row += [fixed(rms(known), 3), fixed(median(known), 3)]
        rows.append(row)
    header = ["anchor", "ranges", "used", "scaled: RMS m", "median m", "refined: RMS m", "median m"]
    return ReportTable("Ranges of each anchor", header, rows)


def mistakes(content: Content, *, are_found: bool) -> ReportTable:
    """Return the table of the mistakes that the ranges show, or of those that were tested for and not found.

    A bar that is half full is at the threshold of the test. Where several of one kind were not found, such as one for
    each anchor, there is only the one with the most evidence.
    """
    tests, rows = content.summary.tests, list[Sequence[str]]()
    note = "A bar more than half full is more than chance explains"
    if not are_found:
        least = min((test.threshold for test in tests if test.stddev and test.threshold), default=None)
        if least is not None:
            note += (
                f" (a mistake that is one number is found from {math.sqrt(least):.1f} of its standard deviations on: "
                "among so many tests, one reaches three by chance)"
            )
        note += (
            ". A mistake that is not found may still be there, if it is smaller than the smallest one found. The last "
            "two columns say how much it may then change the scale and places in the map. All "
            "tests are in result.json"
        )
    numbers = {
        "stddev": "± (95 %)",
        "smallest_detectable": "smallest found",
    }
    likeliest: set[str] = set()
    for i, test in enumerate(tests):
        if test.rejected != are_found or (not test.rejected and test.name in likeliest):
            continue
        likeliest |= set() if test.rejected else {test.name}
        num_others = 0 if test.rejected else sum(other.name == test.name and not other.rejected for other in tests) - 1
        filled = min(test.statistic / (2 * test.threshold), 1.0) if test.threshold else 0.0
        bar = Markup('<meter min="0" max="1" high="0.5" optimum="0" value="{:.3f}"></meter>').format(filled)
        unfound = "would not be found" if test.smallest_detectable is None else "not found"
        others = f" ({num_others} others of this kind have less evidence)" if num_others else ""
        cells = _cells(f"tests.{i}", test, dict.fromkeys(numbers, partial(fixed, decimals=4)))
        effect = test.effect_on_scale
        effect_percent = fixed(None if effect is None else 100 * effect, 2)
        cells.append(keyed(f"tests.{i}.effect_on_scale", effect, effect_percent, times=100))
        cells += _cells(f"tests.{i}", test, {"effect_on_place_m": partial(fixed, decimals=4)})
        unit = "fraction" if test.unit == "1" else test.unit
        verdict = "found" if test.rejected else unfound
        rows.append([mistake_in_words(test.name, test.subject), f"{test.words}{others}", bar, verdict, unit, *cells])
    return ReportTable(
        "Mistakes that the ranges show" if are_found else "Mistakes that were tested for and not found",
        [
            "mistake",
            "what the ranges say" if are_found else "if it was made",
            "evidence",
            "",
            "unit",
            *numbers.values(),
            "effect on scale %",
            "on places m",
        ],
        rows,
        f"{note}.",
        kind="mistakes",
    )


def reliability(content: Content) -> ReportTable:
    """Return the table of how much of each given thing the others check, with the bound on the scale below it."""
    kinds, bound = list(CHECKED_KINDS), content.summary.reliability
    given = [test for test in content.summary.tests if test.name in kinds and test.redundancy is not None]
    given.sort(key=lambda test: (kinds.index(test.name), natural_order(test.subject)))
    rows = [
        [
            mistake_in_words(test.name, test.subject),
            "untested" if test.is_checked is False else percent(test.redundancy),
            percent(test.smallest_detectable) if test.unit == "1" else rough(test.smallest_detectable, test.unit),
            percent(test.effect_on_scale),
        ]
        for test in given
    ]
    note = (
        "Checked: how much of an error in it the other observations show (redundancy number); the rest would move the "
        "map. Untested: they show no error that is possible. The smallest error found is found in four cases of five; "
        "in the fifth it changes the scale by as much as the last column says."
    )
    if bound is not None and bound.scale_within is not None:
        worst = f" (worst case: {bound.limited_by})" if bound.limited_by else ""
        note += (
            f" If one mistake was made and not noticed{worst}, the scale is off by {percent(bound.scale_within)} at "
            f"most (risk of more: {bound.risk:g})."
        )
    header = ["given value", "checked", "smallest error found", "its effect on the scale"]
    return ReportTable("How well given values are checked", header, rows, note)


def comparison(content: Content) -> ReportTable:
    """Return the table of the comparison with the reference, which is the table of the 2018 paper."""
    columns = dict.fromkeys(("rmse_m", "rmse_se3_m", "rmse_sim3_m"), partial(fixed, decimals=4))
    columns["scale_error_percent"] = partial(signed, decimals=3)
    rows = [[row.name, *_cells(f"comparison.{i}", row, columns)] for i, row in enumerate(content.summary.comparison)]
    return ReportTable(
        "Keyframe centres against the reference",
        ["trajectory", rmse_heading(content.summary.frame), "after SE(3) m", "after Sim(3) m", "scale error %"],
        rows,
        f"The first RMSE is computed {_ALIGNED[content.summary.frame]}. The others are computed after the best rigid "
        "motion, SE(3), and after the best similarity, Sim(3), which also removes an error of the scale.",
    )


def two_candidates(content: Content) -> ReportTable:
    """Return the table of the paper's two branches of scale candidates, with mean and standard deviation."""
    given, rows = content.summary.scale.two_candidate, []
    for name in () if given is None else ("alpha0", "alpha1"):
        cells = _cells(f"scale.two_candidate.{name}", getattr(given, name), {"mean": plain, "std": plain})
        rows.append([name, *cells, "chosen" if given and given.chosen == name else ""])
    return ReportTable(
        "The paper's two candidates",
        ["candidates", "mean", "stddev", ""],
        rows,
        "Each range has two possible scales; alpha0 is the smaller one. The paper takes the mean of the candidates "
        "with the smaller standard deviation. A range that says little about the scale has candidates far away, which "
        "spoil the mean. Other methods do not use it.",
    )


def anchors(content: Content) -> ReportTable:
    """Return the table of the anchors: positions, their standard deviations, and range biases."""
    given = content.summary.anchors
    rows = [_anchor(anchor_id, given[anchor_id]) for anchor_id in sorted({*given}, key=natural_order)]
    header = ["anchor", "x m", "y m", "z m", "± m (95 %)", "Δx m", "Δy m", "Δz m", "range bias m", "mirror image at m"]
    note = (
        f"Coordinates are in {frame_in_words(content)}. Δ: estimated minus given position. ± 0: the given position was "
        "taken as exact. Range bias: by how much ranges to the anchor are too long. Mirror image: another position "
        "that fits the ranges as well."
    )
    return ReportTable("Anchors", header, rows, note)


def _anchor(anchor_id: str, anchor: AnchorEntry) -> list[str]:
    key, nowhere = f"anchors.{anchor_id}", (None, None, None)
    position, surveyed = anchor.position_m or nowhere, anchor.surveyed_position_m or nowhere
    moved = [None if a is None or b is None else a - b for a, b in zip(position, surveyed)]
    return [
        anchor_id,
        *(keyed(f"{key}.position_m.{axis}", x, fixed(x, 3)) for axis, x in enumerate(position)),
        *_cells(key, anchor, {"stddev_m": partial(fixed, decimals=3)}),
        *(signed(by, 3) for by in moved),
        *_cells(key, anchor, {"range_bias_m": partial(signed, decimals=3)}),
        " ".join(fixed(x, 3) for x in anchor.mirror_position_m or ()) or "none",
    ]


def distances(content: Content) -> ReportTable:
    """Return the table of taped distances: those that helped to fix the scale (control) and those that check it."""
    columns = dict.fromkeys(("measured_m", "stddev_m", "estimated_m"), partial(fixed, decimals=4))
    columns["residual_m"] = partial(signed, decimals=4)
    rows = [
        [f"{row.from_} to {row.to}", row.kind, *_cells(f"distances.{i}", row, columns)]
        for i, row in enumerate(content.summary.distances)
    ]
    header = ["distance", "kind", "by tape m", "± m (95 %)", "in the map m", "difference m"]
    return ReportTable("Control and check distances", header, rows)


def of_kinds(content: Content, section: str) -> Iterator[ReportTable]:
    """Yield a table for each kind of measurement whose entry says that it has one in a section."""
    for key, entry in content.summary.of_kinds.items():
        if entry.section == section:
            yield _listed(entry.caption, content, key, entry.meanings)


def control_points(content: Content) -> ReportTable:
    """Return the table of control and check points: known and found coordinates, and the root mean square of both."""
    given, rows = content.summary.points, []
    for i, row in enumerate(() if given is None else given.points):
        off = row.residual_m or (None,) * 3
        known = [keyed(f"points.points.{i}.known_m.{axis}", x, fixed(x, 3)) for axis, x in enumerate(row.known_m)]
        cells = _cells(f"points.points.{i}", row, {"stddev_m": partial(fixed, decimals=3)})
        rows.append([row.marker, row.kind, *known, *cells, *(signed(x, 3) for x in off), fixed(row.distance_m, 3)])
    for kind in ("control", "check") if given is not None else ():
        errors = getattr(given, kind)
        if errors.rmse_m is not None:
            axes = [fixed(x, 3) for x in errors.rmse_m]
            rows.append([f"RMSE of {errors.num}", kind, "", "", "", "", *axes, fixed(errors.rmse_3d_m, 3)])
    header = ["point", "kind", "x m", "y m", "z m", "stddev m", "Δx m", "Δy m", "Δz m", "distance m"]
    note = "Δ: in the map minus known. Control points are used; check points take no part in the estimate."
    return ReportTable("Control and check points", header, rows, note)


def intrinsics(content: Content) -> ReportTable:
    """Return the table of the cameras' intrinsics before the refinement and, if there was one, after it."""
    header, rows = ["camera", "parameter", "scaled", "refined", "change"], []
    num_columns = 5 if content.refined else 3
    both = content.scaled_cameras, content.refined_cameras
    for camera_id, camera in (both[1] or both[0]).items():
        title = f"{camera_id} {camera.model.name} {camera.width} × {camera.height}"
        for k, name in enumerate(camera.params_info.split(",")):
            before, after = (of[camera_id].params[k] if camera_id in of else math.nan for of in both)
            cells = [title, name.strip(), fixed(before, 6), fixed(after, 6), signed(after - before, 6)]
            rows.append(cells[:num_columns])
    return ReportTable("Cameras", header[:num_columns], rows)


def notes(content: Content) -> ReportTable:
    """Return the table of how the inputs were understood."""
    return ReportTable("How the inputs were understood", [], [[sentence(note)] for note in content.summary.notes])


def inputs(content: Content) -> ReportTable:
    """Return the table of the files from which the result was made."""
    rows = [
        [entry.path, *_cells(f"inputs.{i}", entry, {"bytes": count}), entry.sha256, entry.hashed]
        for i, entry in enumerate(content.summary.inputs)
    ]
    return ReportTable("Inputs", ["file", "bytes", "SHA-256", "of"], rows, kind="settings")


def stages(content: Content) -> ReportTable:
    """Return the table of the time that each stage took."""
    known = {name: s for name, s in content.summary.seconds.items() if s is not None and name != "total"}
    longest = max(known.values(), default=0.0) or 1.0
    bar = Markup('<i class="bar" style="width:{:.1f}%"></i>')
    rows = [[name.replace("_", " "), duration(s), bar.format(100.0 * s / longest)] for name, s in known.items()]
    return ReportTable("Time", ["stage", "time", ""], rows, kind="stages", is_narrow=True)


def refinement(content: Content) -> ReportTable:
    """Return the table of what the refinement did."""
    return _listed("Refinement", content, "refine", _REFINEMENT)


def error_budget(content: Content) -> ReportTable:
    """Return the table of the components of the scale's 95 % interval, the largest first."""
    parts = content.summary.scale.relative_stddev.components
    words = component_words(parts)
    rows = [
        [words[name], fixed(100 * NORMAL_95 * stddev, 2)]
        for name, stddev in sorted(parts.items(), key=lambda part: -part[1])
    ]
    note = (
        "Each is half of the 95 % interval that this error alone would cause. Together they count as the root of the "
    )
    note += "sum of their squares."
    return ReportTable("What makes up the scale's 95 % interval", ["errors", "± %"], rows, note, is_narrow=True)


def sensitivity(content: Content) -> ReportTable:
    """Return the table of how much the scale would change, in percent, if ranges or lever arm were longer."""
    given = content.summary.scale.sensitivity
    percents = {
        "1 cm, all ranges": given.common_bias_per_cm,
        "1 cm, the shorter half of the ranges": given.short_range_per_cm,
        **{f"1 cm, ranges of anchor {name}": value for name, value in given.anchor_bias_per_cm.items()},
        "1 % of its length, each range": given.range_slope_per_percent,
        **{f"1 cm, lever arm {way}": value for way, value in zip(_WAYS, given.lever_arm_per_cm)},
    }
    rows = [[what, signed(percent, 3)] for what, percent in percents.items() if content.summary.has_ranges]
    title = "Change of the scale if a length were longer than assumed"
    return ReportTable(title, ["longer by", "scale %"], rows, is_narrow=True)


def scale_by_kind(content: Content) -> ReportTable:
    """Return the table of the scale from ranges alone and from measured lengths alone."""
    columns = dict.fromkeys(("value", "stddev"), plain)
    rows = [
        [f"{kind} alone", *_cells(f"scale.by_kind.{kind}", entry, columns)]
        for kind, entry in content.summary.scale.by_kind.items()
    ]
    return ReportTable(
        "The scale from each kind of measurement", ["from", "metres per unit", "± (95 %)"], rows, is_narrow=True
    )


def versions(content: Content) -> ReportTable:
    """Return the table of the versions of the software."""
    return ReportTable("Versions", [], [*map(list, content.summary.versions.items())], is_narrow=True)


def settings(content: Content) -> ReportTable:
    """Return the table of the settings of the run, with the meaning of each key."""
    given = content.summary.settings.to_json()
    known = [item for item in KEYS if (given.get(item.table) or {}).get(item.name) not in (None, [], {})]
    rows = [[item.meaning, plain(given[item.table][item.name]), f"[{item.table}] {item.name}"] for item in known]
    return ReportTable("Settings", ["meaning", "value", "key of the survey file"], rows, kind="settings")


def _listed(caption: str, content: Content, key: str, words: Mapping[str, str]) -> ReportTable:
    """Return the table of the known values of an entry of ``result.json``, each with its words."""
    entry = getattr(content.summary, key)
    values = {} if entry is None else entry.to_json()
    known = {name: values[name] for name in words if values.get(name) not in (None, "", {}, [])}
    rows = [[words[name], keyed(f"{key}.{name}", value, plain(value))] for name, value in known.items()]
    return ReportTable(caption, [], rows, is_narrow=True)


def _cells(key: str, entry: object, columns: _Columns) -> list[str]:
    """Return cells with numbers of an entry of ``result.json``; ``columns`` has a formatter for each by its name.

    Of a standard deviation, the cell has half of the 95 % interval.
    """
    cells = []
    for name, show in columns.items():
        value = getattr(entry, name)
        times = NORMAL_95 if value is not None and "stddev" in name else 1.0
        cells.append(keyed(f"{key}.{name}", value, show(value if times == 1.0 else times * value), times=times))
    return cells
