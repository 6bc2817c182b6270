"""Which columns of a table hold what an inertial sensor measured: three axes of a gyroscope or of an accelerometer."""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Iterator, Sequence
from typing import NamedTuple

from rangesfm.measurements.ranges.readers.vocabulary import words_of

GYRO, ACCEL, GRAVITY = "gyroscope", "accelerometer", "gravity"


def _words(text: str) -> frozenset[str]:
    return frozenset(text.split())


_OF_SENSOR = {
    GRAVITY: _words("gravity grav schwerkraft gravité gravedad gravità"),
    GYRO: _words(
        "gyro gyroscope gyr angular omega w rotation rate gy gyroskop kreisel drehrate drehraten "
        "winkelgeschwindigkeit angulaire giroscopio giróscopo angolare"
    ),
    ACCEL: _words(
        "accel accelerometer acc acceleration a alpha force gf f beschleunigung beschleunigungen beschleunigungssensor "
        "accélération accéléromètre aceleración acelerómetro accelerazione accelerometro"
    ),
}
# Without gravity, as phones compute it. ROS calls the whole acceleration linear, and its length tells them apart.
_REST = _words("linear lin user lineare linéaire lineal")
_UNCALIBRATED = _words("uncalibrated uncal raw")
_NO_SIGNAL = _words(
    "magnetometer magnetic magneto mag compass orientation quaternion attitude euler bias var variance cov covariance "
    "std stddev sigma b roll pitch yaw position temperature temp t p"
)
_AXIS_IN_BRACKETS = re.compile(r"\(([xyz])\)", re.IGNORECASE)  # "Accelerometer (x) [m/s2]", as of GoPro's tracks
_IN_BRACKETS = re.compile(r"[\[(]([^\])]*)[\])]")
_AXIS_AT_END = re.compile(r"([a-z]{0,14})([xyz])")
_DEGREES = re.compile(r"deg|dps|\u00b0", re.IGNORECASE)
_RADIANS = re.compile(r"rad", re.IGNORECASE)
_METRES = re.compile(r"m[ /_]*s|mps", re.IGNORECASE)
_IN_G = _words("g gs mg mgs")
_MILLI = re.compile(r"milli|\bm(?=dps|deg|rad|gs?\b)", re.IGNORECASE)


class Triple(NamedTuple):
    """Three columns with the x, y and z of one signal.

    Attributes:
        kind: GYRO, ACCEL or GRAVITY; "" if the names do not say it.
        columns: their names.
        unit: "deg", "rad", "g" or "m" (m/s^2) as the names say, with another "m" in front for a thousandth of the first
            three; "" if they do not.
        rank: smaller for the better one of two of a kind.
    """

    kind: str
    columns: tuple[str, str, str]
    unit: str
    rank: int


def find_triples(names: Sequence[str]) -> Iterator[Triple]:
    """Yield the signals of three axes among columns, by their names."""
    groups: dict[tuple[str, ...], dict[str, str]] = defaultdict(dict)
    for name in names:
        words, units = _split(name)
        for k, word in reversed([*enumerate(words)]):
            found = _AXIS_AT_END.fullmatch(word)
            if found and (not found[1] or k == len(words) - 1 or len(found[1]) <= 2):
                rest = (*words[:k], *([found[1]] if found[1] else []), *words[k + 1 :])
                groups[(*rest, "|", *units)].setdefault(found[2], name)
                break
    for key, columns in groups.items():
        if len(columns) == 3:
            middle = key.index("|")
            triple = _triple(key[:middle], " ".join(key[middle + 1 :]), (columns["x"], columns["y"], columns["z"]))
            if triple is not None:
                yield triple


def _split(name: str) -> tuple[list[str], list[str]]:
    """Return the words of a name, and those in brackets, which are its unit."""
    name = _AXIS_IN_BRACKETS.sub(r" \1 ", name)
    return words_of(_IN_BRACKETS.sub(" ", name)), [part.lower() for part in _IN_BRACKETS.findall(name)]


def _triple(words: Sequence[str], unit: str, columns: tuple[str, str, str]) -> Triple | None:
    """Return the signal whose names have these words and this unit in brackets; None if it is something else."""
    said = {*words}
    if said & _NO_SIGNAL:
        return None
    kind = next((kind for kind, known in _OF_SENSOR.items() if said & known), "")
    # g is what the gyroscope measures (gx beside ax) or the unit, as in gFx and accel_x_g.
    kind = kind or (GYRO if said <= {"g"} and said else "")
    text = f"{unit} {' '.join(words)}"
    if kind == GYRO:
        given = "deg" if _DEGREES.search(text) else "rad" if _RADIANS.search(text) else ""
    else:
        in_g = said & (_IN_G | {"gf"}) or {*unit.replace("-", " ").split()} & _IN_G
        given = "m" if _METRES.search(text) else "g" if in_g else ""
    if given in ("deg", "rad", "g") and _MILLI.search(text):
        given = f"m{given}"
    return Triple(kind, columns, given, 2 * bool(said & _REST) + bool(said & _UNCALIBRATED))


def kind_of_file(stem: str) -> str | None:
    """Return the signal that a file holds by its name, such as Gyroscope.csv; None if its name does not say it."""
    said = {*words_of(stem)}
    return None if said & _NO_SIGNAL else next((kind for kind, known in _OF_SENSOR.items() if said & known), None)


def rank_of_file(stem: str) -> int:
    """Return the rank of a file's signal as that of ``Triple``."""
    said = {*words_of(stem)}
    return 2 * bool(said & _REST) + bool(said & _UNCALIBRATED)
