"""The report's tables, each from Content."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from markupsafe import Markup

from rangesfm.arrays import Array
from rangesfm.report.content import Content, in_natural_order
from rangesfm.report.text import count, duration, fixed, keyed, plain, signed
from rangesfm.result.entries import AnchorEntry


@dataclass(frozen=True)
class Table:
    """A table as the page has it, which leaves it out if it has no rows.

    Attributes:
        header: of the columns; empty for none.
        rows: cells, the first of each the row's name; whatever is not Markup is escaped.
        kind: name of a style of its own.
    """

    caption: str
    header: Sequence[str]
    rows: Sequence[Sequence[str]]
    note: str | None = None
    kind: str | None = None


def range_statuses(content: Content) -> Table:
    """What became of the log's ranges."""
    statuses = Counter([] if content.ranges is None else content.ranges.status)
    rows = [[name, count(num), fixed(100.0 * num / statuses.total(), 1, "%")] for name, num in statuses.most_common()]
    return Table("What became of the ranges", ["status", "ranges", "share"], rows)


def ranges_per_anchor(content: Content) -> Table:
    """Numbers and residuals of each anchor's ranges, before and after the refinement."""
    ranges = content.ranges
    rows = []
    for anchor_id in [] if ranges is None else in_natural_order(ranges.anchor_id):
        assert ranges is not None
        mine = np.array(ranges.anchor_id, dtype=str) == anchor_id
        used = mine & ranges.is_used
        row = [anchor_id, count(int(mine.sum())), count(int(used.sum()))]
        for residuals in (ranges.residual_scaled_m[used], ranges.residual_refined_m[used]):
            known = residuals[np.isfinite(residuals)]
            row += [_fixed_or_nothing(known**2, np.mean, root=True), _fixed_or_nothing(known, np.median)]
        rows.append(row)
    header = ["anchor", "ranges", "used", "scaled: RMS m", "median m", "refined: RMS m", "median m"]
    return Table("Ranges of each anchor", header, rows)


def comparison(content: Content) -> Table:
    """The paper's table."""
    columns = (
        ("rmse_m", fixed, 4),
        ("rmse_se3_m", fixed, 4),
        ("rmse_sim3_m", fixed, 4),
        ("scale_error_percent", signed, 3),
    )
    rows = [
        [
            row.name,
            *(
                keyed(f"comparison.{i}.{key}", getattr(row, key), write(getattr(row, key), n))
                for key, write, n in columns
            ),
        ]
        for i, row in enumerate(content.summary.comparison)
    ]
    return Table(
        "Keyframe centres against the reference",
        ["trajectory", "RMSE m", "after SE(3) m", "after Sim(3) m", "scale error %"],
        rows,
        "The first RMSE is without any alignment: a metric frame must speak for itself.",
    )


def two_candidates(content: Content) -> Table:
    """Mean and standard deviation of the paper's two branches."""
    given = content.summary.scale.two_candidate
    branches = [] if given is None else [("alpha0", given.alpha0), ("alpha1", given.alpha1)]
    rows = [
        [
            name,
            keyed(f"scale.two_candidate.{name}.mean", branch.mean, plain(branch.mean)),
            keyed(f"scale.two_candidate.{name}.std", branch.std, plain(branch.std)),
            "chosen" if given and given.chosen == name else "",
        ]
        for name, branch in branches
    ]
    return Table(
        "The paper's two candidates",
        ["branch", "mean", "stddev", ""],
        rows,
        "Each range has two possible scales; the paper takes the mean of the branch with the smaller standard "
        "deviation. Shown for comparison: other methods do not use it.",
    )


def anchors(content: Content) -> Table:
    """Where the anchors are, with what is not certain about it."""
    given = content.summary.anchors
    rows = [_anchor(f"anchors.{anchor_id}", anchor_id, given[anchor_id]) for anchor_id in in_natural_order(given)]
    header = ["anchor", "x m", "y m", "z m", "stddev m", "Δx m", "Δy m", "Δz m", "range bias m", "mirror image at m"]
    note = "Δ: estimated minus surveyed position, where it was surveyed. A stddev of 0: held there."
    return Table("Anchors in the map's frame", header, rows, note)


