"""Base class of the tables of options: their keys are checked, and each carries its own explanation."""

from __future__ import annotations

import types
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import (
    TYPE_CHECKING,
    Annotated,
    Any,
    ClassVar,
    Literal,
    TypeVar,
    Union,
    get_args,
    get_origin,
    get_type_hints,
    overload,
)

from pydantic import BaseModel, ConfigDict, ValidationError
from pydantic.fields import FieldInfo

from rangesfm.errors import OptionError, nearest_known, printable, shown

if TYPE_CHECKING:
    from rangesfm.arrays import Array, Mask

Same = TypeVar("Same", bound="Options")
PathRole = Literal["file", "file_or_photos", "log", "photos", "model", "output"]
_NAMES = {bool: "true or false", int: "a whole number", float: "a number", str: "text", Path: "a path", dict: "a table"}
_TABLE_OF = "a table in which each value is "
_UNITS = {
    "deg_per_s": "degrees a second",
    "m_per_s": "metres a second",
    "m": "metres",
    "s": "seconds",
    "deg": "degrees",
}


@dataclass(frozen=True)
class Bounds:
    """The numbers that a quantity may have, wherever it is read.

    Beyond them only a slip is meant, as another unit; and squares and quotients of what is inside are finite.

    Attributes:
        least, most: both may be reached.
        or_zero: whether it may be 0 as well, as the standard deviation of what is exact.
        unit: in words.
    """

    least: float
    most: float
    unit: str
    or_zero: bool = False

    @overload
    def hold(self, values: float) -> bool: ...

    @overload
    def hold(self, values: Array) -> Mask: ...

    def hold(self, values: Any) -> Any:
        """Return for each of some numbers, or for one, whether it is within the bounds."""
        return (self.least <= values) & (values <= self.most) | (self.or_zero & (values == 0))

    def __str__(self) -> str:
        zero = "0, or " if self.or_zero else ""
        return f"{zero}a number of {self.unit} from {self.least:.10g} to {self.most:.10g}"


@dataclass(frozen=True, kw_only=True)
class Key:
    """A key of a survey file. The annotation of its field says what its name, type and docstring do not.

    ``Options.keys`` fills in all the rest.

    Attributes:
        flag: name of the flag on the command line, without dashes; if the annotation has none, that of the key.
        metavar: placeholder for the value in the help text; empty: by the type.
        expected: description of valid values, for messages; if the annotation has none, made from type and bounds.
        role: of a path, what kind of file or folder it leads to.
        is_key: whether users may write it into the survey file.
        is_common: whether most people need it, so that the short help of a command has its flag.
        metres: in words, what gives a map its metres where the key has a value; empty if nothing does.
        table, name: its place.
        type: of the value, without the None that means "not given".
        meaning: the docstring on one line without its full stop, followed by the default.
    """

    flag: str = ""
    metavar: str = ""
    expected: str = ""
    role: PathRole | None = None
    is_key: bool = True
    is_common: bool = False
    metres: str = ""
    table: str = ""
    name: str = ""
    type: Any = Any
    meaning: str = ""

    @property
    def dotted(self) -> str:
        return f"{self.table}.{self.name}"


