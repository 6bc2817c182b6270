"""How people are told of a kind of measurement, without its equations: a report and a plan load no more of it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass


@dataclass(frozen=True)
class KindWords:
    """Words for a kind of measurement.

    Attributes:
        kind: its name in ``result.json``. words: what it is. verb: after these words.
        errors: what the components of its errors are, by their names there: regular expressions, whose groups stand in
            the words.
    """

    kind: str
    words: str
    errors: Mapping[str, str]
    verb: str = "are"

    def not_used(self, why: object) -> str:
        """Return the line that says that they are not used, and why."""
        return f"the {self.words} {self.verb} not used: {why}"
