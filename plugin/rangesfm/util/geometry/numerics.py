"""Shares of rounding, levels of significance and the longest iteration: one definition for all estimators."""

from typing import Final

ROUNDING: Final = 1e-12
"""Share of numbers that some hundred operations in double precision may leave where the exact result is zero."""

UNDETERMINED: Final = 1e-7
"""Relative singular value below which nothing determines a direction: in normal equations its square is rounding."""

MAX_NUM_ROUNDS: Final = 60
"""Cap of iterations that end by themselves, so that one that never settles ends too."""

SIGNIFICANT_STDDEVS: Final = 3.0
"""Deviation, in standard deviations, that is hardly ever chance: once in 370 times where errors are normal."""

NEGLIGIBLE_STDDEVS: Final = 0.05
"""Change, in standard deviations of what changes, that nobody notices: it adds 0.1 % to them."""

NUM_REWEIGHTINGS: Final = 6
"""Rounds of a robust fit whose scale is estimated anew in each: after these it changes by less than it is known."""

NORMAL_95: Final = 1.96
"""Half the width of a 95 % interval, in standard deviations of a normal distribution."""

DOUBTFUL_ABOVE: Final = 0.04
"""Half of the relative 95 % interval above which a scale is doubtful."""

NOTHING_KNOWN: Final = 1.0
"""Relative standard deviation of the scale from which nothing is known about it: it may as well be zero."""
