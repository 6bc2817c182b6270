"""A range log knows between which nodes each range was measured."""

from __future__ import annotations

import numpy as np
import pytest

from rangesfm.measurements.ranges.range_log import RangeKind, RangeLog
from rangesfm.measurements.ranges.readers.reader import EndpointRoles, tell_roles


def log_of(*pairs: tuple[str, str]) -> RangeLog:
    """A log of ranges of 1, 2, ... m, one for each pair of tag and anchor, as a reader returns it."""
    tags, anchors = zip(*pairs)
    n = len(pairs)
    return RangeLog.from_arrays(
        list(anchors),
        np.arange(1.0, n + 1),
        timestamp_s=np.arange(n),
        tag_id=list(tags),
        range_stddev_m=np.full(n, 0.1),
    )


def ends_of(log: RangeLog) -> list[tuple[str, str]]:
    return list(zip(*log.end_ids()))


class TestWithAnchors:
    def test_kind_follows_from_who_is_an_anchor(self) -> None:
        log = log_of(("t", "A"), ("A", "t"), ("A", "B"), ("t", "u")).with_anchors({"A", "B"})
        assert log.kind.tolist() == [
            RangeKind.TAG_ANCHOR,
            RangeKind.TAG_ANCHOR,
            RangeKind.ANCHOR_ANCHOR,
            RangeKind.TAG_TAG,
        ]
        assert (log.anchor_ids, log.tag_ids) == (("A", "B"), ("t", "u"))
        assert ends_of(log) == [("t", "A"), ("t", "A"), ("A", "B"), ("t", "u")]
        assert log.anchor_index.tolist() == [0, 0, 1, -1]
        assert log.tag_index.tolist() == [0, 0, -1, 0]
        assert log.peer_index.tolist() == [-1, -1, 0, 1]

    def test_ids_are_in_the_order_that_people_count_in_whatever_the_logs(self) -> None:
        ids = ("A1", "A02", "A2", "A10", "A10b", "B", "a", "\u00e9")
        for order in (ids, ids[::-1]):
            log = log_of(*((name, "t") for name in order)).with_anchors(set(ids))
            assert log.anchor_ids == ids
            assert [log.anchor_ids[k] for k in log.anchor_index] == list(order)


class TestPeerRanges:
    def test_ranges_between_anchors_are_had_with_both_ends(self) -> None:
        log = log_of(("t", "A"), ("B", "A"), ("t", "B"), ("C", "B")).with_anchors({"A", "B", "C"})
        rows = np.flatnonzero(log.kind == RangeKind.ANCHOR_ANCHOR)
        assert rows.tolist() == [1, 3]
        ends = [*zip(*log.end_ids(), strict=True)]
        assert [set(ends[row]) for row in rows] == [{"A", "B"}, {"B", "C"}]
        by_index = zip(log.peer_index[rows], log.anchor_index[rows], strict=True)
        assert [(log.anchor_ids[one], log.anchor_ids[other]) for one, other in by_index] == [ends[row] for row in rows]

    def test_subset_forgets_nodes_without_ranges_and_keeps_kinds(self) -> None:
        log = log_of(("t", "A"), ("B", "C"), ("t", "u"), ("v", "A")).with_anchors({"A", "B", "C"})
        part = log.subset(np.array([1, 2]))
        assert part.kind.tolist() == [RangeKind.ANCHOR_ANCHOR, RangeKind.TAG_TAG]
        assert (set(part.anchor_ids), part.tag_ids) == ({"B", "C"}, ("t", "u"))
        assert part.range_m.tolist() == [2.0, 3.0]


