"""Divide the photos of a survey into parts in the order of time, each of which is a survey of its own.

python split_survey.py SURVEY.toml NUM_PARTS FOLDER [BASE_FOLDER]

FOLDER/part_1 and so on get links to their photos, the times of these, and a survey file with all other settings of the
given one, whose paths are relative to its folder or to BASE_FOLDER. ``rangesfm batch FOLDER/*/survey.toml`` maps the
parts, on several machines if you like, and ``rangesfm join FOLDER/*/out`` makes one map of them by the ranges to the
anchors that they share.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np

import rangesfm
from rangesfm.sfm.image_times import ImageTimes, list_images
from rangesfm.survey.settings import ROLE_OF_PATH
from rangesfm.survey.survey_reader import parse_toml


def main() -> None:
    survey_path, num_parts, folder = Path(sys.argv[1]).resolve(), int(sys.argv[2]), Path(sys.argv[3])
    base_folder = Path(sys.argv[4]).resolve() if len(sys.argv) > 4 else survey_path.parent
    survey = rangesfm.read_survey(survey_path, base_folder=base_folder)
    photos, images = survey.photos_path, survey.images
    times = rangesfm.find_image_times(
        photos,
        list_images(photos),
        images.times,
        rate_hz=images.rate_hz,
        columns=images.times_columns,
        unit=images.times_unit,
    )
    keyframes = times.subset(rangesfm.select_keyframes(times, images))
    tables = with_absolute_paths(parse_toml(survey_path)[0], base_folder)
    tables |= {"images": {"path": "images", "times": "images.csv"}, "output": {"path": "out"}}
    for k, rows in enumerate(np.array_split(np.arange(len(keyframes)), num_parts), 1):
        write_part(folder / f"part_{k}", photos, keyframes.subset([keyframes.image_names[row] for row in rows]), tables)
        print(f"part_{k}: {len(rows)} photos")


def with_absolute_paths(tables: dict[str, Any], folder: Path) -> dict[str, Any]:
    """Return the tables of a survey file in this folder with absolute paths."""
    for dotted_key in ROLE_OF_PATH:
        table, _, name = dotted_key.partition(".")
        if isinstance(tables.get(table), dict) and name in tables[table]:
            tables[table][name] = str(folder / tables[table][name])
    return tables


def write_part(folder: Path, photos: Path, keyframes: ImageTimes, tables: dict[str, Any]) -> None:
    for name in keyframes.image_names:
        link = folder / "images" / name
        link.parent.mkdir(parents=True, exist_ok=True)
        link.symlink_to((photos / name).resolve())
    rows = [f"{name},{time_s!r}\n" for name, time_s in keyframes.by_name().items()]
    (folder / "images.csv").write_text("image_name,timestamp_s\n" + "".join(rows), encoding="utf-8")
    lines = [f"{name} = {in_toml(table)}\n" for name, table in tables.items()]
    (folder / "survey.toml").write_text("".join(lines), encoding="utf-8")


def in_toml(value: Any) -> str:
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{json.dumps(key)} = {in_toml(of_key)}" for key, of_key in value.items()) + " }"
    if isinstance(value, list):
        return "[" + ", ".join(map(in_toml, value)) + "]"
    return json.dumps(value)


if __name__ == "__main__":
    main()
