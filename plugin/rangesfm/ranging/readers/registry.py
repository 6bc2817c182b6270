"""All log formats. A new one is a file beside this and a name in the tuple below."""

from __future__ import annotations

from rangesfm.ranging.readers import canonical, dwm1001, factor_graphs, makerfabs, mauwb, qorvo, ros, table
from rangesfm.ranging.readers.reader import Reader

READERS: tuple[Reader, ...] = (
    ros.READER,
    canonical.READER,
    *table.PRESETS,
    table.MAPPED,
    table.TABLE,
    factor_graphs.LIBRSF,
    factor_graphs.PYFG,
    dwm1001.MEAS,
    dwm1001.LEA,
    dwm1001.LEC,
    dwm1001.LES,
    qorvo.READER,
    mauwb.READER,
    makerfabs.TEXT,
    makerfabs.JSON,
)


def reader_names() -> tuple[str, ...]:
    return tuple(reader.name for reader in READERS)


def find_reader(name: str) -> Reader | None:
    """The reader of that name."""
    return next((reader for reader in READERS if reader.name == name), None)


def recognize(head: str) -> Reader | None:
    """The first reader that knows the beginning of a file as its own."""
    return next((reader for reader in READERS if reader.recognizes(head)), None)
