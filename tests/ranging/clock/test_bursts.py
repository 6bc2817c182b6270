"""Bursts of ranges are found, paired with photos, and used only if the pairing passes certain tests."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from rangesfm.ranging.clock.bursts import (
    BurstPairing,
)

PAIRING = BurstPairing(1.5, np.arange(9), np.arange(9), variance=1e-3, num_spare=5.0, chance=1e-6)


def test_a_path_explains_medians_that_are_enough_and_that_nothing_else_explains() -> None:
    assert PAIRING.explains()
    assert replace(PAIRING, num_spare=4.0).explains()
    assert replace(PAIRING, chance=1.34e-3).explains()


@pytest.mark.parametrize("pairing", [replace(PAIRING, num_spare=3.99), replace(PAIRING, chance=1.36e-3)])
def test_few_medians_or_chance_explain_nothing(pairing: BurstPairing) -> None:
    assert not pairing.explains()
