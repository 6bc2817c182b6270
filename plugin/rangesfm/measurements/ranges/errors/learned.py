"""Noise of ranges: its components in bins of ranges, with their sizes in the population of radios, or as learnt."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType

import numpy as np

from rangesfm.arrays import Array
from rangesfm.measurements.ranges.errors.components import COMPONENTS, LEARNT_CURVE, OtherError
from rangesfm.measurements.ranges.errors.noise import START_STDDEV_M
from rangesfm.measurements.ranges.errors.range_bins import RangeBins
from rangesfm.solver.bending import BENDS
from rangesfm.solver.noise import Component, Noise, learnt_sizes, noise_of_sizes

# With more noise than usual all other components may be larger too, to this power: an old radio with five times the
# noise reads 7 % too long, while the others are right to a percent.
_WIDENING_POWER = 1.5


def radio_components(
    bins: RangeBins,
    curve_stddev_m: Array,
    ruled_out: Collection[str] = (),
    others_m2: Mapping[OtherError, Array] = MappingProxyType({}),
) -> tuple[Component, ...]:
    """Return the components of the errors of c bins of ranges, without those of the map.

    Args:
        curve_stddev_m: (n,) of a learnt error curve that was subtracted; NaN if none was.
        ruled_out: names of components that the user knows to be absent.
        others_m2: (c, c) covariances of further errors, by name, which are not learnt.
    """
    # With one tag, its own bias is the common bias.
    left_out = {*ruled_out, *(() if np.ptp(bins.tag_index) else ("tag_bias",))}
    of_anchor, is_calibrated = np.outer(bins.noisiness, bins.noisiness), bool(np.isfinite(curve_stddev_m).any())
    found = [
        Component(
            each.name,
            each.correlation(bins) * (of_anchor if each.is_of_anchor else 1.0),
            each.median_if(is_calibrated),
            each.spread,
        )
        for each in COMPONENTS
        if each.name not in left_out
    ]
    known = dict(others_m2)
    if is_calibrated:
        stddev = bins.mean(curve_stddev_m)
        smooth = next(each for each in COMPONENTS if each.name == "curve")
        known[LEARNT_CURVE] = np.outer(stddev, stddev) * smooth.correlation(bins)
    return (*found, *(Component(name, covariance) for name, covariance in known.items()))


def widening(noise_m: float) -> float:
    """Return how many times as large as those of a usual radio all lasting errors of one with this noise are."""
    return float(max(1.0, noise_m / START_STDDEV_M) ** _WIDENING_POWER)


def widened(components: Sequence[Component], noise_m: float) -> tuple[Component, ...]:
    """Return the components of the errors of ranges with this noise, of which a noisier radio than usual has more."""
    larger = widening(noise_m) ** 2
    return tuple(replace(each, alike=larger * each.alike) if is_widened(each) else each for each in components)


def is_widened(component: Component) -> bool:
    """Return whether a noisier radio has more of it: neither of bending, nor of the noise itself, which is measured."""
    return component.spread > 0 and component.name not in (*BENDS, "white")


def learn_errors(
    components: Sequence[Component],
    bins: RangeBins,
    off_m: Array,
    design: Array,
    prior_design: Array,
    noise_m: float,
) -> Noise:
    """Learn the sizes of the components of the errors of c bins, as ``learnt_sizes``.

    Args:
        components: of a radio with usual noise.
        off_m, design, prior_design: (c,), (c, p), (r, p), without any bias.
        noise_m: standard deviation of single ranges.
    """
    given = widened(components, noise_m)
    sizes = learnt_sizes(given, off_m, design, prior_design)
    return noise_of_sizes(given, sizes, len(bins))
