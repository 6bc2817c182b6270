"""Numbers at the top of the report: how sure the scale is, and how large the survey was."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import reduce
from typing import Any

import numpy as np
from markupsafe import Markup

from rangesfm.report.content import Content
from rangesfm.report.text import count, decimals_for, duration, fixed, keyed, signed
from rangesfm.result.entries import PlaceEntry, ScaleEntry


def stddevs(scale: ScaleEntry) -> list[str]:
    """The formal and the empirical stddev of the scale, as far as they are known."""
    known = {"formal": scale.stddev_formal, "empirical": scale.stddev_empirical}
    return [
        Markup("{} {}").format(kind, keyed(f"scale.stddev_{kind}", value, fixed(value, decimals_for(value, default=5))))
        for kind, value in known.items()
        if value
    ]


def tiles(content: Content) -> list[tuple[str, str, str]]:
    """Name, value and a note on it, of what one looks for first."""
    summary, path = content.summary, content.final
    length_m = None if path is None else float(np.linalg.norm(np.diff(path.centers, axis=0), axis=1).sum())
    num_points = None if path is None else len(content.points_m)

    def shown(key: str, write: Callable[..., str], *how: object, within: str = "{}") -> str:
        value: Any = reduce(lambda entry, name: entry and getattr(entry, name), key.split("."), summary)
        return Markup(within).format(keyed(key, value, write(value, *how)))

    def offset(key: str, write: Callable[..., str], within: str = "{}") -> str:
        return shown(key, write, min(decimals_for(summary.time_offset.stddev_s, default=3), 6), "s", within=within)

    def metres(key: str, within: str = "{}") -> str:
        return shown(key, fixed, 3, "m", within=within)

    of_ranges = [
        ("Ranges used", shown("ranges.num_used", count), shown("ranges.num", count, within="of {} in the log")),
        ("Range RMS", metres("ranges.rms_m"), metres("ranges.median_abs_m", "median {}")),
        ("Check range RMS", metres("check_ranges.rms_m"), shown("check_ranges.num", count, within="{} held out")),
        ("Clock offset", offset("time_offset.value_s", signed), offset("time_offset.stddev_s", fixed, "± {}")),
    ]
    return [
        *_place(summary.place),
        ("Keyframes", count(None if path is None else len(path)), f"path of {fixed(length_m, 2, 'm')}"),
        *(of_ranges if summary.ranges.num else []),
        ("Reprojection RMS", shown("refine.reprojection_rms_px", fixed, 2, "px"), f"{count(num_points)} map points"),
        ("Time taken", duration(_total_seconds(summary.seconds)), "all stages"),
    ]


def _total_seconds(seconds: dict[str, float | None]) -> float | None:
    known = [value for value in seconds.values() if value is not None]
    return seconds.get("total") or (sum(known) if known else None)


def _place(place: PlaceEntry | None) -> list[tuple[str, str, str]]:
    if place is None:
        return []
    middle, worst = fixed(math.hypot(*place.stddev_m), 2, "m"), fixed(place.worst_keyframe_stddev_m, 2, "m")
    worst = keyed("place.worst_keyframe_stddev_m", place.worst_keyframe_stddev_m, worst)
    return [("Place in the site", place.verdict, Markup("middle ± {}, worst keyframe ± {}").format(middle, worst))]
