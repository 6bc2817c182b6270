"""JSON, read strictly and written so."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

from rangesfm.errors import InputError
from rangesfm.files.atomic import write_text
from rangesfm.files.tables import read_text


def read_json(path: Path) -> Any:
    """The content of a JSON file; NaN and infinity, which some programs write and JSON does not know, become None.

    Raises:
        InputError: it is not there or no JSON, with the line where there is one.
    """
    try:
        return json.loads(read_text(path), parse_constant=lambda constant: None, parse_float=_finite, parse_int=_whole)
    except json.JSONDecodeError as error:
        raise InputError(f"not JSON: {error.msg}", path, error.lineno) from None
    except RecursionError:
        raise InputError("not JSON that can be read: nested too deeply", path) from None
    except ValueError as error:  # numbers that Python refuses
        raise InputError(f"not JSON: {error}", path) from None


def write_json(value: Any, path: Path) -> None:
    """Write plain values.

    Of paths that are no UTF-8, what is none becomes JSON's own escapes, by which they are read as they were.
    """
    write_text(json.dumps(value, indent=2, ensure_ascii=False, allow_nan=False) + "\n", path)


def _whole(text: str) -> int:
    _finite(text)  # whoever calculates with it takes a float
    return int(text)


def _finite(text: str) -> float:
    value = float(text)
    if math.isinf(value):
        raise ValueError(f"{text[:20]}{'...' * (len(text) > 20)} is too large a number")
    return value
