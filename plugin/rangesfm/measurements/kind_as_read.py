"""Measurements of one kind as they were read from files, before there is a map in which they are located."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from rangesfm.arrays import Array
from rangesfm.util.files.clock_times import span_text
from rangesfm.util.geometry.trajectory import Trajectory

if TYPE_CHECKING:
    from typing_extensions import Self


@dataclass(frozen=True)
class TimedLog:
    """When the measurements of a log were taken, which has a clock of its own.

    Attributes:
        words: for the measurements. path: of the log, for messages.
        timestamp_s: (n,) times by its clock, in any order; n > 0.
        offset_s: image time minus time of the log, as given; None: it is searched for.
    """

    words: str
    path: Path | str | None
    timestamp_s: Array
    offset_s: float | None

    @property
    def image_times_s(self) -> Array:
        """(n,) times by the photos' clock, as far as it is known."""
        return self.timestamp_s + (self.offset_s or 0.0)

    @property
    def span(self) -> str:
        """First and last time by its own clock, for people."""
        return span_text(self.timestamp_s.min(), self.timestamp_s.max())

    def why_apart(self, photos_s: Array, max_difference_s: float) -> str | None:
        """Return what is to be said if the given offset leaves no time that log and photos share, else None.

        Args:
            photos_s: times of the photos. max_difference_s: between a photo and a measurement that is taken with it.
        """
        at_s, gap_s = self.image_times_s, 0.0
        if self.offset_s is not None:
            gap_s = max(at_s.min() - photos_s.max(), photos_s.min() - at_s.max())
        if gap_s <= max_difference_s:
            return None
        return (
            f"the log's times ({self.span}, plus an offset of {self.offset_s:g} s) do not overlap the photos' "
            f"({span_text(photos_s.min(), photos_s.max())}): give another time offset, or auto"
        )


class KindAsRead(ABC):
    """What a survey has of one kind. By default nothing is assumed or doubtful, and no photo needs a time for it."""

    @abstractmethod
    def facts(self) -> Iterator[str]:
        """Yield lines that say what is known, before any map is made; none if nothing was given."""

    @property
    def notes(self) -> tuple[str, ...]:
        """Lines for the user about how the files were read."""
        return ()

    @property
    def warnings(self) -> tuple[str, ...]:
        """Lines for the user about what is not as it should be in the files."""
        return ()

    @property
    def timed(self) -> TimedLog | None:
        """Its log, if it has a clock, so that the photos' times are needed; None without one."""
        return None

    def on_path(self, path: Trajectory) -> Self:
        """Return the same with what a path tells of it, such as the offset of its clock.

        Args:
            path: of the keyframes, in any unit.

        Raises:
            GeometryError: the path does not tell what is needed to use it.
        """
        del path
        return self

    @property
    def notes_on_path(self) -> tuple[str, ...]:
        """Lines for the user about what a path has told of it."""
        return ()

    @property
    def warnings_on_path(self) -> tuple[str, ...]:
        """Lines for the user about what is wrong with it on a path."""
        return ()
