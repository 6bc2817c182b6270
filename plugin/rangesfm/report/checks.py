"""Quality checks of a result: numbers that a careful reader looks at first, each with its limits."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from operator import attrgetter
from typing import Any

from markupsafe import Markup

from rangesfm.report.text import count, decimals_for, fixed, keyed, sentence, signed
from rangesfm.result.entries import ScaleEntry
from rangesfm.result.summary import ResultSummary


@dataclass(frozen=True)
class QualityCheck:
    """One traffic light.

    Attributes:
        name: heading of the check.
        meaning: one sentence that says what the value is.
        value: None where the run did not measure it.
        unit: of value and limits.
        green_limit, amber_limit: the light is green up to the first limit, amber up to the second and red beyond it;
            where larger is better, green from the first limit upwards, amber from the second and red below it.
        decimals: of the value as shown.
        larger_is_better: whether the limits are lower bounds.
        key: of the value in ``result.json``; empty where it is computed from several.
        no_matter: reason why the value does not matter in this survey, so that the light is green; None: it matters.
    """

    name: str
    meaning: str
    value: float | None
    unit: str
    green_limit: float
    amber_limit: float
    decimals: int
    larger_is_better: bool = False
    key: str = ""
    no_matter: str | None = None

    @property
    def light(self) -> str:
        """Return the colour of the light: "green", "amber", "red", or "off" without a value."""
        if self.value is None:
            return "off"
        if self.no_matter is not None:
            return "green"
        sign = -1.0 if self.larger_is_better else 1.0
        if sign * self.value <= sign * self.green_limit:
            return "green"
        return "amber" if sign * self.value <= sign * self.amber_limit else "red"

    @property
    def text(self) -> str:
        text = fixed(self.value, self.decimals, self.unit, nothing="not measured")
        return keyed(self.key, self.value, text) if self.key else text

    @property
    def limits(self) -> str:
        """Return the limits as text, as in "green ≤ 1 px · amber ≤ 2 px"."""
        relation = "≥" if self.larger_is_better else "≤"
        green, amber = (fixed(x, 0 if x >= 1 else 2, self.unit) for x in (self.green_limit, self.amber_limit))
        return f"green {relation} {green} · amber {relation} {amber}"

    @property
    def zones(self) -> list[tuple[str, float]]:
        """Return colour and width (percent of the gauge) of each zone, from zero to the end of the gauge."""
        low, high = sorted(100.0 * limit / self._gauge_end for limit in (self.green_limit, self.amber_limit))
        colors = ("red", "amber", "green") if self.larger_is_better else ("green", "amber", "red")
        return list(zip(colors, (low, high - low, 100.0 - high)))

    @property
    def needle_percent(self) -> float | None:
        """Return the position of the value on the gauge, in percent of its length; None without a value."""
        return None if self.value is None else min(max(100.0 * self.value / self._gauge_end, 0.0), 100.0)

    @property
    def _gauge_end(self) -> float:
        return 100.0 if self.larger_is_better else 1.5 * self.amber_limit


def quality_checks(summary: ResultSummary) -> tuple[QualityCheck, ...]:
    """Return the checks of a result, the most important one first."""
    scale, ranges, offset = summary.scale, summary.ranges, summary.time_offset
    uncertainty = _relative_percent(scale.larger_stddev, scale.value)
    share_used = _relative_percent(ranges.num_used, ranges.num)
    reprojection_px = None if summary.refine is None else summary.refine.reprojection_rms_px

    def told(key: str, text_of: Callable[[Any], str] = count) -> str:
        value = attrgetter(key)(summary)
        return keyed(key, value, text_of(value))

    def by_digits(value: float | None) -> str:
        return fixed(value, decimals_for(value, default=5))

    of_scale = Markup("One standard deviation: the larger of the formal, {}, and the empirical one, {}.").format(
        told("scale.stddev_formal", by_digits), told("scale.stddev_empirical", by_digits)
    )
    of_anchors = "Largest difference between the scale from one anchor alone and the joint scale."
    of_check_ranges = Markup("RMS residual of {} ranges that were held out of all estimates.").format(
        told("check_ranges.num")
    )
    of_ranges = Markup("RMS residual of the ranges used; half of the residuals are below {}.").format(
        told("ranges.median_abs_m", lambda x: fixed(x, 3, "m"))
    )
    of_share = Markup("{} of the {} ranges in the log were used.").format(told("ranges.num_used"), told("ranges.num"))
    decimals = min(decimals_for(offset.stddev_s, default=3), 6)
    of_clocks = Markup("Standard deviation of the time offset (image time minus range time), which is {}.").format(
        told("time_offset.value_s", lambda x: signed(x, decimals, "s"))
    )
    of_points = "RMS distance in the photos between the points of the map and the features that show them."
    does_not = sentence(offset.note or "any offset near this one gives the same result")
    no_matter = does_not if offset.offset_matters is False else None
    checked_m, clocks_s = summary.check_ranges.rms_m, offset.stddev_s
    checks_of_ranges = (
        QualityCheck("Anchor agreement", of_anchors, _anchor_spread_percent(scale), "%", 2.0, 5.0, 2),
        QualityCheck("Check ranges", of_check_ranges, checked_m, "m", 0.20, 0.40, 3, key="check_ranges.rms_m"),
        QualityCheck("Range residuals", of_ranges, ranges.rms_m, "m", 0.15, 0.30, 3, key="ranges.rms_m"),
        QualityCheck("Ranges used", of_share, share_used, "%", 70.0, 40.0, 1, larger_is_better=True),
        QualityCheck(
            "Clock offset", of_clocks, clocks_s, "s", 0.02, 0.1, 4, key="time_offset.stddev_s", no_matter=no_matter
        ),
    )
    return (
        QualityCheck("Scale uncertainty", of_scale, uncertainty, "%", 1.0, 5.0, 2),
        *(checks_of_ranges if summary.has_ranges else ()),
        QualityCheck("Reprojection", of_points, reprojection_px, "px", 1.0, 2.0, 2, key="refine.reprojection_rms_px"),
    )


def _relative_percent(part: float | None, whole: float) -> float | None:
    return None if part is None or not whole else 100.0 * part / whole


def _anchor_spread_percent(scale: ScaleEntry) -> float | None:
    known = [value for value in scale.per_anchor.values() if value is not None]
    return None if not scale.value or len(known) < 2 else max(100.0 * abs(one / scale.value - 1.0) for one in known)
