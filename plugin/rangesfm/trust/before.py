"""What can be known from files alone, said before the long work: each note with what was found and what to do."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from itertools import combinations

import numpy as np
import pycolmap

from rangesfm.arrays import Array
from rangesfm.colmap.reprojection import photo_errors_px, point_errors
from rangesfm.ranging.log import RangeKind, RangeLog
from rangesfm.survey.inputs import RangingInputs
from rangesfm.survey.settings import Survey
from rangesfm.trust.anchor_distances import notes_on_distances

# No surveyor measures the heights of three anchors to be the same to a millimetre, nor puts two into one place.
_SAME_HEIGHT_M, _SAME_PLACE_M = 1e-3, 0.01
_MIN_ANCHORS_ALIKE = 3
# UWB radios reach some 200 m.
_FAR_M, _FAR_SHARE = 300.0, 0.95
# Of an anchor's ranges that are one and the same value, and of the others': a tag that stands still repeats all.
_STUCK_SHARE, _MOVING_SHARE, _MIN_RANGES = 0.5, 0.2, 20
# Of the median gap between photos: between two walks.
_PAUSE = 30.0
# Clocks that count seconds since 1970 have passed this.
_SINCE_1970_S = 1e9
_LONG_GAP_S = 60.0
_MIN_SHARE_OF_TIME = 0.5
_MAX_SHARE_BETWEEN_FAR_PHOTOS = 0.3


def notes_before_work(survey: Survey, inputs: RangingInputs) -> Iterator[str]:
    """Of the radio's side of a survey, in words for its user; nothing where all seems right."""
    if len(inputs.log) and not {"tag_in_cam_m", "lever_arms_m"} & survey.tag.model_fields_set:
        yield (
            "the tag's place on the camera is not given and taken to be the lens itself: ranges are off by as much as "
            "it is away; measure from the lens to the antenna, right, down and forward (--tag_in_cam X,Y,Z)"
        )
    yield from _on_ranges(inputs.log)
    if inputs.anchor_frame == "unknown":
        return
    surveyed = {anchor.anchor_id: anchor.position_m for anchor in inputs.anchors if anchor.position_m is not None}
    yield from _on_positions(surveyed, is_site=inputs.anchor_frame == "site")
    yield from notes_on_distances(inputs.log, inputs.anchors)


def _on_positions(positions_m: Mapping[str, Array], *, is_site: bool) -> Iterator[str]:
    heights_m = np.array([at[2] for at in positions_m.values()])
    if is_site and len(heights_m) >= _MIN_ANCHORS_ALIKE and np.ptp(heights_m) < _SAME_HEIGHT_M:
        yield (
            f"all {len(heights_m)} anchors have one height, {heights_m[0]:g} m: if nobody measured it, the map's "
            "height and tilt rest on a guess, and the ranges cannot show it; measure the heights of the antennas"
        )
    for one, other in combinations(positions_m, 2):
        if np.linalg.norm(positions_m[one] - positions_m[other]) < _SAME_PLACE_M:
            yield (
                f"anchors {one} and {other} have the same position: one of them stands elsewhere; "
                "correct it, or leave its coordinates empty"
            )


def _on_ranges(log: RangeLog) -> Iterator[str]:
    rows = log.kind == RangeKind.TAG_ANCHOR
    long_m = float(np.quantile(log.range_m[rows], 1 - _FAR_SHARE)) if rows.any() else 0.0
    if long_m > _FAR_M:
        yield (
            f"nearly all ranges are longer than {long_m:.4g} m, farther than UWB radios reach: their unit is probably "
            "not the metre; give it ([ranges] range_unit)"
        )
    of_anchors = [log.range_m[rows & (log.anchor_index == k)] for k in range(len(log.anchor_ids))]
    shares = np.array([_share_of_one_value(ranges_m) for ranges_m in of_anchors])
    for k in np.flatnonzero(shares > _STUCK_SHARE):
        others = np.delete(shares, k)
        if len(others) and np.nanmedian(np.append(others, np.nan)) < _MOVING_SHARE:
            yield (
                f"anchor {log.anchor_ids[k]} reads one and the same value in {100 * shares[k]:.0f} % of its ranges "
                "while the others change: it is probably stuck; leave it out (--use_anchors)"
            )


def _share_of_one_value(ranges_m: Array) -> float:
    """How many of an anchor's ranges are the commonest one; 0 of a few."""
    if len(ranges_m) < _MIN_RANGES:
        return 0.0
    return float(np.unique(ranges_m, return_counts=True)[1].max() / len(ranges_m))


def notes_on_times(radio_s: Array, photos_s: Array) -> Iterator[str]:
    """Of two clocks whose offset is to be searched for.

    Args:
        radio_s, photos_s: times of ranges and photos, each by its own clock, in any order.
    """
    if len(radio_s) < 2 or len(photos_s) < 2:
        return
    radio, photos = (radio_s.min(), radio_s.max()), (photos_s.min(), photos_s.max())
    lasts_s, photos_last_s = radio[1] - radio[0], photos[1] - photos[0]
    if lasts_s < _MIN_SHARE_OF_TIME * photos_last_s:
        yield (
            f"the ranges last {lasts_s:.4g} s, the photos {photos_last_s:.4g} s: most photos have no ranges; check "
            "that log and photos are of one walk, and the unit of the times ([ranges] timestamp_unit)"
        )
    gap_s = max(radio[0] - photos[1], photos[0] - radio[1])
    if min(radio[0], photos[0]) > _SINCE_1970_S and gap_s > _LONG_GAP_S:
        yield (
            f"by their clocks, ranges and photos are {gap_s / 3600:.2g} h apart: another time zone, or another walk; "
            "the offset is searched for, check what is found"
        )


def notes_on_gaps(photos_s: Array, max_gap_s: float) -> Iterator[str]:
    """Of keyframes too far apart for the ranges between them, within a walk.

    Args:
        photos_s: times, ascending.
        max_gap_s: farther apart, ranges between two have no place.
    """
    gaps_s = np.diff(np.unique(photos_s))
    gaps_s = gaps_s[gaps_s <= _PAUSE * np.median(gaps_s)] if len(gaps_s) else gaps_s
    if len(gaps_s) and (share := gaps_s[gaps_s > max_gap_s].sum() / gaps_s.sum()) > _MAX_SHARE_BETWEEN_FAR_PHOTOS:
        yield (
            f"for {100 * share:.0f} % of the time keyframes are more than {max_gap_s:g} s apart (in the median "
            f"{np.median(gaps_s):.3g} s): ranges between those are left out; use more of the photos, or allow more by "
            "--max_interpolation_gap_s if the camera moved slowly"
        )


def notes_on_model(model: pycolmap.Reconstruction) -> Iterator[str]:
    """Of a model that was brought along."""
    errors = point_errors(model)
    if not errors.fit:
        yield (
            f"the model's points lie {errors.median_px:.3g} px (median) from where its photos show them, expected "
            f"below {errors.max_median_px:.3g} px: check that model, photos and the camera's parameters belong together"
        )
        return
    off_px = {name: off for name, off in photo_errors_px(model).items() if off > errors.max_median_px}
    if off_px:
        worst = max(off_px, key=lambda name: off_px[name])
        others = f" and {len(off_px) - 1} more" if len(off_px) > 1 else ""
        yield (
            f"photo {worst}{others}: in the model most of its points are farther than {errors.max_median_px:.3g} px "
            "from where it shows them: its pose is wrong; take it out of the model, or map anew"
        )
