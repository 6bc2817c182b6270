"""Tables of the result folder: CSV files, each described by a class whose fields are the columns."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, ClassVar, NamedTuple, TypeVar, get_type_hints

import numpy as np

from rangesfm.arrays import Array, Indices, Mask
from rangesfm.measurements.ranges.range_observations import USED
from rangesfm.util.files.text_tables import read_table, write_table

_Kind = TypeVar("_Kind", bound="TableFile")
_TEXT = "s"
USED_LABELS = [status.label for status in USED]


class ColumnFormat(NamedTuple):
    """Format of a column.

    Attributes:
        format_spec: format of the cells, such as ".6g", or "s" for text. Empty: as many digits as needed to read back
            the same numbers.
        may_be_empty: whether cells may be empty; an empty cell is read as NaN or an empty text.
    """

    format_spec: str
    may_be_empty: bool = False


Texts = Annotated[tuple[str, ...], ColumnFormat(_TEXT)]
TextsOrEmpty = Annotated[tuple[str, ...], ColumnFormat(_TEXT, may_be_empty=True)]
Numbers = Annotated[Array, ColumnFormat("")]
NumbersOrEmpty = Annotated[Array, ColumnFormat("", may_be_empty=True)]
Rounded = Annotated[Array, ColumnFormat(".6g")]
RoundedOrEmpty = Annotated[Array, ColumnFormat(".6g", may_be_empty=True)]
_Covariance = Annotated[Array, ColumnFormat(".9g")]


@dataclass(frozen=True)
class TableFile:
    """A table with n rows. Each field is a column (``Texts``, ``Numbers``, ...), with its name and in its order."""

    NAME: ClassVar[str]

    def __len__(self) -> int:
        return len(getattr(self, fields(self)[0].name))

    @classmethod
    def columns(cls) -> dict[str, ColumnFormat]:
        """Return the columns by name, in their order."""
        hints = get_type_hints(cls, include_extras=True)
        return {field.name: hints[field.name].__metadata__[0] for field in fields(cls)}

    def write(self, folder: Path) -> None:
        """Write the file into a folder. If that fails, no part of the file is left."""
        columns = self.columns()
        cells: list[Sequence[str]] = []
        for name, (spec, _) in columns.items():
            values = getattr(self, name)
            is_text = spec == _TEXT
            cells.append(values if is_text else [f"{x:{spec}}" if math.isfinite(x) else "" for x in values.tolist()])
        write_table(folder / self.NAME, list(columns), zip(*cells, strict=True))

    @classmethod
    def read(cls: type[_Kind], folder: Path) -> _Kind:
        """Read the file of a folder; if it is not there, the table has no rows.

        Raises:
            InputError: the file was not written by a run; the text names the line.
        """
        path, columns = folder / cls.NAME, cls.columns()
        if not path.is_file():
            return cls(**{name: () if spec == _TEXT else np.zeros(0) for name, (spec, _) in columns.items()})
        table, values = read_table(path, list(columns)), dict[str, Any]()
        for name, (spec, may_be_empty) in columns.items():
            if spec == _TEXT:
                values[name] = tuple(table.text(name, empty="" if may_be_empty else None))
            else:
                values[name] = table.numbers(name, empty=np.nan if may_be_empty else None)
        return cls(**values)


@dataclass(frozen=True)
class RangesAsUsed(TableFile):
    """Content of ``ranges.csv``: all n ranges of the log, in the order of their times.

    A range between two anchors or two tags has one id in the column of anchors and the other in that of tags. "Place"
    means the place on the camera's path.

    Attributes:
        timestamp_s: (n,) on the radio's clock; NaN where the log names photos instead.
        image_name: n names; empty where the log has times.
        anchor_id, tag_id: n ids.
        range_m: (n,) measured ranges.
        range_stddev_m: (n,) last noise stddev of each range; NaN without a place.
        keyframe_before, keyframe_after: n photos between which each range was taken; empty without a place.
        weight: (n,) interpolation fraction, 0 at ``keyframe_before`` and 1 at ``keyframe_after``; NaN without a place.
        predicted_scaled_m, predicted_refined_m: (n,) ranges predicted by the scaled and by the refined model; NaN
            without a place or without that model.
        residual_m: (n,) range predicted by the final model, minus measured range.
        robust_weight: (n,) weight by that residual, in [0, 1]; NaN for ranges that the estimate does not consider.
        status: n labels of RangeStatus.
    """

    NAME: ClassVar[str] = "ranges.csv"
    timestamp_s: NumbersOrEmpty
    image_name: TextsOrEmpty
    anchor_id: Texts
    tag_id: Texts
    range_m: Numbers
    range_stddev_m: RoundedOrEmpty
    keyframe_before: TextsOrEmpty
    keyframe_after: TextsOrEmpty
    weight: RoundedOrEmpty
    predicted_scaled_m: RoundedOrEmpty
    predicted_refined_m: RoundedOrEmpty
    residual_m: RoundedOrEmpty
    robust_weight: RoundedOrEmpty
    status: Texts

    def places_on(self, image_names: Sequence[str]) -> tuple[Indices, Indices, Mask]:
        """Return where each range is on a path.

        Args:
            image_names: of the keyframes of the path.

        Returns:
            (n,) number of the keyframe before each range, -1 for none; (n,) the same after it; (n,) whether the range
            has a place on the path.
        """
        index_of = {name: i for i, name in enumerate(image_names)}
        before, after = (
            np.array([index_of.get(name, -1) for name in names], dtype=np.int64)
            for names in (self.keyframe_before, self.keyframe_after)
        )
        return before, after, (before >= 0) & (after >= 0) & np.isfinite(self.weight)

    def camera_times_s(self, photos_s: Mapping[str, float]) -> Array:
        """Return the time of each range on the camera's clock, (n,) seconds; NaN without a place.

        Args:
            photos_s: times of the photos by name, between which the times of the ranges are interpolated.
        """
        before, after = (
            np.array([photos_s.get(name, np.nan) for name in names], dtype=np.float64)
            for names in (self.keyframe_before, self.keyframe_after)
        )
        return np.asarray((1 - self.weight) * before + self.weight * after)

    @property
    def residuals_by_model_m(self) -> dict[str, Array]:
        """Return predicted minus measured ranges, (n,) metres, by model: "scaled" and, if there is one, "refined"."""
        refined = self.predicted_refined_m - self.range_m
        both = {"scaled": self.predicted_scaled_m - self.range_m, "refined": refined}
        return both if np.isfinite(refined).any() else {"scaled": both["scaled"]}

    @cached_property
    def is_used(self) -> Mask:
        """Return the mask (n,) of ranges that are used in the final model, with full or reduced weight."""
        return np.isin(np.array(self.status, dtype=str), USED_LABELS)


@dataclass(frozen=True)
class PhotoTimes(TableFile):
    """Content of ``images.csv``: time of each photo on the camera's clock. There is none for photos without times."""

    NAME: ClassVar[str] = "images.csv"
    image_name: Texts
    timestamp_s: Numbers


