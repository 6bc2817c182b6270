"""Strict reading and writing of JSON, and records: JSON objects whose keys are the fields of a pydantic model."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Annotated, Any, TypeVar

from pydantic import BaseModel, BeforeValidator, ConfigDict, InstanceOf, Strict, ValidationError

from rangesfm.errors import InputError, one_line
from rangesfm.util.files.atomic import write_text
from rangesfm.util.files.text_tables import read_text

_Kind = TypeVar("_Kind", bound="Record")
_MAX_SHOWN = 60
# What was expected, for types of pydantic errors whose own message speaks of Python types.
_EXPECTED = {
    "dict_type": "a JSON object",
    "model_type": "a JSON object",
    "model_attributes_type": "a JSON object",
    "tuple_type": "a JSON array",
    "too_long": "{max_length} items",
    "is_instance_of": "text",
}


def read_json(path: Path) -> Any:
    """Read a JSON file.

    NaN and infinity, which are not JSON but which some programs write, become None.

    Raises:
        InputError: the file cannot be read or is not JSON; the error gives the line if it is known.
    """
    try:
        return json.loads(
            read_text(path), parse_constant=lambda constant: None, parse_float=_finite, parse_int=_integer
        )
    except json.JSONDecodeError as error:
        raise InputError(f"not JSON: {error.msg}", path, error.lineno) from None
    except RecursionError:
        raise InputError("not JSON that can be read: nested too deeply", path) from None
    except ValueError as error:  # a number that Python refuses
        raise InputError(f"not JSON: {error}", path) from None


def write_json(value: Any, path: Path) -> None:
    """Write plain values as a JSON file.

    Bytes of paths that are not UTF-8 become JSON escapes, so that reading gives the same path again.
    """
    write_text(json.dumps(value, indent=2, ensure_ascii=False, allow_nan=False) + "\n", path)


def _integer(text: str) -> int:
    _finite(text)  # an integer must be finite as a float, because it is calculated with as a float
    return int(text)


def _finite(text: str) -> float:
    value = float(text)
    if math.isinf(value):
        raise ValueError(f"{text[:20]}{'...' * (len(text) > 20)} is too large a number")
    return value


def _plain(value: Any) -> Any:
    """Return a numpy value as a plain Python value, and None for a float that is not finite and so is not JSON."""
    value = value.tolist() if hasattr(value, "tolist") else value
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _as_json(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _as_json(item) for key, item in value.items()}
    return [_as_json(item) for item in value] if isinstance(value, (list, tuple)) else _plain(value)


def _whole(value: Any) -> Any:
    value = _plain(value)
    return None if isinstance(value, (list, tuple)) and None in map(_plain, value) else value


Text = InstanceOf[str]  # pydantic's own ``str`` refuses paths that are not UTF-8
Flag = Annotated[bool, Strict(), BeforeValidator(_plain)]
Count = Annotated[int, Strict(), BeforeValidator(_plain)]
Number = Annotated[float, Strict(), BeforeValidator(_plain)]
NumberOrNull = Annotated[Annotated[float, Strict()] | None, BeforeValidator(_plain)]
"""Number that is null in JSON where it is not known or not finite."""
Vector = Annotated[tuple[Number, Number, Number], BeforeValidator(_plain)]
VectorOrNull = Annotated[tuple[Number, Number, Number] | None, BeforeValidator(_whole)]
IntervalOrNull = Annotated[tuple[Number, Number] | None, BeforeValidator(_whole)]


class Record(BaseModel):
    """A JSON object, made from keywords or from any object with attributes of these names.

    Reading ignores unknown keys, which a later version may have written. A field with a default is left out of the JSON
    if it was not set.
    """

    model_config = ConfigDict(frozen=True, from_attributes=True)

    def to_json(self) -> dict[str, Any]:
        """Return the plain values that are written as JSON, in the order of the fields."""
        values: dict[str, Any] = _as_json(self.model_dump(by_alias=True, exclude_unset=True))
        return values

    def write(self, path: Path) -> None:
        """Write the file, complete or not at all."""
        write_json(self.to_json(), path)

    @classmethod
    def read(cls: type[_Kind], path: Path) -> _Kind:
        """Read a file that ``write`` wrote.

        Raises:
            InputError: the file is not such a record; the message names the key.
        """
        content = read_json(path)
        if not isinstance(content, dict):
            raise InputError("expected a JSON object", path, 1)
        try:
            return cls.model_validate(content)
        except ValidationError as error:
            raise InputError(_what_is_wrong(error), path) from None


def _what_is_wrong(error: ValidationError) -> str:
    first = error.errors(include_url=False)[0]
    key = ".".join(map(str, first["loc"]))
    if first["type"] == "missing":
        return f"'{key}' is missing"
    ours = _EXPECTED.get(first["type"])
    expected = first["msg"] if ours is None else ours.format(**first.get("ctx", {}))
    for prefix in ("Input should be ", "Value error, "):
        expected = expected.removeprefix(prefix)
    found = one_line(json.dumps(first["input"]))
    return f"'{key}' is {found[:_MAX_SHOWN]}{'...' * (len(found) > _MAX_SHOWN)}, expected {expected}"
