"""Which mistakes a planned survey would find, and what those just too small to be found would do."""

from __future__ import annotations

from dataclasses import replace

from rangesfm.planning.expected import Expected
from rangesfm.trust.catalogue import STANDING
from rangesfm.trust.linearized import linearized
from rangesfm.trust.ranges_on_map import ranges_on_map
from rangesfm.trust.table import MistakeTest
from rangesfm.trust.testing import Factorization
from rangesfm.trust.verdict import row_of


def detectable_mistakes(expected: Expected) -> tuple[MistakeTest, ...]:
    """Of every mistake that lasts for the whole survey; that it was made is not tested, as nothing was measured."""
    on_map = ranges_on_map(expected.posed, expected.solution, expected.observations, expected.planned.trajectory)
    problem = replace(linearized(on_map, expected.learned.cells), errors=expected.learned)
    hypotheses = [hypothesis for of_kind in STANDING for hypothesis in of_kind(problem)]
    return tuple(row_of(test) for test in Factorization(problem).test(hypotheses, seed=0))
