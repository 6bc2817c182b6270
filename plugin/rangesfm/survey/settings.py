"""The survey: all settings and paths of a run, from a TOML file, from flags or from both."""

from __future__ import annotations

import os
import re
import sys
from collections import Counter
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict, Field

from rangesfm.errors import InputError, OptionError, nearest_known, printable, shown
from rangesfm.files.atomic import path_of
from rangesfm.option_model import Key, Options, PathRole
from rangesfm.options import (
    AnchorOptions,
    CameraOptions,
    ExportOptions,
    ImageOptions,
    MapperOptions,
    MarkerOptions,
    OutputOptions,
    RangesOptions,
    RefineOptions,
    ReportOptions,
    ScaleOptions,
    TagOptions,
)

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

# A flag for the first key replaces the second key in the file, because both give lever arms.
_INSTEAD_OF = {"tag.tag_in_cam_m": "lever_arms_m", "tag.lever_arms_m": "tag_in_cam_m"}


@dataclass(frozen=True)
class OptionsOrigin:
    """Origin of options, for messages. Any two are equal, so that surveys are compared without it.

    Attributes:
        path: of the file; None if there is none.
        text: content of the file.
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
            key = f"{error.table}.{error.key or ''}".strip(".")
            if any(f"{key}.".startswith(f"{other}.") for other in self.overridden):
                raise InputError(str(error)) from None
            # Unknown keys of [mapper] were moved to its pipeline; an entry of an inline table is on the table's line.
            places = (key, key.replace("mapper.pipeline", "mapper"), key.rpartition(".")[0])
            lines = (self._line_of(place) for place in places)
            raise InputError(str(error), self.path, next(filter(None, lines), None)) from None

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


def parse_toml(path: Path) -> tuple[dict[str, Any], OptionsOrigin]:
    """Read a TOML file.

    Raises:
        InputError: it cannot be read or is not TOML; the text names the line.
    """
    from rangesfm.files.text_tables import read_text

    text = read_text(path)
    try:
        return tomllib.loads(text), OptionsOrigin(path, text)
    except RecursionError:
        raise InputError("not a TOML file (nested too deeply)", path) from None
    except ValueError as error:  # a TOMLDecodeError, or a number that Python refuses to read
        where = re.search(r" \(at (?:line (\d+), column \d+|end of document)\)$", str(error))
        message = str(error)[: where.start()] if where else str(error)
        line = None if where is None else int(where[1] or text.rstrip().count("\n") + 1)
        raise InputError(f"not a TOML file ({printable(message)})", path, line) from None


def parse_inline_table(text: str) -> dict[str, Any]:
    """Read text such as ``a = 1, b.c = "x"`` as the inside of an inline table of TOML.

    Raises:
        ValueError: it is not TOML.
    """
    table: dict[str, Any] = tomllib.loads(f"table = {{{text}}}")["table"]
    return table


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
                "([images] model, --input_path MODEL)"
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

    def require_metres(self) -> None:
        """Check that the survey has something measured in metres.

        Raises:
            InputError: it has nothing, or only printed tags of unknown size.
        """
        if self.scale.distances is not None or self.markers.side_m is not None:
            return
        if self.markers.dictionary is not None:
            raise InputError(
                "[markers] side_m is not given: give the tags' side in metres (--marker_side_m), or taped distances "
                "between their corners (--distances CSV)"
            )
        if self.ranges.path is None and self.images.rig_config is None:
            raise InputError(
                "no ranges and no lengths: give a radio's log (--ranges LOG), taped distances (--distances CSV), "
                "the size of printed tags (--marker_side_m), or a rig with known poses (--rig_config_path JSON)"
            )

    def to_dict(self) -> dict[str, Any]:
        """Return all settings as plain values that JSON can hold."""
        return self.model_dump(mode="json")

    def input_paths(self) -> Iterator[InputPath]:
        """Yield every path that is read. It must exist, it is hashed, and no result may overwrite it."""
        from rangesfm.ranging.readers import files_of_log  # imported here, because --help should not load numpy

        for dotted_key, role in _ROLE_OF_PATH.items():
            table, _, name = dotted_key.partition(".")
            path = getattr(getattr(self, table), name)
            if path is not None and role == "log":
                yield from (
                    InputPath(dotted_key, "log" if file.is_dir() else "file", file) for file in files_of_log(path)
                )
            elif path is not None and role != "output":
                yield InputPath(dotted_key, role, path)


@dataclass(frozen=True)
class InputPath:
    """A path that a survey reads.

    Attributes:
        key: dotted key of the survey file.
        role: kind of file or folder.
        path: absolute.
    """

    key: str
    role: PathRole
    path: Path


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
_ROLE_OF_PATH: dict[str, PathRole] = {item.dotted: item.role for item in KEYS if item.role is not None}


def chosen_keys(chosen: Collection[str]) -> list[Key]:
    """Return the keys named by dotted keys, or by names of tables for all their keys; all keys if none are named."""
    return [item for item in KEYS if not chosen or item.table in chosen or item.dotted in chosen]


def read_survey(
    path: str | Path, overrides: Mapping[str, object] | None = None, base_folder: str | Path | None = None
) -> Survey:
    """Read a survey file.

    Args:
        path: of the TOML file.
        overrides: values by dotted key (``{"ranges.path": "uwb.csv"}``) that replace those of the file. Their paths are
            relative to the working directory.
        base_folder: folder to which paths in the file are relative; None: the folder of the file.

    Raises:
        InputError: an unknown table or key, a value of the wrong type or out of bounds, or a file that does not exist.
            The text names the line where possible.
    """
    tables, source = parse_toml(Path(path))
    folder = Path(path).absolute().parent if base_folder is None else base_folder
    return survey_from_tables(tables, folder, overrides, source)


def survey_from_tables(
    tables: Mapping[str, Any],
    base_folder: str | Path,
    overrides: Mapping[str, object] | None = None,
    source: OptionsOrigin | None = None,
) -> Survey:
    """Make a survey from tables in memory, otherwise as ``read_survey``; ``source`` names the file for messages."""
    folder, overrides = Path(base_folder).absolute(), overrides or {}
    source = replace(source or OptionsOrigin(), overridden=tuple(overrides))
    with source.naming_lines():
        tables, other_cameras = _with_one_camera(tables)
        refuse_unknown_tables(tables, SURVEY_TABLES)
        given: dict[str, dict[Any, Any]] = {name: dict(tables.get(name, {})) for name in SURVEY_TABLES}
        given["output"].setdefault("path", "out")
        for dotted_key in _ROLE_OF_PATH:
            table, _, name = dotted_key.partition(".")
            if name in given[table]:
                given[table][name] = absolute_value(given[table][name], folder)
        for dotted_key, value in overrides.items():
            table, _, name = dotted_key.partition(".")
            given[table].pop(_INSTEAD_OF.get(dotted_key), None)
            given[table][name] = absolute_value(value, Path.cwd()) if dotted_key in _ROLE_OF_PATH else value
        given["camera"] |= {"others": other_cameras} if other_cameras else {}
        options: dict[str, Any] = {name: model(**given[name]) for name, model in SURVEY_TABLES.items()}
        survey = Survey(**options, source=source)
        _require_files(survey)
    return survey


def _with_one_camera(tables: Mapping[str, Any]) -> tuple[Mapping[str, Any], tuple[CameraOptions, ...]]:
    """Return the tables with a single [camera], and the options of the other [[camera]] tables, which have a pattern.

    Raises:
        OptionError: a camera's options are not valid, or two have no pattern.
    """
    cameras = tables.get("camera")
    if not isinstance(cameras, list):
        return tables, ()
    others, rest = [], []
    for number, table in enumerate(cameras, 1):
        if "images" not in table:
            rest.append(table)
            continue
        try:
            others.append(CameraOptions(**table))
        except OptionError as error:
            raise OptionError(str(error), f"camera {number}", error.key) from None
    if len(rest) > 1:
        message = f"{len(rest)} [[camera]] tables have no key images, expected at most one: that for all other photos"
        raise OptionError(message, "camera")
    return {**tables, "camera": rest[0] if rest else {}}, tuple(others)


def refuse_unknown_tables(tables: Mapping[str, Any], known: Collection[str]) -> None:
    """Check that all tables are known and are tables.

    Raises:
        OptionError: one is not; the text names the nearest known table.
    """
    for name, table in tables.items():
        if name not in known:
            message = f"unknown table [{printable(name)}]; the nearest known one is '{nearest_known(name, known)}'"
            raise OptionError(message, "", name)
        if not isinstance(table, Mapping):
            raise OptionError(f"{name} is {shown(table)}, expected a table [{name}]", "", name)


def absolute_value(value: object, folder: Path) -> object:
    """Return text or a path as an absolute path, and any other value unchanged."""
    # What can be the name of no file stays as it is, and is refused as no path.
    is_name = isinstance(value, (str, Path)) and str(value) and "\0" not in str(value)
    return folder / path_of(str(value)) if is_name else value


def _require_files(survey: Survey) -> None:
    try:
        paths = [*survey.input_paths()]
    except InputError as error:
        raise OptionError(f"[ranges] path: {error}", "ranges", "path") from None
    for item in paths:
        if item.role == "file" and not os.path.isfile(item.path):
            is_folder = os.path.isdir(item.path)
            found = f"{item.path} is a folder, expected a file" if is_folder else f"there is no file {item.path}"
            table, _, name = item.key.partition(".")
            raise OptionError(f"[{table}] {name}: {found}", table, name)
