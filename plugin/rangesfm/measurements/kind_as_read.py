"""Measurements of one kind as they were read from files, before there is a map in which they are located."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator
from typing import TYPE_CHECKING

from rangesfm.util.geometry.trajectory import Trajectory

if TYPE_CHECKING:
    from typing_extensions import Self


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
    def needs_times(self) -> bool:
        """True if the photos' times are needed."""
        return False

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
