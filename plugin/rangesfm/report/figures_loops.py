"""Figure of the loops: which keyframes matches tie together, before and after they were closed."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from rangesfm.arrays import Array
from rangesfm.report.content import Content
from rangesfm.report.plot import Figure, Panel, Series
from rangesfm.result.result_tables import LoopPairs

_SIZE = (420.0, 420.0)


def loops_figure(content: Content) -> Iterator[Figure]:
    """Yield the graph of matches: a dot for each pair of keyframes that closed a loop, or contradicted the ranges."""
    pairs, path = content.result.read(LoopPairs), content.final
    if not pairs or not path:
        return
    number = {name: k for k, name in enumerate(path.image_names, 1)}

    def dots(status: str) -> Array:
        of_status = [pair for pair in pairs.pairs(status) if number.keys() >= set(pair)]
        numbers = [(number[first], number[second]) for first, second in of_status]
        return np.sort(np.array(numbers, dtype=np.float64).reshape(-1, 2), axis=1)

    along = np.arange(1.0, len(path) + 1)
    series = (
        Series("neighbours in time", "before", np.column_stack([along, along]), "line", is_data=False),
        Series("closed a loop", "after", dots("closed")),
        Series("contradict the measurements", "reference", dots("contradicted")),
    )
    panel = Panel(
        "",
        "pairs of keyframes that matches tie together",
        ("keyframe", "matched with keyframe"),
        tuple(one for one in series if len(one.points)),
        size=_SIZE,
        keeps_shape=True,
    )
    caption = "Pairs of keyframes that match: neighbours in time are on the line, loops are away from it."
    yield Figure("loops", caption, (panel,))
