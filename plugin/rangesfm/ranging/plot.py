"""Ranges over time, and a radio's error curve, as figures, through the optional package matplotlib."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from rangesfm.errors import InputError
from rangesfm.files.atomic import new_file
from rangesfm.ranging.errors.calibration import Calibration
from rangesfm.ranging.log import RangeLog

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def plot_ranges(log: RangeLog) -> Figure:
    """Draw every range of a log, one colour an anchor; over their number where the log has photos for times.

    Raises:
        InputError: matplotlib is not installed.
    """
    figure = _new_figure()
    from matplotlib import colormaps, rc_context

    axes = figure.add_subplot()
    time = np.arange(len(log)) if log.timestamp_s is None else log.timestamp_s - log.timestamp_s.min()
    colors = colormaps["tab20"].colors  # type: ignore[attr-defined]
    for index, anchor_id in enumerate(log.anchor_ids):
        mine = log.anchor_index == index
        axes.plot(time[mine], log.range_m[mine], ".", markersize=3, color=colors[index % 20], label=anchor_id)
    axes.set_xlabel("range" if log.timestamp_s is None else f"s since {log.timestamp_s.min():.3f}")
    axes.set_ylabel("m")
    axes.set_ylim(bottom=0)
    axes.grid(alpha=0.3)
    with rc_context({"text.parse_math": False}):  # names may hold dollars
        figure.legend(loc="outside right upper", title="anchor", markerscale=4)
    return figure


def plot_error_curve(calibration: Calibration) -> Figure:
    """Draw a radio's error curve with two stddevs on either side, over the errors that it was learnt from.

    Raises:
        InputError: matplotlib is not installed.
    """
    figure = _new_figure()
    axes = figure.add_subplot()
    curve = calibration.curve
    axes.plot(calibration.distance_m, calibration.error_m, ".", markersize=2, alpha=0.3, color="0.6")
    band = 2 * curve.stddev_m
    axes.fill_between(curve.distance_m, curve.error_m - band, curve.error_m + band, alpha=0.3)
    axes.plot(curve.distance_m, curve.error_m, "o-", markersize=3)
    shown = 5 * calibration.noise_stddev_m
    axes.set_ylim(float(np.min(curve.error_m)) - shown, float(np.max(curve.error_m)) + shown)
    axes.set_xlabel("distance, m")
    axes.set_ylabel("measured minus true, m")
    axes.grid(alpha=0.3)
    return figure


def _new_figure() -> Figure:
    try:
        from matplotlib.figure import Figure
    except ImportError:
        raise InputError("a plot needs the package matplotlib: python -m pip install 'rangesfm[plot]'") from None
    return Figure(figsize=(12, 6), layout="constrained")


def write_figure(figure: Figure, path: str | Path) -> None:
    """Write a figure in the format that the file's name says.

    Raises:
        InputError: the file cannot be written, or matplotlib does not know its format.
    """
    path = Path(path)
    format = path.suffix[1:].lower()
    known = figure.canvas.get_supported_filetypes()
    if format not in known:
        raise InputError(f"no figure format is named '{format}', expected one of {', '.join(sorted(known))}", path)
    try:
        with new_file(path) as temporary:
            figure.savefig(temporary, format=format, dpi=120)
    except OSError as error:
        raise InputError(f"cannot be written ({error.strerror})", path) from error
