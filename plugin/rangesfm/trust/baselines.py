"""The scale by the known distances between a rig's cameras, and that by the ranges: each checks the other."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

import numpy as np
import pycolmap

from rangesfm.distances.ends import locate_distances
from rangesfm.distances.tape import Tape, TapedDistance
from rangesfm.files.records import Number, Record, Text
from rangesfm.scale.estimate import ScaleEstimate

ADVICE = "measure the rig's baseline and a distance between two anchors with a tape: one of the two is wrong"
# Of stddevs; one honest pair of scales in three hundred is further apart.
_DISAGREES = 3.0


class Baseline(Record):
    """The distance between two cameras of a rig, metres, and the scale that it gives, metres per SfM unit.

    Attributes:
        photos: of the two cameras, taken at once.
        relative_scale_stddev: by the distance alone: in the model the cameras are taken to be where they are.
        off_by: by how much of itself this scale is larger than that of the ranges.
        agrees: whether the uncertainties of both explain that.
    """

    photos: tuple[Text, Text]
    distance_m: Number
    stddev_m: Number
    scale: Number
    relative_scale_stddev: Number
    off_by: Number
    agrees: bool

    def __str__(self) -> str:
        return (
            f"the rig's cameras are {self.distance_m:.4g} m apart, which gives a scale of {self.scale:.6g} m per SfM"
            f" unit: {abs(self.off_by):.2%} {'more' if self.off_by > 0 else 'less'} than the ranges"
        )


def compare_baselines(
    taped: Sequence[TapedDistance], sfm: pycolmap.Reconstruction, by_ranges: ScaleEstimate
) -> tuple[Baseline, ...]:
    """The scale of an unscaled model by each baseline."""
    lengths = locate_distances(Tape(tuple(taped)), sfm, []).model_length
    found = []
    for one, length in zip(taped, lengths.tolist(), strict=True):
        scale, relative = one.distance_m / length, one.stddev_m / one.distance_m
        limit = _DISAGREES * math.hypot(relative, by_ranges.uncertainty.empirical)
        found.append(
            Baseline(
                photos=one.ends,
                distance_m=one.distance_m,
                stddev_m=one.stddev_m,
                scale=scale,
                relative_scale_stddev=relative,
                off_by=scale / by_ranges.value - 1,
                agrees=bool(abs(np.log(scale / by_ranges.value)) <= limit),
            )
        )
    return tuple(found)


def disagreeing(baselines: Iterable[Baseline]) -> tuple[str, ...]:
    """What speaks against either scale, in words."""
    return tuple(f"{one}, which the uncertainties of both do not explain" for one in baselines if not one.agrees)
