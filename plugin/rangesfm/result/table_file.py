"""TableFile: a CSV file of the result folder whose columns are the fields of a class."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Iterable
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated, Any, ClassVar, NamedTuple, TypeVar, get_type_hints

import numpy as np

from rangesfm.arrays import Array
from rangesfm.files.tables import Table, read_table, write_table
from rangesfm.result.metric_result import MetricResult

_Kind = TypeVar("_Kind", bound="TableFile")
_TEXT = "s"


class Column(NamedTuple):
    """How a column is written, and whether its cells may be empty (of numbers: NaN).

    Attributes:
        format_spec: as ".6g"; of text "s"; empty: so that the numbers are read as they were.
    """

    format_spec: str
    may_be_empty: bool = False


Texts = Annotated[tuple[str, ...], Column(_TEXT)]
TextsOrEmpty = Annotated[tuple[str, ...], Column(_TEXT, may_be_empty=True)]
Numbers = Annotated[Array, Column("")]
NumbersOrEmpty = Annotated[Array, Column("", may_be_empty=True)]
Rounded = Annotated[Array, Column(".6g")]
RoundedOrEmpty = Annotated[Array, Column(".6g", may_be_empty=True)]


@dataclass(frozen=True)
class TableFile(ABC):
    """n rows; each field is a column (``Texts``, ``Numbers``, ...), in the order and by the names of the file."""

    NAME: ClassVar[str]

    @classmethod
    @abstractmethod
    def of(cls: type[_Kind], found: MetricResult) -> _Kind | None:
        """What a run found, for this file; None: the run does not leave it."""

    @classmethod
    def columns(cls) -> dict[str, Column]:
        """By name, in their order."""
        hints = get_type_hints(cls, include_extras=True)
        return {field.name: hints[field.name].__metadata__[0] for field in fields(cls)}

    def write(self, folder: Path) -> None:
        """Write the file into a folder, whole or not at all."""
        columns = self.columns()
        cells = [_cells(getattr(self, name), column.format_spec) for name, column in columns.items()]
        write_table(folder / self.NAME, list(columns), zip(*cells, strict=True))

    @classmethod
    def read(cls: type[_Kind], folder: Path) -> _Kind | None:
        """Read the file of a folder; None if it is not there.

        Raises:
            InputError: it is not what a run writes; with the line.
        """
        path, columns = folder / cls.NAME, cls.columns()
        if not path.is_file():
            return None
        texts = [name for name, column in columns.items() if column.format_spec == _TEXT]
        table = read_table(path, list(columns), text=texts)
        return cls(**{name: _values(table, name, column) for name, column in columns.items()})


def _cells(values: Any, format_spec: str) -> Iterable[str]:
    if format_spec == _TEXT:
        return tuple(values)
    return (f"{value:{format_spec}}" if math.isfinite(value) else "" for value in values.tolist())


def _values(table: Table, name: str, column: Column) -> Any:
    if column.format_spec == _TEXT:
        return tuple(table.text(name, empty="" if column.may_be_empty else None))
    return table.numbers(name, empty=np.nan if column.may_be_empty else None)
