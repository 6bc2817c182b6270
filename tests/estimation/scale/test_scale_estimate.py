"""The uncertainty of a scale: its components together, and the interval that they give."""

from __future__ import annotations

import numpy as np
import pytest

from rangesfm.solver.posterior import ScaleUncertainty


def test_components_add_in_squares_and_never_say_less_than_the_formal_part() -> None:
    uncertainty = ScaleUncertainty(0.01, {"slope": 0.03, "place": 0.04})
    assert uncertainty.empirical == pytest.approx(0.05)
    assert uncertainty.interval_95 == pytest.approx((-0.098, 0.098))
    assert uncertainty.about(2.0).stddev == pytest.approx(0.1)
    assert ScaleUncertainty(0.06, uncertainty.components).half_width_95 == pytest.approx(1.96 * 0.06)


def test_one_more_cause_beside_the_others() -> None:
    uncertainty = ScaleUncertainty(0.01, {"slope": 0.03})
    assert uncertainty.beside("clocks", 0.04).components == {"slope": 0.03, "clocks": 0.04}
    assert uncertainty.beside("slope", 0.04).components == {"slope": pytest.approx(0.05)}
    np.testing.assert_equal(uncertainty.components, {"slope": 0.03})
