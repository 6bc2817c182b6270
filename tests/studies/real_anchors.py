"""Locate anchors by trilateration on real logs with truth, and compare their errors with the stated stddevs."""

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
from rangesfm.ranging.anchors.trilateration import AnchorPlacement, TrilaterationOptions, trilaterate_anchors
from rangesfm.ranging.association import tag_positions
from rangesfm.ranging.range_log import RangeLog

Array = npt.NDArray[np.float64]

WITHIN = 1.96


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--sets", nargs="*")
    args = parser.parse_args()
    sets = json.loads(Path(__file__).with_name("real_logs.json").read_text(encoding="utf-8"))
    for know_height in (False, True):
        print("heights known" if know_height else "heights sought")
        tables = [one_log(args.data, name, sets[name], know_height=know_height) for name in args.sets or sets]
        pulls, off_m = (np.concatenate(parts) for parts in zip(*tables, strict=True))
        inside = np.abs(pulls) < WITHIN
        print(
            f"{np.sum(inside)} of {len(pulls)} coordinates within {WITHIN} stddevs ({100 * np.mean(inside):.0f} %), "
            f"pulls {np.sqrt(np.mean(np.square(pulls))):.2f} (rms); {len(off_m)} anchors off by "
            f"{np.median(off_m):.3f} m (median), {np.max(off_m):.3f} m (largest)\n"
        )


def one_log(data: Path, name: str, described: dict[str, Any], *, know_height: bool) -> tuple[Array, Array]:
    """Print a log's table; return the pulls of the estimated coordinates, and (k,) errors of the anchors, metres."""
    log, anchors, path = read_set(data, described)
    truth = {anchor.anchor_id: np.asarray(anchor.position_m) for anchor in anchors}
    log = log.subset(np.isin(np.array(log.anchor_ids)[log.anchor_index], list(truth)))
    tags_m = positions_of_tags(log, path, described)
    above = {anchor_id: [0.0, 0.0, place[2] - np.nanmean(tags_m[:, 2])] for anchor_id, place in truth.items()}
    began = time.process_time()
    placements = trilaterate_anchors(
        log,
        tags_m,
        toward=above,
        height_m={anchor_id: float(place[2]) for anchor_id, place in truth.items()} if know_height else None,
        options=TrilaterationOptions(max_position_stddev_m=20.0),
    )
    took_s = time.process_time() - began
    num = 2 if know_height else 3
    rows = [one_anchor(name, placement, truth[placement.anchor_id], num) for placement in placements]
    print(f"{name:16}{took_s:6.1f} s", flush=True)
    return np.concatenate([pulls for pulls, _ in rows]), np.concatenate([off_m for _, off_m in rows])


def positions_of_tags(log: RangeLog, path: Reference, described: dict[str, Any]) -> Array:
    """(n, 3) position of the tag at each range, each tag with its own lever arm."""
    offset_s = described.get("time_offset_s", 0.0)
    max_gap_s = max(described.get("max_gap_s", 0.0), MAX_GAP_S)
    arms = described.get("tags_in_body_m", dict.fromkeys(log.tag_ids, described.get("tag_in_body_m", (0.0, 0.0, 0.0))))
    tags_m = np.full((len(log), 3), np.nan)
    for number, tag_id in enumerate(log.tag_ids):
        rows = np.flatnonzero(log.tag_index == number)
        tags_m[rows] = tag_positions(log.subset(rows), path, arms[tag_id], time_offset_s=offset_s, max_gap_s=max_gap_s)
    return tags_m


def one_anchor(name: str, placement: AnchorPlacement, truth: Array, num: int) -> tuple[Array, Array]:
    """Return the pulls of the first ``num`` coordinates and their error; both are empty for a refused anchor."""
    found = placement.found
    if found is None:
        print(f"{name:16}{placement.anchor_id:6}{placement.num_ranges:6} {placement.why_not}")
        return np.empty(0), np.empty(0)
    off, stddevs = (found.position_m - truth)[:num], np.sqrt(np.diag(found.covariance_m2))[:num]
    print(
        f"{name:16}{placement.anchor_id:6}{placement.num_ranges:6}  off {np.linalg.norm(off):6.3f} m  "
        f"{' '.join(f'{value:+7.3f} +-{stddev:6.3f}' for value, stddev in zip(off, stddevs, strict=True))}  "
        f"bias {found.range_bias_m:+.3f}",
        flush=True,
    )
    return off / stddevs, np.array([np.linalg.norm(off)])


if __name__ == "__main__":
    main()
