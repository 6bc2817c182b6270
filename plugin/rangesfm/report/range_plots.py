"""Ranges over time, and a radio's error curve, as figures of their own."""

from __future__ import annotations

import colorsys

import numpy as np

from rangesfm.ranging.errors.calibration import Calibration
from rangesfm.ranging.log import RangeLog
from rangesfm.report.plot import Figure, Series, figure_of

SIZE = (660.0, 330.0)


def plot_ranges(log: RangeLog) -> Figure:
    """Every range of a log, one colour an anchor; over their number where the log has photos for times."""
    times = log.timestamp_s
    x = np.arange(len(log)) if times is None else times - times.min()
    series = [
        Series(anchor_id, _color(i, len(log.anchor_ids)), np.column_stack([x, log.range_m])[log.anchor_index == i])
        for i, anchor_id in enumerate(log.anchor_ids)
    ]
    label = "range" if times is None else f"s since {times.min():.3f}"
    y_range = (0.0, 1.05 * float(log.range_m.max()))
    return figure_of("ranges", "", "Ranges over time", (label, "m"), series, y_range=y_range, size=SIZE)


def plot_error_curve(calibration: Calibration) -> Figure:
    """A radio's error curve with two stddevs on either side, over the errors that it was learnt from."""
    curve = calibration.curve
    shown = 5 * calibration.noise_stddev_m

    def line(name: str, kind: str, num_stddevs: int) -> Series:
        error_m = curve.error_m + num_stddevs * curve.stddev_m
        return Series(name, "after", np.column_stack([curve.distance_m, error_m]), kind)

    return figure_of(
        "error_curve",
        "",
        "Errors of ranges over their distance",
        ("distance, m", "measured minus true, m"),
        (
            Series("errors", "rejected", np.column_stack([calibration.distance_m, calibration.error_m])),
            line("curve", "line", 0),
            line("± two standard deviations", "dashed", 2),
            line("± two standard deviations", "dashed", -2),
        ),
        y_range=(float(curve.error_m.min()) - shown, float(curve.error_m.max()) + shown),
        size=SIZE,
    )


def _color(index: int, num: int) -> str:
    """Evenly over the circle of hues."""
    red, green, blue = (round(255 * part) for part in colorsys.hsv_to_rgb(index / num, 0.8, 0.75))
    return f"#{red:02x}{green:02x}{blue:02x}"
