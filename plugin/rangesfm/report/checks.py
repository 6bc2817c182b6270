"""Quality checks: what a careful reader would look at first, with limits."""

from __future__ import annotations

from dataclasses import dataclass

from rangesfm.report.content import Summary, as_number
from rangesfm.report.text import sentence


@dataclass(frozen=True)
class Check:
    """One traffic light.

    Attributes:
        name: what is checked.
        meaning: one sentence on why it matters.
        value: None where the run did not measure it.
        unit: of the value and the limits.
        green_limit, amber_limit: green up to the first, amber up to the second, red beyond
            (from the first upwards, where larger is better).
        decimals: of the printed numbers.
        larger_is_better: the limits are lower ones.
        no_matter: why any value is as good here, so that the light is green; None: it matters.
    """

    name: str
    meaning: str
    value: float | None
    unit: str
    green_limit: float
    amber_limit: float
    decimals: int
    larger_is_better: bool = False
    no_matter: str | None = None

    @property
    def light(self) -> str:
        """ "green", "amber", "red", or "off" without a value."""
        if self.value is None:
            return "off"
        if self.no_matter is not None:
            return "green"
        sign = -1.0 if self.larger_is_better else 1.0
        if sign * self.value <= sign * self.green_limit:
            return "green"
        return "amber" if sign * self.value <= sign * self.amber_limit else "red"


def quality_checks(summary: Summary) -> tuple[Check, ...]:
    """The checks of a result, in the order in which they matter."""
    return (
        Check(
            "Scale uncertainty",
            "The larger of the formal and the empirical standard deviation.",
            _relative_percent(larger_stddev(summary), summary.number("scale", "value")),
            "%",
            1.0,
            5.0,
            2,
        ),
        Check(
            "Anchor agreement",
            "Farthest that the scale from one anchor alone is from the joint one.",
            _anchor_spread_percent(summary),
            "%",
            2.0,
            5.0,
            2,
        ),
        Check(
            "Check ranges",
            "RMS of ranges that no estimate has seen.",
            summary.number("check_ranges", "rms_m") if summary.number("check_ranges", "num") else None,
            "m",
            0.20,
            0.40,
            3,
        ),
        Check("Range residuals", "RMS of the ranges used.", summary.number("ranges", "rms_m"), "m", 0.15, 0.30, 3),
        Check(
            "Ranges used",
            "Share of all ranges in the log that had a say.",
            _relative_percent(summary.number("ranges", "num_used"), summary.number("ranges", "num")),
            "%",
            70.0,
            40.0,
            1,
            larger_is_better=True,
        ),
        Check(
            "Clock offset",
            "Standard deviation of the offset between the camera's and the radio's clock.",
            summary.number("time_offset", "stddev_s"),
            "s",
            0.02,
            0.10,
            4,
            no_matter=_why_no_offset_matters(summary),
        ),
        Check(
            "Reprojection",
            "RMS distance of the map's points from where the photos show them.",
            summary.number("refine", "reprojection_rms_px"),
            "px",
            1.0,
            2.0,
            2,
        ),
    )


def larger_stddev(summary: Summary) -> float | None:
    """The larger of the scale's formal and empirical stddev: formal ones are far too small on real logs."""
    both = (summary.number("scale", "stddev_formal"), summary.number("scale", "stddev_empirical"))
    return max((stddev for stddev in both if stddev is not None), default=None)


def _why_no_offset_matters(summary: Summary) -> str | None:
    if summary.get("time_offset", "offset_matters") is not False:
        return None
    return sentence(str(summary.get("time_offset", "note") or "any offset near this one gives the same result"))


def _relative_percent(part: float | None, whole: float | None) -> float | None:
    return None if part is None or not whole else 100.0 * part / whole


def _anchor_spread_percent(summary: Summary) -> float | None:
    joint = summary.number("scale", "value")
    alone = [as_number(value) for value in summary.table("scale", "per_anchor").values()]
    known = [value for value in alone if value is not None]
    return None if not joint or len(known) < 2 else max(100.0 * abs(value / joint - 1.0) for value in known)
