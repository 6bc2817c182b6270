"""Ranges from the time stamps of two-way ranging.

An initiator A and a responder B each record when they send (tx) and receive (rx) a message, by their own clocks, which
run at slightly different rates and wrap around.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rangesfm.arrays import Array
from rangesfm.errors import InputError
from rangesfm.options import RangesOptions

VACUUM_M_PER_S = 299_792_458.0
AIR_M_PER_S = 299_702_547.0  # refractive index 1.0003, as radio firmware assumes
DW1000_TICK_S = 1 / (499.2e6 * 128)
SECONDS_PER_STAMP = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "ticks": DW1000_TICK_S}
_MAX_RATE_DIFFERENCE = 1e-3  # relative difference of two clocks' rates; fifty times that of a crystal of 20 ppm


@dataclass(frozen=True)
class StampOptions:
    """Conversion of time stamps to ranges.

    Attributes:
        unit_s: seconds in one unit of the stamps.
        wrap_s: time after which the counter starts anew. A fraction 1/k of it, with k an integer, works as well if all
            intervals are shorter: the 32-bit default also serves the 40 bits of a DW1000, for intervals up to 67 ms.
        propagation_speed_m_per_s: speed of the signal.
        t_off_s: time that the delays of both devices together add to a round trip.
    """

    unit_s: float = 1e-9
    wrap_s: float = 2**32 * DW1000_TICK_S
    propagation_speed_m_per_s: float = AIR_M_PER_S
    t_off_s: float = 0.0

    @classmethod
    def from_log_options(cls, options: RangesOptions) -> StampOptions:
        speeds: dict[str | float, float] = {"air": AIR_M_PER_S, "vacuum": VACUUM_M_PER_S}
        speed = options.propagation_speed
        return cls(
            unit_s=SECONDS_PER_STAMP[options.stamp_unit],
            wrap_s=2**options.stamp_bits * DW1000_TICK_S,
            propagation_speed_m_per_s=speeds[speed] if speed in speeds else float(speed),
            t_off_s=options.t_off_s,
        )

    def interval_s(self, later: npt.ArrayLike, earlier: npt.ArrayLike) -> Array:
        """Return the seconds from ``earlier`` to ``later`` on one clock, in [0, wrap_s)."""
        wrap = self.wrap_s / self.unit_s
        interval = np.mod(np.asarray(later, np.float64) - np.asarray(earlier, np.float64), wrap)
        return np.asarray(interval * self.unit_s, np.float64)


def single_sided_range(
    tx1: npt.ArrayLike,
    rx1: npt.ArrayLike,
    tx2: npt.ArrayLike,
    rx2: npt.ArrayLike,
    options: StampOptions,
    *,
    rate_of_a: npt.ArrayLike = 1.0,
) -> Array:
    """Compute ranges (n,) in metres from A's poll (tx1, rx1) and B's answer (tx2, rx2).

    Args:
        rate_of_a: rate of A's clock relative to B's. Its error, times B's delay, enters the range.
    """
    round_trip_s = options.interval_s(rx2, tx1) - np.asarray(rate_of_a) * options.interval_s(tx2, rx1)
    return _range(round_trip_s, options)


def double_sided_range(
    tx1: npt.ArrayLike,
    rx1: npt.ArrayLike,
    tx2: npt.ArrayLike,
    rx2: npt.ArrayLike,
    tx3: npt.ArrayLike,
    rx3: npt.ArrayLike,
    options: StampOptions,
) -> Array:
    """Compute ranges (n,) in metres from A's poll, B's answer and a third message, free of the clocks' different rates.

    Either A or B may send the third message, and the stamps show which. If B sent it, it gives the rate of A's clock
    relative to B's: (rx3 - rx2) / (tx3 - tx2). If A sent it, it closes a second round trip:
    time of flight = (Ra Rb - Da Db) / (Ra + Rb + Da + Db) (Neirynck, Luk and McLaughlin 2016).

    Raises:
        InputError: the stamps fit neither case, because they have another unit or wrap.
    """
    from_b_by_a, from_b_by_b = options.interval_s(rx3, rx2), options.interval_s(tx3, tx2)
    delay_a, round_b = options.interval_s(tx3, rx2), options.interval_s(rx3, tx2)
    if _same_duration(from_b_by_a, from_b_by_b):
        rate_of_a = from_b_by_a / np.where(from_b_by_b > 0, from_b_by_b, np.nan)
        return single_sided_range(tx1, rx1, tx2, rx2, options, rate_of_a=rate_of_a)
    if _same_duration(delay_a, round_b):
        round_a, delay_b = options.interval_s(rx2, tx1), options.interval_s(tx2, rx1)
        total = round_a + round_b + delay_a + delay_b
        round_trip_s = 2 * (round_a * round_b - delay_a * delay_b) / np.where(total > 0, total, np.nan)
        return _range(round_trip_s, options)
    raise InputError(
        "the time stamps tx3, rx3 fit no third message: their unit is not "
        f"{options.unit_s:g} s, or the counter does not wrap at {options.wrap_s:g} s"
    )


def _same_duration(one_s: Array, other_s: Array) -> bool:
    """Return whether most intervals are the same on both clocks, up to the difference of their rates."""
    both = np.isfinite(one_s) & np.isfinite(other_s) & (other_s > 0)
    if not np.any(both):
        return False
    return bool(np.median(np.abs(one_s[both] / other_s[both] - 1)) < _MAX_RATE_DIFFERENCE)


def _range(round_trip_s: Array, options: StampOptions) -> Array:
    """Return the distance d = c/2 (round-trip time - t_off), Lee et al. 2018, in metres.

    A round trip is far shorter than the wrap. A time of almost a whole wrap is therefore a slightly negative time.
    """
    signed_s = np.mod(round_trip_s + options.wrap_s / 2, options.wrap_s) - options.wrap_s / 2
    return np.asarray(options.propagation_speed_m_per_s / 2 * (signed_s - options.t_off_s), np.float64)
