"""Writing of a survey file in which each value is explained by a comment."""

from __future__ import annotations

import json
import os
import textwrap
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rangesfm.errors import InputError
from rangesfm.survey.settings import KEYS
from rangesfm.util.files.atomic import is_plain_name

# Keys that most surveys need at some time. Where no value is known, they are written as comments with these examples.
_OFFERED: Mapping[str, Any] = {
    "images.path": "images",
    "images.every_nth": 3,
    "ranges.path": "uwb.csv",
    "anchors.path": "anchors.csv",
    "tag.tag_in_cam_m": (0.0, 0.0, 0.0),
}
_BEGIN = """\
# Made by rangesfm init from the files in these folders. Paths are relative to this file.
# rangesfm check reads everything again and says what is wrong; rangesfm run makes the map.
"""


def survey_text(values: Mapping[str, Any], folder: Path) -> str:
    """Return the text of a survey file.

    Args:
        values: by dotted key; paths are absolute.
        folder: in which the file will be. Paths inside it are written relative to it.

    Raises:
        InputError: the name of a path is not printable text.
    """
    lines, table = [_BEGIN], ""
    for item in KEYS:
        if item.dotted not in {*values, *_OFFERED} or (item.name == "tag_in_cam_m" and "tag.lever_arms_m" in values):
            continue
        if item.table != table:
            lines += ["", f"[{item.table}]"] if table else [f"[{item.table}]"]
            table = item.table
        lines += textwrap.wrap(f"{item.meaning}.", 100, initial_indent="# ", subsequent_indent="# ")
        is_known = item.dotted in values
        value = values[item.dotted] if is_known else _OFFERED[item.dotted]
        lines.append(f"{'' if is_known else '# '}{item.name} = {_toml(value, folder)}")
    return "\n".join(lines) + "\n"


def _toml(value: Any, folder: Path) -> str:
    if isinstance(value, Path):
        inside = os.path.relpath(value, folder) if value.is_relative_to(folder) else str(value)
        if not is_plain_name(inside):
            raise InputError(f"the name '{inside}' is not printable UTF-8 text: rename it", folder)
        return json.dumps(Path(inside).as_posix(), ensure_ascii=False)
    if isinstance(value, (list, tuple)):
        return f"[{', '.join(_toml(item, folder) for item in value)}]"
    if isinstance(value, Mapping):
        return "{ " + ", ".join(f"{json.dumps(key)} = {_toml(item, folder)}" for key, item in value.items()) + " }"
    return json.dumps(value, ensure_ascii=False)