def _anchor(key: str, anchor_id: str, anchor: AnchorEntry) -> list[str]:
    position, surveyed, mirror = anchor.position_m, anchor.surveyed_position_m, anchor.mirror_position_m
    nowhere = (None, None, None)
    moved = zip(position, surveyed) if position and surveyed else ()
    return [
        anchor_id,
        *(keyed(f"{key}.position_m.{axis}", x, fixed(x, 3)) for axis, x in enumerate(position or nowhere)),
        keyed(f"{key}.stddev_m", anchor.stddev_m, fixed(anchor.stddev_m, 3)),
        *([signed(a - b, 3) for a, b in moved] or [signed(None, 3)] * 3),
        keyed(f"{key}.range_bias_m", anchor.range_bias_m, signed(anchor.range_bias_m, 3)),
        " ".join(fixed(x, 3) for x in mirror) if mirror else "none",
    ]


def distances(content: Content) -> Table:
    """Taped distances, those that held the scale and those that check it."""
    columns = (("measured_m", fixed), ("stddev_m", fixed), ("estimated_m", fixed), ("residual_m", signed))
    rows = [
        [
            f"{row.from_} to {row.to}",
            row.kind,
            *(keyed(f"distances.{i}.{key}", getattr(row, key), write(getattr(row, key), 4)) for key, write in columns),
        ]
        for i, row in enumerate(content.summary.distances)
    ]
    header = ["distance", "kind", "by tape m", "stddev m", "in the map m", "difference m"]
    return Table("Control and check distances", header, rows)


def intrinsics(content: Content) -> Table:
    """The cameras before and, if there was one, after the refinement."""
    header = ["camera", "parameter", "scaled", "refined", "change"]
    num_columns = 3 if content.refined is None else 5
    rows = [
        [
            f"{camera.camera_id} {camera.model} {camera.size_px[0]} × {camera.size_px[1]}",
            name,
            *(fixed(before, 6), fixed(after, 6), signed(after - before, 6))[: num_columns - 2],
        ]
        for camera in content.cameras
        for name, before, after in camera.parameters
    ]
    return Table("Cameras", header[:num_columns], rows)


def sensitivity(content: Content) -> Table:
    """How the scale answers to what was assumed, where the run tells."""
    rows = _flattened(content.summary.scale.to_json()["sensitivity"])
    return Table("How the scale answers to what was assumed", [], rows)


def inputs(content: Content) -> Table:
    """The files that the result was made from."""
    rows = [
        [entry.path, keyed(f"inputs.{i}.bytes", entry.bytes, count(entry.bytes)), entry.sha256, entry.hashed]
        for i, entry in enumerate(content.summary.inputs)
    ]
    return Table("Inputs", ["file", "bytes", "SHA-256", "of"], rows, kind="settings")


def stages(content: Content) -> Table:
    """Where the time went."""
    seconds = content.summary.seconds
    known = {name: value for name, value in seconds.items() if value is not None and name != "total"}
    longest = max(known.values(), default=0.0) or 1.0
    rows = [
        [
            name.replace("_", " "),
            duration(value),
            Markup('<i class="bar" style="width:{:.1f}%"></i>').format(100.0 * value / longest),
        ]
        for name, value in known.items()
    ]
    return Table("Time", ["stage", "time", ""], rows, kind="stages")


def refinement(content: Content) -> Table:
    """What the solver did."""
    rows = [
        [name.replace("_", " "), keyed(f"refine.{name}", value, plain(value))]
        for name, value in ({} if content.summary.refine is None else content.summary.refine.to_json()).items()
    ]
    return Table("Refinement", [], rows)


def versions(content: Content) -> Table:
    """What the result was made with."""
    return Table("Versions", [], _flattened(content.summary.versions))


def settings(content: Content) -> Table:
    """What was asked for."""
    return Table("Settings", [], _flattened(content.summary.settings.to_json()), kind="settings")


def _fixed_or_nothing(values: Array, measure: Any, *, root: bool = False) -> str:
    if len(values) == 0:
        return fixed(None, 3)
    value = float(measure(values))
    return fixed(value**0.5 if root else value, 3)


def _flattened(values: Mapping[str, Any]) -> list[list[str]]:
    """Rows of key and value of a nested object, keys joined by dots."""
    rows = []
    for key, value in values.items():
        if value and isinstance(value, dict):
            rows += [[f"{key}.{inner}", text] for inner, text in _flattened(value)]
        else:
            rows.append([key, plain(value)])
    return rows
