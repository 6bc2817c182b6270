"""The population of radios: how large each component of the ranges' errors is in public logs with the true path."""

from __future__ import annotations

import numpy as np

# Metres (slope: share of the distance), as learnt against the true distances from one start for all, by
# ``python -m tests.studies.shown_errors``. The logs are those of ``examples/radios.md``.
_SHOWN = """
log         room_env1 room_calibration starloc_s5 rcv_sequence1 rcv_sequence3 lias_mid plaza1 starloc_fast_s1
radio       room      room             starloc    rcv           rcv           lias     plaza  starloc_fast
white       0.026     0.029            0.043      0.026         0.038         0.080    0.360  0.089
time        0.020     0.026            0.011      0.006         0.005         0.007    0.003  0.007
drift       0.015     0.008            0.006       0.007         0.005         0.005    0.002  0.016
place       0.009     0.027            0.010      0.050         0.047         0.017    0.002  0.010
view        0.039     0.044            0.024      0.053         0.022         0.009    0.002  0.042
bias        0.031     0.025            0.029      0.040         0.027         0.046    0.012  0.033
common_bias 0.146     0.132            0.156      0.214         0.204         0.177    0.123  0.194
short       0.246     0.264            0.174      0.155         0.175         0.201    0.200  0.170
curve       0.035     0.037            0.052      0.041         0.035         0.033    0.018  0.041
rough_curve 0.011     0.011            0.007      0.012         0.013         0.009    0.003  0.014
slope       0.0042    0.0040           0.0045     0.0040        0.0040        0.0036   0.0032 0.0054
antenna     0.063     0.050            0.024      0.024         0.023         0.029    0.005  0.028
tag_antenna 0.032     0.028            0.021      0.023         0.018         0.046    0.008  0.048
bending     0.009     0.007            0.005      0.004         0.003         0.003    0.010  0.008
"""
LOGS = tuple(_SHOWN.split()[1:9])
# Of the logarithms: eight logs do not show how alike other radios are.
_LEAST_SPREAD = 0.5


def stddevs_in(log: str) -> dict[str, float]:
    """Of each component, as one of LOGS shows it."""
    _, _, *components = (line.split() for line in _SHOWN.strip().splitlines())
    return {name: float(sizes[LOGS.index(log)]) for name, *sizes in components}


def population(without: str | None = None) -> dict[str, tuple[float, float]]:
    """Median of each component's stddev, and stddev of its logarithm, over the logs.

    Args:
        without: a log; all of its radio are left out.
    """
    logs, radios, *components = (line.split() for line in _SHOWN.strip().splitlines())
    left_out = None if without is None else radios[logs.index(without)]
    kept = [i for i, radio in enumerate(radios) if i > 0 and radio != left_out]
    of_components = {}
    for name, *sizes in components:
        shown = np.log([float(sizes[i - 1]) for i in kept])
        of_components[name] = float(np.exp(shown.mean())), max(float(shown.std(ddof=1)), _LEAST_SPREAD)
    return of_components
