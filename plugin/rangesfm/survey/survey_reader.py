"""Reading of surveys: from a TOML file, from flags or from both, and the files that a survey names, with hashes."""

from __future__ import annotations

import hashlib
import os
import re
import sys
from collections.abc import Collection, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final

from rangesfm.errors import InputError, OptionError, nearest_known, printable, shown
from rangesfm.measurements.ranges.readers import files_of_log
from rangesfm.option_model import Options, PathRole
from rangesfm.options import CameraOptions
from rangesfm.survey.settings import ROLE_OF_PATH, SURVEY_TABLES, OptionsOrigin, Survey
from rangesfm.util.files.atomic import path_of
from rangesfm.util.files.contents import AnyPath, sha256_of
from rangesfm.util.files.folders import walk
from rangesfm.util.files.text_tables import read_text

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

NO_OVERRIDES: Final[Mapping[str, object]] = MappingProxyType({})
# A flag for the first key replaces the second key in the file, because both give lever arms.
_INSTEAD_OF = {"tag.tag_in_cam_m": "lever_arms_m", "tag.lever_arms_m": "tag_in_cam_m"}


def parse_toml(path: Path) -> tuple[dict[str, Any], OptionsOrigin]:
    """Read a TOML file.

    Raises:
        InputError: it cannot be read or is not TOML; the text names the line.
    """
    text = read_text(path)
    try:
        return tomllib.loads(text), OptionsOrigin(path, text)
    except RecursionError:
        raise InputError("not a TOML file (nested too deeply)", path) from None
    except ValueError as error:  # a TOMLDecodeError, or a number that Python refuses to read
        where = re.search(r" \(at (?:line (\d+), column \d+|end of document)\)$", str(error))
        message = str(error)[: where.start()] if where else str(error)
        line = None if where is None else int(where[1] or text.rstrip().count("\n") + 1)
        hint = "texts stand in straight double quotes, with / between folders, and numbers have decimal points"
        raise InputError(f"not a TOML file ({printable(message)}); {hint}", path, line) from None


def parse_inline_table(text: str) -> dict[str, Any]:
    """Read text such as ``a = 1, b.c = "x"`` as the inside of an inline table of TOML.

    Raises:
        ValueError: it is not TOML.
    """
    table: dict[str, Any] = tomllib.loads(f"table = {{{text}}}")["table"]
    return table


def read_survey(
    path: AnyPath, overrides: Mapping[str, object] = NO_OVERRIDES, base_folder: AnyPath | None = None
) -> Survey:
    """Read a survey file.

    Args:
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
    base_folder: AnyPath,
    overrides: Mapping[str, object] = NO_OVERRIDES,
    source: OptionsOrigin = OptionsOrigin(),
) -> Survey:
    """Make a survey from tables in memory, otherwise as ``read_survey``; ``source`` names the file for messages."""
    folder = Path(base_folder).absolute()
    source = replace(source, overridden=tuple(overrides))
    with source.naming_lines():
        tables, other_cameras = _with_one_camera(tables)
        refuse_unknown_tables(tables, SURVEY_TABLES)
        tables = {**tables, "output": {"path": "out", **tables.get("output", {})}}
        given = {
            name: with_absolute_paths(tables.get(name, {}), model, folder) for name, model in SURVEY_TABLES.items()
        }
        for dotted_key, value in overrides.items():
            table, _, name = dotted_key.partition(".")
            given[table].pop(_INSTEAD_OF.get(dotted_key), None)
            given[table][name] = _absolute_value(value, Path.cwd()) if dotted_key in ROLE_OF_PATH else value
        given["camera"] |= {"others": other_cameras} if other_cameras else {}
        options: dict[str, Any] = {name: model(**given[name]) for name, model in SURVEY_TABLES.items()}
        survey = Survey(**options, source=source)
        if survey.scale.markers is not None and survey.scale.distances is None and survey.points.path is None:
            why = "expected distances beside it, or [points]: marks are ends of taped distances, or have coordinates"
            raise survey.scale.refused("markers", f"is '{survey.scale.markers}', {why}")
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


def with_absolute_paths(table: Mapping[Any, Any], model: type[Options], folder: Path) -> dict[Any, Any]:
    """Return a table of a file in a folder with the paths in it absolute."""
    keys = model.keys()
    return {
        name: _absolute_value(value, folder) if name in keys and keys[name].role else value
        for name, value in table.items()
    }


def _absolute_value(value: object, folder: Path) -> object:
    """Return text or a path as an absolute path, and any other value unchanged."""
    # What can be the name of no file stays as it is, and is refused as no path.
    is_name = isinstance(value, (str, Path)) and str(value) and "\0" not in str(value)
    return folder / path_of(str(value)) if is_name else value


def _require_files(survey: Survey) -> None:
    for key, role, path in input_paths(survey):
        if role == "file" and not os.path.isfile(path):
            found = f"{path} is a folder, expected a file" if os.path.isdir(path) else f"there is no file {path}"
            table, _, name = key.partition(".")
            raise OptionError(f"[{table}] {name}: {found}", table, name)


def input_paths(survey: Survey) -> Iterator[tuple[str, PathRole, Path]]:
    """Yield every path that a survey reads: its dotted key, its kind of file or folder, and the absolute path.

    It must exist, it is hashed, and no result may overwrite it.
    """
    for dotted_key, role in ROLE_OF_PATH.items():
        table, _, name = dotted_key.partition(".")
        path = getattr(getattr(survey, table), name)
        if path is not None and role == "log":
            try:
                files = files_of_log(path)
            except InputError as error:
                raise OptionError(f"[{table}] {name}: {error}", table, name) from None
            yield from ((dotted_key, "log" if file.is_dir() else "file", file) for file in files)
        elif path is not None and role == "file_or_photos":
            yield dotted_key, "photos" if path.is_dir() else "file", path
        elif path is not None and role != "output":
            yield dotted_key, role, path


def input_hashes(survey: Survey) -> list[dict[str, Any]]:
    """Return path, SHA-256, number of bytes and what was hashed, for each input that exists.

    For a folder of photos, only names and sizes are hashed: reading gigabytes again would take too long.
    """
    entries: list[dict[str, Any]] = []
    for _, role, given in input_paths(survey):
        if role == "photos":
            entries += [_folder(given)] if given.is_dir() else []
        else:
            files = sorted(given.glob("*.bin" if role == "model" else "*")) or [given]
            entries += [
                {"path": str(path), "sha256": sha256_of(path), "bytes": path.stat().st_size, "hashed": "content"}
                for path in files
                if path.is_file()
            ]
    return entries


def _folder(path: Path) -> dict[str, Any]:
    files = (parent / name for parent, _, names in walk(path) for name in names)
    sizes = {file.relative_to(path).as_posix(): file.stat().st_size for file in files if file.is_file()}
    listing = "".join(f"{name}\t{size}\n" for name, size in sorted(sizes.items()))
    return {
        "path": str(path),
        "sha256": hashlib.sha256(listing.encode("utf-8", "surrogateescape")).hexdigest(),
        "bytes": sum(sizes.values()),
        "hashed": f"names and sizes of {len(sizes)} files",
    }
