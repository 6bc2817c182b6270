"""What ``result.json`` has of one kind of measurement, and how people are shown it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import ClassVar

from rangesfm.arrays import Array
from rangesfm.util.files.records import Record


class KindEntry(Record):
    """The entry of one kind of measurement. By default people are shown nothing of it."""

    caption: ClassVar[str] = ""
    """Caption of its table in the report."""
    meanings: ClassVar[Mapping[str, str]] = {}
    """What the numbers in that table are, by their keys in the entry; empty: there is no table."""
    section: ClassVar[str] = "others"
    """The section of the report in which the table is (``report_page``)."""

    def lines(self) -> Iterator[str]:
        """Yield the lines that the user sees at the end of a run."""
        yield from ()

    @property
    def fact(self) -> str:
        """A sentence in the answer of the report to what was done; empty without one."""
        return ""

    @property
    def up(self) -> tuple[Array, float] | None:
        """The upward unit vector (3,) in the metric models and its standard deviation (radians); None if unknown."""
        return None
