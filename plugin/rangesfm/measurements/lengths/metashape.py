"""Markers that were exported from Agisoft Metashape as XML: their pixels in photos, and their coordinates.

Metashape's pixels are COLMAP's: the centre of the first one is (0.5, 0.5).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from xml.parsers import expat

from rangesfm.errors import InputError
from rangesfm.measurements.lengths.tape import Mark
from rangesfm.options import COORDINATE_M, PIXEL
from rangesfm.util.files.contents import open_regular

_EXPECTED = "expected the markers of one chunk, as Metashape exports them"


@dataclass
class MetashapeMarkers:
    """Markers of one chunk.

    Attributes:
        seen: marks by name of the marker.
        places: reference coordinates, the standard deviation of each (None if there is none), whether they are enabled
            (Metashape's control points), and the line in the file, by name of the marker.
        system: text of the coordinate system (WKT).
    """

    seen: dict[str, list[Mark]] = field(default_factory=dict)
    places: dict[str, tuple[list[float], float | None, bool, int]] = field(default_factory=dict)
    system: str = ""


def is_metashape_file(head: str) -> bool:
    """Return whether a file with this beginning is Metashape's XML."""
    return head.lstrip("\ufeff \n").startswith("<?xml") and "<document" in head and "<chunk" in head


def read_metashape_markers(path: Path) -> MetashapeMarkers:
    """Read the markers of a file.

    Raises:
        InputError: it is no such file, or a value is no number; the error gives the line.
    """
    found, parser, inside = MetashapeMarkers(), expat.ParserCreate(), list[str]()
    photos, names = dict[str, str](), dict[str, str]()
    current, num_chunks = "", 0

    def start(tag: str, values: dict[str, str]) -> None:
        nonlocal current, num_chunks
        line = parser.CurrentLineNumber
        inside.append(tag)
        num_chunks += tag == "chunk"
        if num_chunks > 1:
            raise InputError(f"holds several chunks, {_EXPECTED}", path, line)
        if tag == "camera" and "label" in values:
            photos[values["id"]] = values["label"]
        elif tag == "marker":
            if "label" in values:
                names[values["id"]] = values["label"]
            current = names[values["marker_id"] if "marker_id" in values else values["id"]]
        elif tag == "reference" and inside[-2:-1] == ["marker"] and "x" in values:
            place = [float(values[axis]) for axis in "xyz"]
            if not all(map(COORDINATE_M.hold, place)):
                raise ValueError
            stddevs = [float(values[f"s{axis}"]) for axis in "xyz" if f"s{axis}" in values]
            is_enabled = values.get("enabled", "true").lower() in ("true", "1")
            found.places[current] = place, max(stddevs, default=None), is_enabled, line
        elif tag == "location" and inside[-2:-1] == ["marker"] and values["camera_id"] in photos:
            pixel = [float(values["x"]), float(values["y"])]
            if not all(map(PIXEL.hold, pixel)):
                raise ValueError
            found.seen.setdefault(current, []).append((photos[values["camera_id"]], pixel, line))

    def text(data: str) -> None:
        if inside[-2:] == ["chunk", "reference"]:
            found.system += data

    parser.StartElementHandler = start
    parser.EndElementHandler = lambda _: inside.pop()
    parser.CharacterDataHandler = text
    try:
        with open_regular(path) as file:
            parser.ParseFile(file)
    except (KeyError, ValueError):
        raise InputError(f"a value is missing or no number, {_EXPECTED}", path, parser.CurrentLineNumber) from None
    except expat.ExpatError as error:
        raise InputError(f"no whole XML file, {_EXPECTED}", path, error.lineno) from None
    except OSError as error:
        raise InputError(f"cannot be read: {error.strerror}", path) from error
    return found
