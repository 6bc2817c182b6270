"""The top of the report: how sure scale and place are, what would help, and how large the survey was."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence

import numpy as np

from rangesfm.report.content import Content
from rangesfm.report.text import count, duration, fixed


def said_once(texts: Iterable[str], others: Sequence[str] = ()) -> list[str]:
    """Texts without those that the others say already, or that begin as one before with the same measure."""
    said, measures = " ".join(others), set[str]()
    kept = []
    for text in texts:
        measure = re.split(r"[,;:(]", text)[0].strip()
        if text and text not in said and measure not in measures:
            kept.append(text)
        measures.add(measure)
    return kept


def tiles(content: Content) -> list[tuple[str, str, str]]:
    """Name, value and a note on it, of how large the survey was."""
    path, seconds = content.final, content.summary.seconds
    length_m = None if path is None else float(np.linalg.norm(np.diff(path.centers, axis=0), axis=1).sum())
    known = [value for value in seconds.values() if value is not None]
    return [
        ("Keyframes", count(None if path is None else len(path)), f"path of {fixed(length_m, 2, 'm')}"),
        ("Map points", count(None if path is None else len(content.points_m)), "seen by two keyframes or more"),
        *([("Anchors", count(len(content.summary.anchors)), _surveyed(content))] if content.summary.anchors else []),
        ("Time taken", duration(seconds.get("total") or (sum(known) if known else None)), "all stages"),
    ]


def _surveyed(content: Content) -> str:
    return f"{sum(a.surveyed_position_m is not None for a in content.summary.anchors.values())} of them surveyed"
