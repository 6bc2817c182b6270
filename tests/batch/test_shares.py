"""What each survey may use of a machine."""

from __future__ import annotations

import pytest

from rangesfm.batch.jobs import BatchOptions, Share, share_this_machine
from rangesfm.errors import InputError

GB = 10**9


@pytest.mark.parametrize(
    ("options", "num_surveys", "num_cores", "memory_gb", "expected"),
    [
        (BatchOptions(), 16, 8, 64, (8, 1, 8)),
        (BatchOptions(), 3, 8, 64, (3, 2, 21)),  # never more workers than surveys: the cores are theirs
        (BatchOptions(), 16, 8, 8, (4, 2, 2)),  # memory for four
        (BatchOptions(), 16, 8, 1, (1, 8, 1)),
        (BatchOptions(num_workers=2), 16, 8, 64, (2, 4, 32)),
        (BatchOptions(num_threads=4), 16, 8, 64, (2, 4, 32)),
        (BatchOptions(memory_limit_bytes=30 * GB), 16, 8, 64, (2, 4, 30)),
        (BatchOptions(num_workers=2, num_threads=3, memory_limit_bytes=5 * GB), 16, 8, 64, (2, 3, 5)),
    ],
)
def test_workers_times_threads_is_at_most_the_cores(
    options: BatchOptions, num_surveys: int, num_cores: int, memory_gb: int, expected: tuple[int, int, int]
) -> None:
    num_workers, share, note = share_this_machine(options, num_surveys, num_cores, memory_gb * GB)
    assert share.num_threads is not None
    assert share.memory_limit_bytes is not None
    assert (num_workers, share.num_threads, share.memory_limit_bytes // GB) == expected
    assert num_workers * share.num_threads <= num_cores
    assert note is None


def test_more_threads_than_cores_are_refused() -> None:
    options = BatchOptions(num_workers=3, num_threads=2)
    with pytest.raises(InputError, match="3 workers with 2 threads each, and this machine has 4 cores: expected no"):
        share_this_machine(options, 16, 4, 64 * GB)


def test_more_workers_than_cores_are_told_of() -> None:
    num_workers, share, note = share_this_machine(BatchOptions(num_workers=2), 16, 1, 64 * GB)
    assert (num_workers, share.num_threads) == (2, 1)
    assert note == "2 workers with 1 threads each, and this machine has 1 cores: each survey takes longer"


def test_workers_of_a_cluster_share_their_machines() -> None:
    share = Share(num_at_once={"big": 4})
    assert share.on("big", 1, 32, 64 * GB) == (8, 16 * GB)
    assert share.on("new", 2, 32, 64 * GB) == (16, 32 * GB)
    assert share.on("small", 1, 4, 8 * GB) == (4, 8 * GB)
    assert share.on("full", 8, 4, 8 * GB) == (1, GB)
    assert Share(3, 2 * GB).on("big", 1, 32, 64 * GB) == (3, 2 * GB)
