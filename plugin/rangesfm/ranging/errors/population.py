"""The population of radios: how large each component of the ranges' errors is in public logs with the true path."""

from __future__ import annotations

import numpy as np

# Metres (slope: share of the distance), as learnt against the true distances from one start for all, by
# ``python -m tests.studies.shown_errors``. The logs are those of ``examples/radios.md``.
_SHOWN = """
log         room_env1 room_calibration starloc_s5 rcv_sequence1 rcv_sequence3 lias_mid plaza1 starloc_fast_s1
radio       room      room             starloc    rcv           rcv           lias     plaza  starloc_fast
white       0.057     0.030            0.043      0.025         0.037         0.084    0.353  0.089
time        0.011     0.026            0.010      0.006         0.004         0.007    0.003  0.007
drift       0.015     0.008            0.006      0.007         0.005         0.005    0.002  0.017
place       0.015     0.025            0.011      0.050         0.046         0.017    0.003  0.009
view        0.038     0.043            0.024      0.053         0.023         0.009    0.002  0.042
bias        0.034     0.024            0.029      0.040         0.027         0.047    0.012  0.034
common_bias 0.143     0.139            0.154      0.207         0.203         0.169    0.125  0.193
short       0.260     0.243            0.171      0.154         0.174         0.207    0.200  0.174
curve       0.034     0.040            0.045      0.040         0.035         0.032    0.018  0.038
rough_curve 0.009     0.011            0.007      0.012         0.013         0.009    0.004  0.014
slope       0.0044    0.0040           0.0044     0.0040        0.0040        0.0036   0.0032 0.0047
antenna     0.035     0.048            0.024      0.025         0.023         0.025    0.005  0.029
off_axis    0.080     0.053            0.040      0.040         0.042         0.040    0.020  0.039
tag_antenna 0.033     0.029            0.021      0.024         0.019         0.045    0.008  0.025
bending     0.004     0.008            0.005      0.004         0.004         0.004    0.010  0.009
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