@dataclass(frozen=True)
class CenterCovariances(TableFile):
    """Content of ``pose_covariance.csv``: covariance of each keyframe's projection centre, m^2, in the final frame."""

    NAME: ClassVar[str] = "pose_covariance.csv"
    image_name: Texts
    cov_xx_m2: _Covariance
    cov_xy_m2: _Covariance
    cov_xz_m2: _Covariance
    cov_yy_m2: _Covariance
    cov_yz_m2: _Covariance
    cov_zz_m2: _Covariance

    @property
    def by_photo_m2(self) -> dict[str, Array]:
        """Return the covariances (3, 3) by name of the photo."""
        xx, xy, xz = self.cov_xx_m2, self.cov_xy_m2, self.cov_xz_m2
        yy, yz, zz = self.cov_yy_m2, self.cov_yz_m2, self.cov_zz_m2
        matrices = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]).transpose(2, 0, 1)
        return dict(zip(self.image_name, matrices, strict=True))


@dataclass(frozen=True)
class TagCorners(TableFile):
    """Content of ``markers.csv``: pixels at which corners of printed tags were found; it can be a survey's markers."""

    NAME: ClassVar[str] = "markers.csv"
    marker: Texts
    image_name: Texts
    x_px: Rounded
    y_px: Rounded


@dataclass(frozen=True)
class ScaleCandidates(TableFile):
    """Content of ``scale_candidates.csv``: the paper's two candidates of each range, metres per SfM unit."""

    NAME: ClassVar[str] = "scale_candidates.csv"
    timestamp_s: NumbersOrEmpty
    anchor_id: Texts
    alpha0: Rounded
    alpha1: Rounded


@dataclass(frozen=True)
class ScaleConsensus(TableFile):
    """Content of ``scale_consensus.csv``: number of ranges that agree with each scale, metres per SfM unit."""

    NAME: ClassVar[str] = "scale_consensus.csv"
    scale: Rounded
    num_agreeing: Annotated[Array, ColumnFormat(".0f")]


@dataclass(frozen=True)
class TimeOffsetCurve(TableFile):
    """Content of ``time_offset_curve.csv``: cost in metres of each time offset that was tried; see OffsetCurve."""

    NAME: ClassVar[str] = "time_offset_curve.csv"
    time_offset_s: Numbers
    cost: RoundedOrEmpty


@dataclass(frozen=True)
class LoopPairs(TableFile):
    """Content of ``loops.csv``: pairs of photos of distant times that match, and what became of each.

    Attributes:
        image_name, other_image_name: names of the two photos.
        status: "closed", or "contradicted" where the ranges exclude that they show the same place.
    """

    NAME: ClassVar[str] = "loops.csv"
    image_name: Texts
    other_image_name: Texts
    status: Texts

    def pairs(self, status: str) -> list[tuple[str, str]]:
        """Return the names of the pairs with this status."""
        rows = zip(self.image_name, self.other_image_name, self.status, strict=True)
        return [(first, second) for first, second, of_pair in rows if of_pair == status]


RESULT_TABLES: tuple[type[TableFile], ...] = (
    *(RangesAsUsed, PhotoTimes, CenterCovariances, LoopPairs),
    *(ScaleCandidates, ScaleConsensus, TimeOffsetCurve, TagCorners),
)
