"""A survey file with its values explained, as somebody would write it."""

from __future__ import annotations

import json
import os
import textwrap
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rangesfm.errors import InputError
from rangesfm.files.atomic import is_plain_name
from rangesfm.survey.settings import KEYS

NAME = "survey.toml"
# What most surveys want sooner or later stands there as a comment where nothing is known.
_OFFERED: Mapping[str, Any] = {
    "images.path": "images",
    "images.every_nth": 3,
    "ranges.path": "uwb.csv",
    "anchors.path": "anchors.csv",
    "tag.tag_in_cam_m": (0.0, 0.0, 0.0),
}
_BEGIN = """\
# What rangesfm init understood of these folders. Paths are relative to this file.
# rangesfm check looks at it all again, rangesfm run makes the map.
"""


def survey_text(values: Mapping[str, Any], folder: Path) -> str:
    """A whole file of values by dotted key; InputError for the name of a path that no such file can hold.

    Paths are absolute; those inside ``folder``, where the file will be, are written relative to it.
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
            raise InputError(f"the name '{inside}' is no printable UTF-8 text: rename it", folder)
        return json.dumps(Path(inside).as_posix(), ensure_ascii=False)
    if isinstance(value, (list, tuple)):
        return f"[{', '.join(_toml(item, folder) for item in value)}]"
    if isinstance(value, Mapping):
        return "{ " + ", ".join(f"{json.dumps(key)} = {_toml(item, folder)}" for key, item in value.items()) + " }"
    return json.dumps(value, ensure_ascii=False)
