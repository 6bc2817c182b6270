"""The top of the report: the verdict with its reasons, the scale, and how large the survey was."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from rangesfm.report.checks import larger_stddev
from rangesfm.report.content import Content, Summary, as_number
from rangesfm.report.markup import Child, Markup, element
from rangesfm.report.numbers import keyed
from rangesfm.report.text import count, decimals_for, duration, fixed, plain, sentence, signed
from rangesfm.report.traffic_lights import traffic_light

VERDICTS = {
    "good": ("green", "Good", "The scale can be trusted within its interval."),
    "doubtful": ("amber", "Doubtful", "Use the scale only with the reasons below in mind."),
    "refused": ("red", "Refused", "The ranges do not determine the scale."),
}
NORMAL_QUANTILE_95 = 1.96


def head(content: Content) -> Markup:
    """What one needs to know if one reads no further."""
    parts = [_verdict(content.summary), _scale(content.summary), _tiles(content)]
    return element("section", parts, class_="head", id="verdict")


def _verdict(summary: Summary) -> Markup:
    verdict = plain(summary.get("scale", "verdict"))
    unknown = ("off", verdict.capitalize(), "The run gave no verdict on the scale.")
    light, word, meaning = VERDICTS.get(verdict, unknown)
    text = element("div", element("h2", word), element("p", meaning))
    why = summary.texts("scale", "reasons")
    reasons = [element("li", sentence(reason)) for reason in why]
    advice = _advice(summary)
    warnings = [element("li", sentence(warning)) for warning in summary.texts("warnings") if warning not in why]
    return element(
        "div",
        element("div", traffic_light(light), text, class_=f"verdict {light}"),
        element("ul", reasons, class_="reasons") if reasons else None,
        element("div", element("h3", "What would help"), element("ul", advice), class_="advice") if advice else None,
        element("div", element("h3", "Warnings"), element("ul", warnings), class_="warnings") if warnings else None,
    )


def _advice(summary: Summary) -> list[Markup]:
    given = summary.get("scale", "advice")
    texts = [given] if isinstance(given, str) else summary.texts("scale", "advice")
    return [element("li", sentence(text)) for text in texts if text]


def _scale(summary: Summary) -> Markup:
    value, stddev = summary.number("scale", "value"), larger_stddev(summary)
    decimals = decimals_for(stddev, default=5)
    plus_minus = None if stddev is None else element("span", f" ± {fixed(stddev, decimals)}", class_="plus-minus")
    lines: list[Child] = [
        element("p", "Metres per unit of the unscaled model", class_="name"),
        element("p", keyed("scale.value", value, fixed(value, decimals)), plus_minus, class_="scale-value"),
    ]
    interval = scale_interval(summary)
    if value and stddev is not None and interval is not None:
        low, high = (fixed(end, decimals) for end in interval)
        lines.append(element("p", f"± {fixed(100.0 * stddev / value, 2, '%')} · 95 % interval {low} to {high}"))
    known = _stddevs(summary)
    if known:
        lines.append(element("p", "The larger of the standard deviations found: ", known, ".", class_="small"))
    if summary.get("scale", "method") is not None:
        lines.append(element("p", f"Method: {plain(summary.get('scale', 'method'))}", class_="small"))
    return element("div", lines, class_="scale")


def _stddevs(summary: Summary) -> list[Child]:
    """The formal and the empirical stddev, as far as they are known."""
    parts: list[Child] = []
    for kind in ("formal", "empirical"):
        number = summary.number("scale", f"stddev_{kind}")
        if number:
            text = fixed(number, decimals_for(number, default=5))
            parts += [f"{', ' if parts else ''}{kind} ", keyed(f"scale.stddev_{kind}", number, text)]
    return parts


def scale_interval(summary: Summary) -> tuple[float, float] | None:
    """The scale's 95 % interval: the result's own, else that of a normal distribution of the larger stddev."""
    given = summary.get("scale", "interval_95")
    ends = [as_number(end) for end in given] if isinstance(given, list) else []
    if len(ends) == 2 and ends[0] is not None and ends[1] is not None:
        return ends[0], ends[1]
    value, stddev = summary.number("scale", "value"), larger_stddev(summary)
    if value is None or stddev is None:
        return None
    return value - NORMAL_QUANTILE_95 * stddev, value + NORMAL_QUANTILE_95 * stddev


def _tiles(content: Content) -> Markup:
    summary, path = content.summary, content.final
    num_points = None if content.points_m is None else len(content.points_m)

    def shown(key: str, write: Callable[[Any], str]) -> Child:
        value = summary.number(*key.split("."))
        return keyed(key, value, write(value))

    def metres(value: Any) -> str:
        return fixed(value, 3, "m")

    offset_decimals = min(decimals_for(summary.number("time_offset", "stddev_s"), default=3), 6)
    num_checks = summary.number("check_ranges", "num") or 0
    tiles: list[tuple[str, Child, Child]] = [
        (
            "Keyframes",
            count(None if path is None else len(path)),
            f"path of {fixed(_path_length_m(content), 2, 'm')}",
        ),
        ("Ranges used", shown("ranges.num_used", count), ["of ", shown("ranges.num", count), " in the log"]),
        ("Range RMS", shown("ranges.rms_m", metres), ["median ", shown("ranges.median_abs_m", metres)]),
        (
            "Check range RMS",
            shown("check_ranges.rms_m", metres),
            [keyed("check_ranges.num", num_checks, count(num_checks)), " held out"],
        ),
        (
            "Reprojection RMS",
            shown("refine.reprojection_rms_px", lambda value: fixed(value, 2, "px")),
            f"{count(num_points)} map points",
        ),
        (
            "Clock offset",
            shown("time_offset.value_s", lambda value: signed(value, offset_decimals, "s")),
            ["± ", shown("time_offset.stddev_s", lambda value: fixed(value, offset_decimals, "s"))],
        ),
        ("Time taken", duration(_total_seconds(summary)), "all stages"),
    ]
    return element(
        "dl",
        [
            element("div", element("dt", name), element("dd", value), element("dd", note, class_="small"))
            for name, value, note in tiles
        ],
        class_="tiles",
    )


def _path_length_m(content: Content) -> float | None:
    path = content.final
    return None if path is None else float(np.linalg.norm(np.diff(path.centers, axis=0), axis=1).sum())


def _total_seconds(summary: Summary) -> float | None:
    seconds = summary.table("seconds")
    known = [value for value in map(as_number, seconds.values()) if value is not None]
    return as_number(seconds.get("total")) or (sum(known) if known else None)
