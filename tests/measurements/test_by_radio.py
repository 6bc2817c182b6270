"""Ranges between anchors as distances: one per pair, with the uncertainty of the radios' common error."""

from __future__ import annotations

import numpy as np
import pytest

from rangesfm.measurements.ranges.radio import lengths_by_radio
from rangesfm.measurements.ranges.range_log import RangeLog


def log_of(rows: list[tuple[str, str, float]], stddev_m: float | None = None) -> RangeLog:
    """A log of ranges between tag T and anchors, or between two anchors."""
    log = RangeLog.from_arrays(
        [anchor for _, anchor, _ in rows],
        [range_m for *_, range_m in rows],
        timestamp_s=np.arange(len(rows)),
        tag_id=[tag for tag, *_ in rows],
        range_stddev_m=None if stddev_m is None else np.full(len(rows), stddev_m),
    )
    return log.with_anchors({"A", "B", "C"})


ROWS = [("T", "A", 3.0), ("T", "B", 4.0), ("A", "B", 10.0), ("B", "A", 10.2), ("A", "B", 15.0), ("C", "A", 20.0)]


def test_each_pair_has_the_median_of_its_ranges_in_either_direction() -> None:
    log = log_of(ROWS)
    found = lengths_by_radio(log, 0.1, np.zeros(3), np.zeros(3), 0.0)
    pairs = [{log.anchor_ids[k] for k in pair} for pair in found.anchor_pair]
    assert pairs == [{"A", "B"}, {"A", "C"}]
    assert found.distance_m.tolist() == [10.2, 20.0]


def test_a_pair_is_no_better_known_than_its_bias() -> None:
    log = log_of([("T", "A", 3.0), *[("A", "B", 10.0)] * 10_000])
    alone = lengths_by_radio(log, 0.1, np.zeros(2), np.zeros(2), 0.0)
    assert alone.stddev_m == pytest.approx([0.00125], rel=0.1)
    found = lengths_by_radio(log, 0.1, np.array([0.3, 0.1]), np.array([0.03, 0.04]), 0.12)
    assert found.stddev_m == pytest.approx([0.13], rel=1e-3)
    assert found.distance_m == pytest.approx([9.8])


def test_stddevs_are_the_logs_where_it_has_them() -> None:
    found = lengths_by_radio(log_of(ROWS[-1:], stddev_m=0.5), 0.1, np.zeros(2), np.zeros(2), 0.0)
    assert found.stddev_m == pytest.approx([1.2533 * 0.5])


def test_a_log_without_such_ranges_has_none() -> None:
    assert len(lengths_by_radio(log_of(ROWS[:2]), 0.1, np.zeros(2), np.zeros(2), 0.0).distance_m) == 0
