"""Numbers at the top of the report: how sure the scale is, and how large the survey was."""

from __future__ import annotations

from collections.abc import Callable
from functools import reduce
from typing import Any

import numpy as np
from markupsafe import Markup

from rangesfm.report.content import Content
from rangesfm.report.text import count, decimals_for, duration, fixed, keyed, signed
from rangesfm.result.entries import ScaleEntry


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
    offset_decimals = min(decimals_for(summary.time_offset.stddev_s, default=3), 6)

    def shown(key: str, write: Callable[..., str], *how: object) -> str:
        value: Any = reduce(lambda entry, name: entry and getattr(entry, name), key.split("."), summary)
        return keyed(key, value, write(value, *how))

    return [
        ("Keyframes", count(None if path is None else len(path)), f"path of {fixed(length_m, 2, 'm')}"),
        (
            "Ranges used",
            shown("ranges.num_used", count),
            Markup("of {} in the log").format(shown("ranges.num", count)),
        ),
        (
            "Range RMS",
            shown("ranges.rms_m", fixed, 3, "m"),
            Markup("median {}").format(shown("ranges.median_abs_m", fixed, 3, "m")),
        ),
        (
            "Check range RMS",
            shown("check_ranges.rms_m", fixed, 3, "m"),
            Markup("{} held out").format(shown("check_ranges.num", count)),
        ),
        (
            "Reprojection RMS",
            shown("refine.reprojection_rms_px", fixed, 2, "px"),
            f"{count(num_points)} map points",
        ),
        (
            "Clock offset",
            shown("time_offset.value_s", signed, offset_decimals, "s"),
            Markup("± {}").format(shown("time_offset.stddev_s", fixed, offset_decimals, "s")),
        ),
        ("Time taken", duration(_total_seconds(summary.seconds)), "all stages"),
    ]


def _total_seconds(seconds: dict[str, float | None]) -> float | None:
    known = [value for value in seconds.values() if value is not None]
    return seconds.get("total") or (sum(known) if known else None)
