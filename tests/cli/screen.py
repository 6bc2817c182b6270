"""A simulated terminal that shows what a viewer would see, and a clock that tests set by hand."""

from __future__ import annotations

import io
import re


class Clock:
    now_s = 100.0

    def __call__(self) -> float:
        return self.now_s


class Terminal(io.StringIO):
    """A terminal that understands the control sequences of the progress display, and fails on any other."""

    def isatty(self) -> bool:
        return True

    def lines(self) -> list[str]:
        """Return the lines that are visible now, without blank lines at the end."""
        rows, row, column = [""], 0, 0
        for part in re.findall(r"\033\[[?\d]*[A-Za-z]|[\r\n]|[^\033\r\n]+", self.getvalue()):
            if part == "\r":
                column = 0
            elif part == "\n":
                row, column = row + 1, 0
                rows += [""] * (row == len(rows))
            elif part == "\033[2K":
                rows[row] = ""
            elif part == "\033[1A":
                row -= 1
            elif part not in ("\033[?25l", "\033[?25h"):
                assert not part.startswith("\033"), part
                rows[row] = rows[row][:column].ljust(column) + part + rows[row][column + len(part) :]
                column += len(part)
        while rows and not rows[-1].strip():
            rows.pop()
        return [line.rstrip() for line in rows]
