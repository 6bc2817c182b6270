"""Anchors that cannot stand as far apart as their file says are reported before anything is mapped."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from rangesfm.diagnostics.preflight import notes_on_distances
from rangesfm.errors import InputError
from rangesfm.measurements.ranges.anchors.anchor import Anchor
from rangesfm.measurements.ranges.range_log import RangeLog

SITE_M: dict[str, tuple[float, ...]] = {
    "A": (0.0, 0.0, 0.5),
    "B": (9.0, 1.0, 2.0),
    "C": (8.0, 14.0, 0.8),
    "D": (-3.0, 11.0, 2.4),
    "E": (20.0, 4.0, 1.0),
}


def log_of_walk(
    *, blocked_share: float = 0.0, range_factor: float = 1.0, by_photo: bool = False, seed: int = 0
) -> RangeLog:
    """300 rounds of ranges from a walk among the anchors, with 8 cm of noise and 20 ms between two ranges."""
    rng, num = np.random.default_rng(seed), 300
    turns = np.linspace(0, 4 * np.pi, num)
    tag_m = np.column_stack([8 + 9 * np.cos(turns), 6 + 7 * np.sin(1.5 * turns), 1.5 + 0.2 * np.sin(turns)])
    ranges_m = np.linalg.norm(tag_m[:, None] - np.array(list(SITE_M.values())), axis=2)
    ranges_m = np.abs(ranges_m + 0.08 * rng.standard_normal(ranges_m.shape)) + 0.01
    ranges_m += np.where(rng.random(ranges_m.shape) < blocked_share, rng.exponential(3.0, ranges_m.shape), 0.0)
    ids = list(SITE_M) * num
    if by_photo:
        names = [f"{i:04d}.jpg" for i in range(num) for _ in SITE_M]
        return RangeLog.from_arrays(ids, range_factor * ranges_m.ravel(), image_name=names)
    times_s = (0.3 * np.arange(num)[:, None] + 0.02 * np.arange(len(SITE_M))).ravel()
    return RangeLog.from_arrays(ids, range_factor * ranges_m.ravel(), timestamp_s=times_s)


def anchors_at(positions_m: dict[str, tuple[float, ...]]) -> list[Anchor]:
    return [Anchor(anchor_id, np.array(position_m)) for anchor_id, position_m in positions_m.items()]


def note(log: RangeLog, positions_m: dict[str, tuple[float, ...]]) -> str:
    (found,) = notes_on_distances(log, anchors_at(positions_m))
    return found


def scaled(factor: float) -> dict[str, tuple[float, ...]]:
    return {anchor_id: tuple(factor * x for x in place) for anchor_id, place in SITE_M.items()}


@pytest.mark.parametrize("by_photo", [False, True])
@pytest.mark.parametrize("blocked_share", [0.0, 0.15])
@pytest.mark.parametrize("seed", range(3))
def test_of_anchors_where_the_file_has_them_nothing_is_said(by_photo: bool, blocked_share: float, seed: int) -> None:
    log = log_of_walk(blocked_share=blocked_share, by_photo=by_photo, seed=seed)
    assert not list(notes_on_distances(log, anchors_at(SITE_M)))


def test_ranges_of_a_radio_that_reads_seven_percent_and_a_quarter_metre_long_are_no_matter() -> None:
    log = log_of_walk(range_factor=1.07)
    assert not list(notes_on_distances(log, anchors_at(SITE_M)))


@pytest.mark.parametrize("by_photo", [False, True])
@pytest.mark.parametrize(("factor", "unit"), [(1e3, "millimetres"), (1e2, "centimetres"), (1 / 0.3048, "feet")])
def test_anchors_in_another_unit_are_named_with_it(factor: float, unit: str, by_photo: bool) -> None:
    assert f"probably anchors are in {unit}" in note(log_of_walk(by_photo=by_photo), scaled(factor))


def test_a_unit_that_nobody_has_said_ends_the_run_where_it_alone_explains_all() -> None:
    in_open_unit = Path("anchors.csv")
    with pytest.raises(InputError, match=r"anchors\.csv: in 10 of 10 pairs .* would not if anchors are in millimetres"):
        list(notes_on_distances(log_of_walk(), anchors_at(scaled(1e3)), in_open_unit))
    assert list(notes_on_distances(log_of_walk(), anchors_at({**SITE_M, "C": (8.0, 44.0, 0.8)}), in_open_unit))


def test_ranges_in_feet_are_named() -> None:
    assert "ranges are in feet" in note(log_of_walk(range_factor=1 / 0.3048), SITE_M)


def test_an_anchor_that_stands_elsewhere_is_named() -> None:
    found = note(log_of_walk(), {**SITE_M, "C": (8.0, 44.0, 0.8)})
    assert "anchor C stands elsewhere;" in found


@pytest.mark.parametrize(("times", "unit"), [(100, "centimetres"), (1000, "millimetres")])
def test_one_anchor_in_another_unit_is_named_with_it(times: int, unit: str) -> None:
    x, y, z = SITE_M["C"]
    found = note(log_of_walk(), {**SITE_M, "C": (times * x, times * y, times * z)})
    assert f"anchor C stands elsewhere, or its coordinates are in {unit} and the others' in metres" in found
    assert "anchor C stands elsewhere;" in note(log_of_walk(), {**SITE_M, "C": (times * x, y, z)})


def test_swapped_labels_are_named() -> None:
    found = note(log_of_walk(), {**SITE_M, "D": SITE_M["E"], "E": SITE_M["D"]})
    assert "the labels D and E are swapped" in found


def test_ranges_between_anchors_tell_another_order_of_them() -> None:
    """Ranges to a tag in their midst would not show this."""
    tag = log_of_walk().subset(np.arange(20))
    pairs = [(a, b) for a in SITE_M for b in SITE_M if a < b]
    lengths_m = [float(np.linalg.norm(np.subtract(SITE_M[a], SITE_M[b]))) for a, b in pairs]
    log = RangeLog.from_arrays(
        [*(tag.anchor_ids[k] for k in tag.anchor_index), *(b for _, b in pairs)],
        [*tag.range_m, *lengths_m],
        timestamp_s=np.arange(20 + len(pairs), dtype=np.float64),
        tag_id=[*(["tag"] * 20), *(a for a, _ in pairs)],
    ).with_anchors(SITE_M)
    assert not list(notes_on_distances(log, anchors_at(SITE_M)))
    assert "the labels A and B are swapped" in note(log, {**SITE_M, "A": SITE_M["B"], "B": SITE_M["A"]})


def test_unknown_anchors_and_those_without_ranges_have_no_part() -> None:
    far = [Anchor("E"), Anchor("silent", np.array([1e4, 0, 0]))]
    known = [anchor for anchor in anchors_at(SITE_M) if anchor.anchor_id != "E"]
    assert not list(notes_on_distances(log_of_walk(), [*known, *far]))
