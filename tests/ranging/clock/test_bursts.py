"""A pairing of bursts of ranges with photos is used only if it passes certain tests."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from rangesfm.ranging.clock.bursts import BurstPairing

PAIRING = BurstPairing(1.5, np.arange(9), np.arange(9), variance=1e-3, num_spare=5.0, chance=1e-6)


def test_a_path_explains_medians_that_are_enough_and_that_nothing_else_explains() -> None:
    assert PAIRING.explains()


@pytest.mark.parametrize("pairing", [replace(PAIRING, num_spare=3.0), replace(PAIRING, chance=0.01)])
def test_few_medians_or_chance_explain_nothing(pairing: BurstPairing) -> None:
    assert not pairing.explains()
