"""Accuracy in figures: numbers of a result that a careful reader looks at first, with the limits of the verdict."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from operator import attrgetter
from typing import Any

from markupsafe import Markup

from rangesfm.measurements.mistake_words import mistake_in_words
from rangesfm.report.text import count, decimals_for, fixed, keyed, known, sentence, signed
from rangesfm.result.summary import ResultSummary
from rangesfm.util.geometry.numerics import DOUBTFUL_ABOVE, NORMAL_95


@dataclass(frozen=True)
class QualityCheck:
    """One number, with a traffic light if the verdict has a limit for it.

    Attributes:
        meaning: one sentence that says what the value is.
        value: NaN where the run did not measure it.
        limit: the verdict is doubtful if the value is larger; inf: the value alone does not change the verdict.
        key: of the value in ``result.json``; empty where it is computed from several.
        times: factor of the value over that in ``result.json``.
    """

    name: str
    meaning: str
    value: float
    unit: str
    decimals: int
    limit: float = math.inf
    key: str = ""
    times: float = 1.0

    @property
    def light(self) -> str:
        """Return the colour of the light, "green" or "amber", or "off" without a value; empty: there is no limit."""
        if math.isinf(self.limit):
            return ""
        return "off" if math.isnan(self.value) else "green" if self.value <= self.limit else "amber"

    @property
    def text(self) -> str:
        text = fixed(self.value, self.decimals, self.unit, nothing="not measured")
        given = None if math.isnan(self.value) else self.value / self.times
        return keyed(self.key, given, text, times=self.times) if self.key else text

    @property
    def limit_in_words(self) -> str:
        return "" if math.isinf(self.limit) else f"Doubtful above {fixed(self.limit, self.decimals, self.unit)}."


def quality_checks(summary: ResultSummary) -> tuple[QualityCheck, ...]:
    """Return the checks of a result, the most important one first."""
    half_width = summary.scale.half_width_95
    of_scale = "Half of the 95 % interval of the scale: lengths in the map may be off by as much."
    width_percent = math.nan if half_width is None else 100 * half_width
    reprojection_px = known(None if summary.refine is None else summary.refine.reprojection_rms_px)
    of_points = "RMS distance in the photos between the points of the map and the features that show them."
    return (
        QualityCheck("Scale", of_scale, width_percent, "%", 1, limit=100 * DOUBTFUL_ABOVE),
        *(_checks_of_ranges(summary) if summary.has_ranges else ()),
        QualityCheck("Photos", of_points, reprojection_px, "px", 2, key="refine.reprojection_rms_px"),
    )


def _checks_of_ranges(summary: ResultSummary) -> Iterator[QualityCheck]:
    ranges, offset = summary.ranges, summary.time_offset

    def marked(key: str, text_of: Callable[[Any], str] = count) -> str:
        value = attrgetter(key)(summary)
        return keyed(key, value, text_of(value))

    for i, test in enumerate(summary.tests):
        if meaning := _OF_ALL_RANGES.get(test.name):
            name = mistake_in_words(test.name, test.subject).capitalize()
            yield QualityCheck(name, meaning, test.statistic, "m", 3, limit=test.threshold, key=f"tests.{i}.statistic")
    of_ranges = Markup("RMS difference between the ranges used and the map; half of the differences are below {}.")
    median = marked("ranges.median_abs_m", lambda x: fixed(x, 3, "m"))
    yield QualityCheck("Ranges and map", of_ranges.format(median), known(ranges.rms_m), "m", 3, key="ranges.rms_m")
    of_check = Markup("RMS difference between the map and {} ranges that took no part in the estimate.")
    num, checked_m = marked("check_ranges.num"), known(summary.check_ranges.rms_m)
    if summary.check_ranges.num:
        yield QualityCheck("Check ranges", of_check.format(num), checked_m, "m", 3, key="check_ranges.rms_m")
    of_share = Markup("{} of the {} ranges in the log were used.").format(
        marked("ranges.num_used"), marked("ranges.num")
    )
    share_percent = 100.0 * ranges.num_used / ranges.num if ranges.num else math.nan
    yield QualityCheck("Ranges used", of_share, share_percent, "%", 1)
    decimals = min(decimals_for(offset.stddev_s, default=3), 6)
    of_clocks = Markup("Half of the 95 % interval of the time offset (image time minus range time), which is {}. {}")
    value = marked("time_offset.value_s", lambda x: signed(x, decimals, "s"))
    does_not = sentence(offset.note or "any offset near this one gives the same result")
    text_of_clocks = of_clocks.format(value, does_not if offset.offset_matters is False else "")
    within_s, key = NORMAL_95 * known(offset.stddev_s), "time_offset.stddev_s"
    yield QualityCheck("Clocks", text_of_clocks, within_s, "s", 3, key=key, times=NORMAL_95)


# Tests whose value is the size of an error of all ranges, with the meaning of that size.
_OF_ALL_RANGES = {
    "range noise": "Standard deviation of a range from those right before and after; lasting errors are not in it.",
    "lasting errors": "RMS error that is the same in ranges within seconds, as by antennas or a blocked line of sight.",
}
