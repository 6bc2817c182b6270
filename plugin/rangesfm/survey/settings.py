"""The survey: all settings and paths of a run. They are values only; ``survey_reader`` reads them from a file."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from operator import attrgetter
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict, Field

from rangesfm.errors import InputError, OptionError
from rangesfm.mapper_options import MapperOptions
from rangesfm.option_model import Key, Options, PathRole
from rangesfm.options import (
    AnchorOptions,
    CameraOptions,
    ExportOptions,
    ImageOptions,
    ImuOptions,
    MarkerOptions,
    OutputOptions,
    PointOptions,
    PositionOptions,
    RangesOptions,
    RefineOptions,
    ReportOptions,
    ScaleOptions,
    TagOptions,
)


@dataclass(frozen=True)
class OptionsOrigin:
    """Origin of options, for messages. Any two are equal, so that surveys are compared without it.

    Attributes:
        overridden: dotted keys whose values came from flags or from the caller.
    """

    path: Path | None = field(default=None, compare=False)
    text: str = field(default="", compare=False, repr=False)
    overridden: tuple[str, ...] = field(default=(), compare=False)

    @contextmanager
    def naming_lines(self) -> Iterator[None]:
        """Turn an OptionError of the block into an InputError that names the file and the line of the option."""
        try:
            yield
        except OptionError as error:
            raise self.located(error) from None

    def located(self, error: OptionError) -> InputError:
        """Return the error of an option with the file and the line of the option."""
        key = f"{error.table}.{error.key}".strip(".")
        if any(f"{key}.".startswith(f"{other}.") for other in self.overridden):
            return InputError(str(error))
        # Unknown keys of [mapper] were moved to its pipeline; an entry of an inline table is on the table's line.
        places = (key, key.replace("mapper.pipeline", "mapper"), key.rpartition(".")[0])
        lines = (self._line_of(place) for place in places)
        return InputError(str(error), self.path, next(filter(None, lines), None))

    def _line_of(self, wanted: str) -> int | None:
        current, num_seen = "", Counter[str]()
        for line, text in enumerate(self.text.split("\n"), 1):
            if header := re.match(r"\s*\[\[?([^\[\]]+)\]", text):
                current = _dotted(header[1])
                num_seen[current] += 1
                if num_seen[current] > 1 or wanted.startswith(f"{current} "):  # one of several tables of this name
                    current += f" {num_seen[current]}"
                if current == wanted:
                    return line
            elif assignment := re.match(r"\s*([\w.\"' -]+?)\s*=", text):
                name = _dotted(f"{current}.{assignment[1]}")
                if f"{name}.".startswith(f"{wanted}."):
                    return line
        return None


def _dotted(text: str) -> str:
    return ".".join(part.strip().strip("\"'") for part in text.split(".")).strip(".")


class Survey(BaseModel):
    """Inputs, options and output of one run, one attribute for each table of a survey file. Paths are absolute.

    Attributes:
        source: the survey file, for messages; it is not a setting.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    images: ImageOptions = ImageOptions()
    camera: CameraOptions = CameraOptions()
    ranges: RangesOptions = RangesOptions()
    anchors: AnchorOptions = AnchorOptions()
    tag: TagOptions = TagOptions()
    points: PointOptions = PointOptions()
    positions: PositionOptions = PositionOptions()
    imu: ImuOptions = ImuOptions()
    mapper: MapperOptions = MapperOptions()
    scale: ScaleOptions = ScaleOptions()
    markers: MarkerOptions = MarkerOptions()
    refine: RefineOptions = RefineOptions()
    export: ExportOptions = ExportOptions()
    report: ReportOptions = ReportOptions()
    output: OutputOptions = OutputOptions()
    source: OptionsOrigin = Field(default=OptionsOrigin(), exclude=True, repr=False)

    def changed(self, values: Mapping[str, Any]) -> Survey:
        """Return a copy with other values by dotted key, such as ``{"scale.method": "robust"}``.

        Raises:
            OptionError: a value is not valid.
        """
        tables: dict[str, Options] = {}
        for dotted_key, value in values.items():
            table, _, name = dotted_key.partition(".")
            tables[table] = tables.get(table, getattr(self, table)).changed(**{name: value})
        return self.model_copy(update=tables)

    @property
    def photos_path(self) -> Path:
        """Return the path of the photos: a folder, a video or a bag.

        Raises:
            InputError: none is given.
        """
        if self.images.path is None:
            raise InputError(
                "no photos: give [images] path in a survey file, or --images FOLDER; or give a COLMAP model "
                "or a trajectory ([images] model, --input_path MODEL)"
            )
        return self.images.path

    @property
    def given_model_path(self) -> Path:
        """Return the path of the given COLMAP model.

        Raises:
            InputError: none is given.
        """
        if self.images.model is None:
            raise InputError("no model: give [images] model in a survey file, or --input_path MODEL, such as sparse/0")
        return self.images.model

    @property
    def metric_keys(self) -> list[str]:
        """Dotted keys of the measurements in metres that the survey has."""
        return [key for key in METRIC_KEYS if attrgetter(key)(self) is not None]

    def require_metres(self) -> None:
        """Check that the survey has something measured in metres.

        Raises:
            InputError: it has nothing, or only printed tags of unknown size.
        """
        if {*self.metric_keys} - {"ranges.path"}:
            return
        if self.markers.dictionary is not None:
            raise InputError(
                "[markers] side_m is not given: give the tags' side in metres (--marker_side_m), or taped distances "
                "between their corners (--distances CSV)"
            )
        if not self.metric_keys and self.images.rig_config is None:
            known = ", ".join(f"{key.metres} (--{key.flag})" for key in KEYS if key.metres)
            raise InputError(
                f"no ranges and no lengths: give {known}, or a rig with known poses (--rig_config_path JSON)"
            )

    def to_dict(self) -> dict[str, Any]:
        """Return all settings as plain values that JSON can hold."""
        return self.model_dump(mode="json")


SURVEY_TABLES: dict[str, type[Options]] = {
    name: field.annotation
    for name, field in Survey.model_fields.items()
    if isinstance(field.annotation, type) and issubclass(field.annotation, Options)
}
# Paths come first in each table; pydantic lists the keys of a base class before those of the table itself.
KEYS = tuple(
    item
    for model in SURVEY_TABLES.values()
    for item in sorted(model.keys().values(), key=lambda item: item.role is None)
)
METRIC_KEYS = tuple(item.dotted for item in KEYS if item.metres)
"""Dotted keys of the measurements from which the map gets its metres."""
ROLE_OF_PATH: dict[str, PathRole] = {item.dotted: item.role for item in KEYS if item.role is not None}
"""Kind of file or folder by dotted key, of the keys whose values are paths."""


def chosen_keys(chosen: Collection[str]) -> list[Key]:
    """Return the keys named by dotted keys, or by names of tables for all their keys; all keys if none are named."""
    return [item for item in KEYS if not chosen or item.table in chosen or item.dotted in chosen]
