"""The small tables of the result folder: times, covariances, and how scale and clock offset came about."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Annotated, ClassVar

import numpy as np

from rangesfm.arrays import Array
from rangesfm.result.metric_result import MetricResult
from rangesfm.result.table_file import Column, Numbers, NumbersOrEmpty, Rounded, RoundedOrEmpty, TableFile, Texts

_Covariance = Annotated[Array, Column(".9g")]


@dataclass(frozen=True)
class PhotoTimes(TableFile):
    """``images.csv``: when each photo was taken, on the camera's clock; none where the photos have no times."""

    NAME: ClassVar = "images.csv"
    image_name: Texts
    timestamp_s: Numbers

    @classmethod
    def of(cls, found: MetricResult) -> PhotoTimes | None:
        times = found.trajectory.timestamps_s
        return None if times is None else cls(found.trajectory.image_names, times)

    @cached_property
    def by_name(self) -> dict[str, float]:
        return dict(zip(self.image_name, self.timestamp_s.tolist(), strict=True))


@dataclass(frozen=True)
class CenterCovariances(TableFile):
    """``pose_covariance.csv``: covariance of each keyframe's projection centre, m^2, in the result's frame."""

    NAME: ClassVar = "pose_covariance.csv"
    image_name: Texts
    cov_xx_m2: _Covariance
    cov_xy_m2: _Covariance
    cov_xz_m2: _Covariance
    cov_yy_m2: _Covariance
    cov_yz_m2: _Covariance
    cov_zz_m2: _Covariance

    @classmethod
    def of(cls, found: MetricResult) -> CenterCovariances | None:
        by_photo = found.center_covariance_m2
        if not by_photo:
            return None
        rows, columns = np.triu_indices(3)
        return cls(tuple(by_photo), *np.array(list(by_photo.values()))[:, rows, columns].T)

    @property
    def by_photo_m2(self) -> dict[str, Array]:
        """(3, 3) by the name of the photo."""
        xx, xy, xz = self.cov_xx_m2, self.cov_xy_m2, self.cov_xz_m2
        yy, yz, zz = self.cov_yy_m2, self.cov_yz_m2, self.cov_zz_m2
        matrices = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]).transpose(2, 0, 1)
        return dict(zip(self.image_name, matrices, strict=True))


@dataclass(frozen=True)
class TagCorners(TableFile):
    """``markers.csv``: where corners of printed tags were found in photos, in pixels; to be a survey's markers."""

    NAME: ClassVar = "markers.csv"
    marker: Texts
    image_name: Texts
    x_px: Rounded
    y_px: Rounded

    @classmethod
    def of(cls, found: MetricResult) -> TagCorners | None:
        markers = {} if found.tape is None else found.tape.found_markers
        if not markers:
            return None
        names = [name for name, marker in markers.items() for _ in marker.image_names]
        photos = [name for marker in markers.values() for name in marker.image_names]
        pixels = np.concatenate([marker.pixels for marker in markers.values()])
        return cls(tuple(names), tuple(photos), *pixels.T)


@dataclass(frozen=True)
class ScaleCandidates(TableFile):
    """``scale_candidates.csv``: the paper's two candidates of each range that has them, metres per SfM unit."""

    NAME: ClassVar = "scale_candidates.csv"
    timestamp_s: NumbersOrEmpty
    anchor_id: Texts
    alpha0: Rounded
    alpha1: Rounded

    @classmethod
    def of(cls, found: MetricResult) -> ScaleCandidates | None:
        if not len(found.observations.log):
            return None
        rows, log = found.diagnostics.candidate_rows, found.observations.log
        times = np.full(len(rows), np.nan) if log.timestamp_s is None else log.timestamp_s[rows]
        ids = tuple(log.anchor_ids[k] for k in log.anchor_index[rows])
        return cls(times, ids, *found.diagnostics.candidates.T)


@dataclass(frozen=True)
class ScaleConsensus(TableFile):
    """``scale_consensus.csv``: how many ranges agree with each scale, metres per SfM unit."""

    NAME: ClassVar = "scale_consensus.csv"
    scale: Rounded
    num_agreeing: Annotated[Array, Column(".0f")]

    @classmethod
    def of(cls, found: MetricResult) -> ScaleConsensus | None:
        if not len(found.observations.log):
            return None
        return cls(found.diagnostics.curve_scales, found.diagnostics.num_agreeing.astype(np.float64))


@dataclass(frozen=True)
class TimeOffsetCurve(TableFile):
    """``time_offset_curve.csv``: what offsets of the clocks cost, metres, where one was searched for (CostCurve)."""

    NAME: ClassVar = "time_offset_curve.csv"
    time_offset_s: Numbers
    cost: RoundedOrEmpty

    @classmethod
    def of(cls, found: MetricResult) -> TimeOffsetCurve | None:
        curve = None if found.time_offset is None else found.time_offset.curve
        return None if curve is None else cls(curve.offsets_s, curve.costs_m)
