"""Tables of text, as commands print them."""

from __future__ import annotations

import io
from collections.abc import Iterable, Sequence


def align_rows(rows: Iterable[Sequence[str]], *, num_left: int = 1) -> str:
    """One line a row; columns as wide as their longest cell on a terminal, whatever alphabet it is written in.

    Args:
        rows: all of equal length; cells stand there as they are, whatever looks like markup.
        num_left: so many columns begin at their left edge, the others end at their right.
    """
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    table = Table.grid(padding=(0, 2, 0, 0))
    for row in rows:
        while len(table.columns) < len(row):
            table.add_column(justify="left" if len(table.columns) < num_left else "right", no_wrap=True)
        table.add_row(*map(Text, row))
    lines = io.StringIO()
    Console(file=lines, width=1 << 20).print(table)  # nothing is cut
    return "\n".join(line.rstrip() for line in lines.getvalue()[:-1].split("\n"))