class TestRoles:
    def test_known_anchors_tell_ranges_between_two_of_a_kind(self) -> None:
        log = log_of(("t", "A"), ("u", "A"), ("A", "B"), ("t", "u"), ("B", "t"))
        for roles in (EndpointRoles.TAG_AND_ANCHOR, EndpointRoles.ASKER_AND_ASKED):
            told = tell_roles(log, roles, known_anchor_ids={"A", "B"})
            assert told.kind.tolist() == [0, 0, RangeKind.ANCHOR_ANCHOR, RangeKind.TAG_TAG, 0]
            assert told.tag_ids == ("t", "u")

    def test_known_tags_do_as_well_where_sides_mean_nothing(self) -> None:
        log = log_of(("A", "t"), ("t", "B"), ("t", "u"), ("A", "B"))
        log = tell_roles(log, EndpointRoles.ASKER_AND_ASKED, known_tag_ids={"t", "u"})
        assert log.kind.tolist() == [0, 0, RangeKind.TAG_TAG, RangeKind.ANCHOR_ANCHOR]
        assert (log.tag_ids, log.anchor_ids) == (("t", "u"), ("A", "B"))

    def test_node_on_both_sides_is_what_it_is_mostly(self) -> None:
        log = tell_roles(log_of(("t", "A"), ("t", "A"), ("t", "B"), ("A", "B")), EndpointRoles.TAG_AND_ANCHOR)
        assert log.kind.tolist() == [0, 0, 0, RangeKind.ANCHOR_ANCHOR]
        log = tell_roles(log_of(("t", "A"), ("u", "A"), ("u", "B"), ("t", "u")), EndpointRoles.TAG_AND_ANCHOR)
        assert log.kind.tolist() == [0, 0, 0, RangeKind.TAG_TAG]

    def test_node_that_only_known_anchors_range_with_is_a_tag(self) -> None:
        log = tell_roles(log_of(("A", "t"), ("B", "t")), EndpointRoles.TAG_AND_ANCHOR, known_anchor_ids={"A", "B"})
        assert (log.tag_ids, log.anchor_ids) == (("t",), ("A", "B"))

    def test_stranger_on_the_side_of_the_anchors_stays_one(self) -> None:
        log = tell_roles(
            log_of(("t", "A"), ("t", "X"), ("A", "t")), EndpointRoles.TAG_AND_ANCHOR, known_anchor_ids={"A"}
        )
        assert log.anchor_ids == ("A", "X")

    def test_single_node_that_several_ask_is_the_tag_if_the_sides_say_nothing(self) -> None:
        log = log_of(("A", "t"), ("B", "t"))
        assert tell_roles(log, EndpointRoles.ASKER_AND_ASKED).tag_ids == ("t",)
        assert tell_roles(log, EndpointRoles.TAG_AND_ANCHOR).tag_ids == ("A", "B")

    @pytest.mark.parametrize("roles", EndpointRoles)
    def test_id_that_ranges_with_itself_shows_that_tags_are_numbered_by_themselves(self, roles: EndpointRoles) -> None:
        log = log_of(("0", "0"), ("0", "1"), ("1", "0"))
        assert tell_roles(log, roles, known_anchor_ids={"0", "1"}) is log
        part = log.subset(np.array([1, 2]))
        assert (part.tag_ids, part.anchor_ids) == (("0", "1"), ("0", "1"))
        assert (part.tag_index.tolist(), part.anchor_index.tolist()) == ([0, 1], [1, 0])
        assert part.kind.tolist() == [0, 0]

    def test_nodes_that_are_numbered_by_side_are_never_confused(self) -> None:
        log = log_of(("0", "1"), ("1", "2"))
        assert tell_roles(log, EndpointRoles.NUMBERED_APART, known_anchor_ids={"0", "1", "2"}) is log


def test_a_clock_that_begins_anew_is_told_from_rows_in_no_order() -> None:
    times = np.arange(200) % 100 * 0.5
    shuffled = np.random.default_rng(0).permutation(times)
    for timestamp_s, num_restarts in ((times, 1), (np.sort(times), 0), (shuffled, 0)):
        log = RangeLog.from_arrays(["A"] * 200, [1.0] * 200, timestamp_s=timestamp_s)
        assert log.num_restarts == num_restarts
