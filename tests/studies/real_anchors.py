"""Anchors found by trilateration on real logs with truth: how far off, and do the stated stddevs cover?

Run: python -m tests.studies.real_anchors --data FOLDER [--sets NAME ...]

The sets are those of real_logs.json. Every anchor is placed by its ranges to the true path, told on which side of the
path it lies; where the path lies in a plane that is nearly level, or ``--heights`` says so, once more with its height
known. A pull is the error of a coordinate over its stated stddev: 95 % of them should lie within +-1.96.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from tests.studies.real_logs import MAX_GAP_S, read_set

from rangesfm.geometry.reference import Reference
from rangesfm.ranging.anchors.anchor_survey import AnchorPlacement, trilaterate_anchors
from rangesfm.ranging.anchors.trilateration import TrilaterationOptions
from rangesfm.ranging.log import RangeLog
from rangesfm.ranging.tag_positions import tag_positions

Array = npt.NDArray[np.float64]

WITHIN = 1.96


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--sets", nargs="*")
    args = parser.parse_args()
    sets = json.loads(Path(__file__).with_name("real_logs.json").read_text(encoding="utf-8"))
    pulls: list[float] = []
    for name in args.sets or sets:
        pulls += one_log(args.data, name, sets[name])
    inside = np.abs(pulls) < WITHIN
    print(
        f"{np.sum(inside)} of {len(pulls)} coordinates within {WITHIN} stddevs ({100 * np.mean(inside):.0f} %), "
        f"pulls {np.sqrt(np.mean(np.square(pulls))):.2f} (rms)"
    )


def one_log(data: Path, name: str, described: dict[str, Any]) -> list[float]:
    """Pulls of all anchors of a log, its table printed."""
    log, anchors, path = read_set(data, described)
    truth = {anchor.anchor_id: np.asarray(anchor.position_m) for anchor in anchors}
    log = log.subset(np.isin(np.array(log.anchor_ids)[log.anchor_index], list(truth)))
    tags_m = positions_of_tags(log, path, described)
    middle = np.nanmean(tags_m, axis=0)
    began = time.process_time()
    placements = trilaterate_anchors(
        log,
        tags_m,
        toward={anchor_id: place - middle for anchor_id, place in truth.items()},
        options=TrilaterationOptions(max_position_stddev_m=20.0),
    )
    took_s = time.process_time() - began
    pulls = [pull for placement in placements for pull in one_anchor(name, placement, truth[placement.anchor_id])]
    print(f"{name:16}{took_s:6.1f} s", flush=True)
    return pulls


def positions_of_tags(log: RangeLog, path: Reference, described: dict[str, Any]) -> Array:
    """(n, 3) at each range, each tag by its own lever arm."""
    offset_s = described.get("time_offset_s", 0.0)
    max_gap_s = max(described.get("max_gap_s", 0.0), MAX_GAP_S)
    arms = described.get("tags_in_body_m", dict.fromkeys(log.tag_ids, described.get("tag_in_body_m", (0.0, 0.0, 0.0))))
    tags_m = np.full((len(log), 3), np.nan)
    for number, tag_id in enumerate(log.tag_ids):
        rows = np.flatnonzero(log.tag_index == number)
        tags_m[rows] = tag_positions(
            log.subset(rows), path, arms[tag_id], time_offset_s=offset_s, max_gap_s=max_gap_s
        )
    return tags_m


def one_anchor(name: str, placement: AnchorPlacement, truth: Array) -> list[float]:
    found = placement.found
    if found is None:
        print(f"{name:16}{placement.anchor_id:6}{placement.num_ranges:6} {placement.why_not}")
        return []
    off, stddevs = found.position_m - truth, np.sqrt(np.diag(found.covariance_m2))
    pulls = off / stddevs
    print(
        f"{name:16}{placement.anchor_id:6}{placement.num_ranges:6}  off {np.linalg.norm(off):6.3f} m  "
        f"{' '.join(f'{value:+7.3f} +-{stddev:6.3f}' for value, stddev in zip(off, stddevs, strict=True))}  "
        f"pulls {' '.join(f'{pull:+6.2f}' for pull in pulls)}  bias {found.range_bias_m:+.3f}",
        flush=True,
    )
    return pulls.tolist()


if __name__ == "__main__":
    main()
