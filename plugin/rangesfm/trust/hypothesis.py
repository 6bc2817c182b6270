"""Hypothesis: one mistake that may have been made, all that is to be said of it, and what would correct it."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from rangesfm.arrays import Array, Mask
from rangesfm.trust.linearized import Linearized

# In the unit of a hypothesis: for a slope between two of its sizes.
_SMALL = 1e-4


@dataclass(frozen=True)
class Correction:
    """How the input is to be changed if a mistake was made.

    Attributes:
        anchors_m: other positions by id; None: the anchor counts as unknown.
        tag_moves_m: by which lever arms are longer, by id.
        time_shift_s: that the ranges were taken later.
        left_out: (n,) ranges of the map that do not count.
        longer_m: (n,) by how much they read too long.
    """

    anchors_m: Mapping[str, Array | None] = field(default_factory=dict)
    tag_moves_m: Mapping[str, Array] = field(default_factory=dict)
    time_shift_s: float | Array = 0.0
    left_out: Mask | None = None
    longer_m: Array | None = None


@dataclass(frozen=True)
class Effect:
    """What k numbers change.

    Attributes:
        columns: (c, k) how the residuals of the cells differ for one unit of each.
        priors: (r, k) likewise, of what is known beforehand.
    """

    columns: Array
    priors: Array

    @classmethod
    def of_all(cls, parts: Sequence[Effect]) -> Effect:
        """Each with numbers of its own."""
        return cls(np.hstack([part.columns for part in parts]), np.hstack([part.priors for part in parts]))

    @classmethod
    def of_sum(cls, parts: Sequence[Effect]) -> Effect:
        """All by the same numbers."""
        return cls(np.sum([part.columns for part in parts], axis=0), np.sum([part.priors for part in parts], axis=0))


@dataclass(frozen=True)
class Hypothesis:
    """A mistake that k numbers describe.

    Attributes:
        name: the same for all of one kind. subject: which of them; an anchor's id, a time.
        effect: on the residuals.
        unit: of the numbers.
        words: of an estimate (k,): what is probably the case.
        remedy: what to measure or to change.
        correction: of an estimate, what undoes it.
        adoption: what takes its place where the mistake is adopted; None: the correction itself.
        most: beyond which an estimate is not believed, in its unit.
        unawares: beyond which nobody makes it without seeing it, in its unit: a larger one need not be feared.
        finer: the same at times between those that are looked at; None: it is of no time.
        narrower: of fewer numbers, which explain as much if the mistake was of their kind.
        is_linear: whether one step finds its size, however large it is.
        is_in_interval: whether the scale's interval counts how large it usually is, or it changes what a metre is.
    """

    name: str
    subject: str
    effect: Effect
    unit: str
    words: Callable[[Array], str]
    remedy: str
    correction: Callable[[Array], Correction]
    adoption: Callable[[Array], Correction] | None = None
    most: float = np.inf
    unawares: float = np.inf
    finer: Callable[[], Iterator[Hypothesis]] | None = None
    narrower: tuple[Hypothesis, ...] = ()
    is_linear: bool = False
    is_in_interval: bool = False

    def at_size(self, problem: Linearized, sizes: Array) -> Hypothesis:
        """With its effect about an estimate, by what would correct it: that of a large mistake is not linear."""
        longer_m = self.correction(sizes).longer_m
        if longer_m is None:
            return self
        steps = [self.correction(sizes + _SMALL * unit).longer_m for unit in np.eye(len(sizes))]
        slopes = [(step - longer_m) / _SMALL for step in steps if step is not None]
        return replace(self, effect=of_cells(problem, -problem.cells.mean(np.stack(slopes, axis=1))))

    @property
    def num(self) -> int:
        return int(self.effect.columns.shape[1])

    @property
    def key(self) -> tuple[str, str]:
        return self.name, self.subject


def of_cells(problem: Linearized, columns: Array) -> Effect:
    """What a mistake changes that has no part in what is known beforehand."""
    columns = columns.reshape(len(problem.residual_m), -1)
    return Effect(columns, np.zeros((problem.num_priors, columns.shape[1])))


def of_anchor_place(problem: Linearized, anchor: int, directions: Array) -> Effect | None:
    """That the anchor is off by numbers times directions (3, k), towards where it is; None if nobody said where."""
    given = problem.on_map.problem
    if not np.isfinite(given.anchor_mean_m[anchor]).all() or not np.isfinite(given.anchor_stddev_m[anchor]):
        return None
    if problem.columns.anchor[anchor] < 0:
        is_of = (problem.cells.anchor_index == anchor)[:, None]
        return of_cells(problem, np.where(is_of, problem.gradient.by_tag @ directions, 0.0))
    has_rows = (problem.columns.anchor >= 0) & np.isfinite(given.anchor_stddev_m)
    row = 3 * np.count_nonzero(has_rows[:anchor])
    priors = np.zeros((problem.num_priors, directions.shape[1]))
    priors[row : row + 3] = directions / given.anchor_stddev_m[anchor]
    return Effect(np.zeros((len(problem.residual_m), directions.shape[1])), priors)