class Options(BaseModel):
    """A table of options, or a part of one. Its values are checked when it is made, and cannot be changed.

    A key that is None has its default. A derived class gives the table's name in a survey file: ``class
    ScaleOptions(Options, table="scale")``. The docstring under each field is the explanation that users read in the
    help, on the page of keys and in new survey files.

    Raises:
        OptionError: an unknown key (the text names the nearest known one), or a value of the wrong type or out of
            bounds.
    """

    model_config = ConfigDict(
        frozen=True, extra="forbid", strict=True, allow_inf_nan=False, use_attribute_docstrings=True
    )

    table: ClassVar[str]

    def __init_subclass__(cls, *, table: str = "", **config: Any):
        super().__init_subclass__(**config)
        if table:
            cls.table = table

    def __init__(self, /, **values: Any):
        values = {name: value for name, value in values.items() if value is not None}  # None: it is not given
        try:
            super().__init__(**values)
        except ValidationError as error:
            raise self._error(error.errors()[0]["loc"], values) from None

    def changed(self: Same, **values: Any) -> Same:
        """Return a copy with other values of some keys; they are checked, too."""
        given = {name: getattr(self, name) for name in self.model_fields_set}
        return type(self)(**{**given, **values})

    def refused(self, key: str, why: str) -> OptionError:
        """Return the error about a key. ``why`` says what the key is and what was expected."""
        return OptionError(f"[{self.table}] {key} {why}", self.table, key)

    @classmethod
    @cache
    def keys(cls) -> Mapping[str, Key]:
        """Return all keys of this table by name, those that it shares with other tables last."""
        bare, hints = get_type_hints(cls), get_type_hints(cls, include_extras=True)
        keys, order = {}, [*cls.__annotations__, *cls.model_fields]
        for name, field in sorted(cls.model_fields.items(), key=lambda item: order.index(item[0])):
            meta = next((item for item in field.metadata if isinstance(item, Key)), Key())
            if not meta.is_key:
                continue
            unit = next((unit for end, unit in _UNITS.items() if name.endswith(f"_{end}")), "")
            type_ = bare[name]
            if get_origin(type_) in (Union, types.UnionType):
                type_ = Union[tuple(arg for arg in get_args(type_) if arg is not types.NoneType)]  # noqa: UP007
            meaning = " ".join((field.description or "").split()).removesuffix(".")
            default = field.get_default(call_default_factory=True)
            if default not in (None, "", (), {}):
                parts = default if isinstance(default, tuple) else (default,)
                words = (f"{part:g}" if isinstance(part, float) else str(part).lower() for part in parts)
                meaning += f" (default: {','.join(words)})"
            flag, expected = meta.flag or name, meta.expected or _described(hints[name], unit)
            told = replace(meta, flag=flag, expected=expected, type=type_, meaning=meaning)
            keys[name] = replace(told, table=cls.table, name=name)
        return keys

    @classmethod
    def _error(cls, where: tuple[int | str, ...], values: Mapping[str, Any]) -> OptionError:
        name = str(where[0])
        keys = cls.keys()
        if name not in keys:
            message = (
                f"unknown key {shown(name)} in [{cls.table}]; the nearest known one is '{nearest_known(name, keys)}'"
            )
            return OptionError(message, cls.table, name)
        value, expected = values[name], keys[name].expected
        if len(where) > 1 and isinstance(value, Mapping) and where[1] in value:
            name, value, expected = f"{name}.{where[1]}", value[where[1]], expected.removeprefix(_TABLE_OF)
        return OptionError(f"[{cls.table}] {printable(name)} is {shown(value)}, expected {expected}", cls.table, name)


def _described(hint: Any, unit: str) -> str:
    """Return a description of the values that a type allows, with bounds and unit: "a number of metres from 0 to 1"."""
    origin, args = get_origin(hint), get_args(hint)
    if origin is Annotated:
        constraints = [item for info in args[1:] if isinstance(info, FieldInfo) for item in info.metadata]
        bounds = {name: getattr(item, name) for item in constraints for name in ("ge", "le") if hasattr(item, name)}
        if not bounds:
            return _described(args[0], unit)
        low, high = (f"{bounds[name]:.10g}" for name in ("ge", "le"))
        return low if low == high else f"{_described(args[0], unit)} from {low} to {high}"
    if origin in (Union, types.UnionType):
        return ", or ".join(_described(arg, unit) for arg in args if arg is not types.NoneType)
    if origin is Literal:
        return "one of " + ", ".join(map(str, args))
    if origin is tuple:
        item = _described(args[0], unit).removeprefix("a ").replace("number", "numbers", 1).replace("text", "texts", 1)
        return f"a list of {item}" if args[-1] is Ellipsis else f"a list of {len(args)} {item}"
    if origin is dict and args[1] is not Any:
        return f"{_TABLE_OF}{_described(args[1], unit)}"
    return _NAMES[origin or hint] + (f" of {unit}" if unit and hint in (int, float) else "")
