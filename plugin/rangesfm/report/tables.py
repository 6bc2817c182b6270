"""The report's tables, each from Content."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from markupsafe import Markup

from rangesfm.report.content import Content, Summary, as_number, in_natural_order, is_position
from rangesfm.report.text import count, duration, fixed, keyed, plain, signed

Array = npt.NDArray[np.float64]


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
            plain(row.get("name")),
            *(keyed(f"comparison.{i}.{key}", row.get(key), write(row.get(key), n)) for key, write, n in columns),
        ]
        for i, row in _rows_of(content, "comparison")
    ]
    return Table(
        "Keyframe centres against the reference",
        ["trajectory", "RMSE m", "after SE(3) m", "after Sim(3) m", "scale error %"],
        rows,
        "The first RMSE is without any alignment: a metric frame must speak for itself.",
    )


def _rows_of(content: Content, key: str) -> list[tuple[int, dict[str, Any]]]:
    """Entries of a list of the result, each with its place in it; whatever is not an object is left out."""
    given = content.summary.get(key)
    return [(i, row) for i, row in enumerate(given if isinstance(given, list) else []) if isinstance(row, dict)]


def two_candidates(content: Content) -> Table:
    """Mean and standard deviation of the paper's two branches."""
    given = content.summary.table("scale", "two_candidate")
    branches = [(name, given.get(name)) for name in ("alpha0", "alpha1")]
    rows = [
        [
            name,
            *(
                keyed(f"scale.two_candidate.{name}.{key}", branch.get(key), plain(branch.get(key)))
                for key in ("mean", "std")
            ),
            "chosen" if given.get("chosen") == name else "",
        ]
        for name, branch in branches
        if isinstance(branch, dict)
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
    rows = [
        [
            anchor_id,
            *_keyed_coordinates(f"anchors.{anchor_id}.position_m", anchor.get("position_m")),
            Markup(" ").join(
                keyed(f"anchors.{anchor_id}.{key}", value, fixed(value, 3))
                for key, value in _stddevs(anchor.get("stddev_m"))
            ),
            *(signed(value, 3) for value in _difference(anchor)),
            keyed(
                f"anchors.{anchor_id}.range_bias_m", anchor.get("range_bias_m"), signed(anchor.get("range_bias_m"), 3)
            ),
            " ".join(_coordinates(anchor["mirror_position_m"])) if anchor.get("mirror_position_m") else "none",
        ]
        for anchor_id, anchor in _anchors_in_order(content.summary)
    ]
    header = ["anchor", "x m", "y m", "z m", "stddev m", "Δx m", "Δy m", "Δz m", "range bias m", "mirror image at m"]
    note = "Δ: estimated minus surveyed position, where it was surveyed. A stddev of 0: held there."
    return Table("Anchors in the map's frame", header, rows, note)


def _anchors_in_order(summary: Summary) -> list[tuple[str, dict[str, Any]]]:
    given = summary.table("anchors")
    return [
        (anchor_id, given[anchor_id]) for anchor_id in in_natural_order(given) if isinstance(given[anchor_id], dict)
    ]


def _difference(anchor: dict[str, Any]) -> list[float | None]:
    """Estimated minus surveyed position."""
    estimated, surveyed = anchor.get("position_m"), anchor.get("surveyed_position_m")
    if is_position(estimated) and is_position(surveyed):
        return [a - b for a, b in zip(estimated, surveyed)]
    return [None] * 3


def distances(content: Content) -> Table:
    """Taped distances, those that held the scale and those that check it."""
    columns = (("measured_m", fixed), ("stddev_m", fixed), ("estimated_m", fixed), ("residual_m", signed))
    rows = [
        [
            f"{plain(row.get('from'))} to {plain(row.get('to'))}",
            plain(row.get("kind")),
            *(keyed(f"distances.{i}.{key}", row.get(key), write(row.get(key), 4)) for key, write in columns),
        ]
        for i, row in _rows_of(content, "distances")
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
    rows = _flattened(content.summary, "scale", "cutoff_test") + _flattened(content.summary, "scale", "sensitivity")
    return Table("How the scale answers to what was assumed", [], rows)


def inputs(content: Content) -> Table:
    """The files that the result was made from."""
    rows = [
        [
            plain(row.get("path")),
            keyed(f"inputs.{i}.bytes", row.get("bytes"), count(row.get("bytes"))),
            plain(row.get("sha256")),
            plain(row.get("hashed")),
        ]
        for i, row in _rows_of(content, "inputs")
    ]
    return Table("Inputs", ["file", "bytes", "SHA-256", "of"], rows, kind="settings")


def stages(content: Content) -> Table:
    """Where the time went."""
    seconds = {name: as_number(value) for name, value in content.summary.table("seconds").items()}
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
        for name, value in content.summary.table("refine").items()
    ]
    return Table("Refinement", [], rows)


def versions(content: Content) -> Table:
    """What the result was made with."""
    return Table("Versions", [], _flattened(content.summary, "versions"))


def settings(content: Content) -> Table:
    """What was asked for."""
    return Table("Settings", [], _flattened(content.summary, "settings"), kind="settings")


def _fixed_or_nothing(values: Array, measure: Any, *, root: bool = False) -> str:
    if len(values) == 0:
        return fixed(None, 3)
    value = float(measure(values))
    return fixed(value**0.5 if root else value, 3)


def _coordinates(position: Any) -> list[str]:
    values = position if isinstance(position, list) and len(position) == 3 else [None] * 3
    return [fixed(value, 3) for value in values]


def _keyed_coordinates(key: str, position: Any) -> list[str]:
    values = position if is_position(position) else [None] * 3
    return [keyed(f"{key}.{axis}", value, fixed(value, 3)) for axis, value in enumerate(values)]


def _stddevs(value: Any) -> list[tuple[str, Any]]:
    """One for all coordinates or one for each, with their keys."""
    if isinstance(value, list):
        return [(f"stddev_m.{axis}", item) for axis, item in enumerate(value)]
    return [("stddev_m", value)]


def _flattened(summary: Summary, *keys: str) -> list[list[str]]:
    """Rows of key and value of a nested object, keys joined by dots."""
    rows = []
    for key in summary.table(*keys):
        if summary.table(*keys, key):
            rows += [[f"{key}.{inner}", value] for inner, value in _flattened(summary, *keys, key)]
        else:
            rows.append([key, plain(summary.get(*keys, key))])
    return rows
