"""Words in the names of columns, times and lengths, in several languages."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence


def _unit_by_word(words_by_unit: dict[str, str]) -> dict[str, str]:
    return {word: unit for unit, words in words_by_unit.items() for word in words.split()}


TIMES = _unit_by_word(
    {
        "s": "s sec secs second seconds",
        "ms": "ms msec msecs millis millisec milliseconds millisecond",
        "us": "us usec usecs micros microseconds",
        "ns": "ns nsec nsecs nanos nanoseconds",
        "min": "min mins minute minutes",
        "h": "h hr hrs hour hours",
        "d": "d day days datenum",
    }
)
LENGTHS = _unit_by_word(
    {
        "m": "m meter meters metre metres",
        "cm": "cm centimeter centimeters centimetre centimetres",
        "mm": "mm millimeter millimeters millimetre millimetres",
        "dm": "dm decimeter decimeters decimetre decimetres dezimeter",
        "km": "km kilometer kilometers kilometre kilometres",
        "ft": "ft foot feet fuß",
        "in": "in inch inches zoll pouce pouces pulgada pulgadas pollice pollici",
        "yd": "yd yard yards",
    }
)
"""Units of lengths, by the words for them."""


_NUMERO = re.compile(r"\b[Nn](?:[°º]|\.[ _](?=[^\W\d]))")  # N° de point, N. punto: a number, not the north


def words_of(name: str) -> list[str]:
    """Split a column's name into words in small letters; digits are separate words, a hexadecimal id is one word."""
    words: list[str] = []
    for part in re.findall(r"[^\W_]+", _NUMERO.sub(" no ", name)):
        is_id = re.fullmatch("(?:0[xX])?[0-9A-F]{4,16}", part) and not part.isdigit()
        pattern = r"\d+|[^\W\d][^\W\dA-Z]*|[A-Z]+"
        words += [part] if is_id else re.findall(rf"[A-Z]{{2,}}(?![^\W\dA-Z])|{pattern}", part)
    return [word.lower() for word in words]


def named_length_unit(name: str) -> str | None:
    """Return the unit of length in the words of a name, or None."""
    words = words_of(name)
    # "distance in m": anywhere but at the end, "in" is no inch.
    return named_unit([*(word for word in words[:-1] if word != "in"), *words[-1:]], LENGTHS)


def named_unit(words: Sequence[str], units: Mapping[str, str]) -> str | None:
    """Return the unit in the words of a name, the last one if there are several, or None."""
    return next((units[word] for word in reversed(words) if word in units), None)


Words = frozenset[str]


def _words(text: str) -> Words:
    return frozenset(text.split())


RANGE = _words("range ranges rng raz distance distances dist dists dis abstand entfernung distanz distancia 距离")
RANGE_IN_SHORT = _words("d r")
# Words in the names of columns that accompany the range and are not ranges.
NO_RANGE = _words(
    "gt true truth ground actual real ref reference expected est estimated error err bias std stddev stdev sigma var "
    "variance cov covariance rate dot vel velocity speed count quality rss rssi power snr offset x y z min max "
    "threshold id index idx rtt los nlos"
)
# Words in the names of columns of where and how the tag or an anchor is, as the radio or the phone computed it.
POSE = _words(
    "position positions pos location coordinate coordinates x y z lat lon latitude longitude orientation rotation "
    "quaternion quat euler eulerangle angle azimuth elevation heading yaw pitch roll accel acceleration acc gyro mag"
)
# Words in the names of processed ranges, which are used only if there is no other range.
SECOND_RANGE = _words("calib calibrated corr corrected filtered filter smoothed smooth mean avg average median last")
TIME = _words(
    "time times timestamp timestamps timestep stamp datetime epoch unix unixtime utime posix utc elapsed clock zeit "
    "zeitstempel uhrzeit aufnahmezeit heure horodatage temps hora tiempo 时间"
)
TIME_IN_SHORT = frozenset({"t", "ts", *TIMES} - {"d", "h"})
NANOSECONDS = _words("nsec nsecs nanosec nanosecs nanosecond nanoseconds")
NO_TIME = _words("flight of delta dt diff duration latency tx rx offset since zone out le")
SECOND_TIME = _words("device wearable sensor boot local received record rosbag bag")
LENGTH_UNIT = frozenset(LENGTHS)
ASKED = _words("ouid responder rspdr resp rsp receiver to dest dst destination target peer remote neighbor neighbour")
ASKING = _words("requester rqstr req sender initiator init from src source self")
ANCHOR = _words(
    "anchor anchors anc an beacon landmark station base basestation bs node anker ancla ancora ancre balise gateway "
    "基站"
)
TAG = _words("tag tags mobile robot rover user wearable 标签")
ANTENNA = _words("ant antenna")
ANY_ID = _words("id uid bssid nodeid identifier address addr mac device dev serial")
ID = ANY_ID | _words("ids tid name no num nr number numéro numero número núm nummer index idx short")
ROLES = {
    "antenna": ANTENNA,
    "anchor": ANCHOR,
    "tag": TAG,
    "asked": ASKED,
    "asking": ASKING,
    "any": ANY_ID,
}
IN_WIDE = RANGE | RANGE_IN_SHORT | ANCHOR | TAG | LENGTH_UNIT | ASKED | ASKING | SECOND_RANGE | {"a", "b", "t", "raw"}
PLAIN = _words("uwb field msg data header twr tof ranging meas measured measurement value vector arr array list")

# Words in the names of columns of lists: anchors with positions, and photos with times.
POINT = _words(
    "point points pointid pointnumber ptid ptno pt pts pnt p punkt punkte punktnummer punktnr punktname pktnr pkt "
    "label nom nombre nome naam bezeichnung matricule repère punto caposaldo estación punt puntnummer puntnr puntnaam"
)
COORDINATES = {
    "x": _words(
        "x posx xpos px tx e east easting eastings est este ost ostwert rechts rechtswert rw oost abscisse ascissa"
    ),
    "y": _words(
        "y posy ypos py ty n north northing northings nord norte nordwert hoch hochwert hw noord ordonnée ordinata"
    ),
    "z": _words(
        "z posz zpos pz tz h u up height hgt ht elevation elev alt altitude höhe hoehe hauteur cote cota quota altura "
        "kote altezza hoogte elevación altitud rl nap nn nhn über ü ortho orthometric ell ellipsoidal"
    ),
}
DEGREES = {
    "x": _words("lon long lng longitude längengrad laengengrad"),
    "y": _words("lat latitude breitengrad breite"),
}
BESIDE_COORDINATE = LENGTH_UNIT | _words(
    "coord coords coordinate coordinates koordinate coordonnée coordenada coordinata coördinaat pos position value "
    "wert local gps gnss rtk deg degree degrees grad"
)
# Words in the names of further coordinates of a point: estimated ones, and those of the base station.
ESTIMATED = _words("est estimated")
BASE = _words("base")
ELLIPSOIDAL = _words("ell ellipsoidal").union(*DEGREES.values())
# Words in the names of triples that are no positions: turns, velocities, accelerations, biases.
NO_POSITION = _words(
    "q quat quaternion orientation rotation rot v vel velocity twist linear angular a acc accel acceleration w omega "
    "gyro gyroscope b bias ba bg bw mag magnetometer error err"
)
# Words in the name of a column that is 0 where a receiver has no position.
QUALITY = _words("quality qual fix q qf")
BESIDE_QUALITY = _words("gps gnss position pos solution factor indicator")
LINKING = _words("de du des del di der van of the")
STDDEV = _words("stddev stdev std sigma sd rms uncertainty accuracy genauigkeit standardabweichung")
IN_PLANE = {"x": frozenset({"horizontal"}), "y": frozenset({"horizontal"}), "z": frozenset({"vertical"})}
"""Words in the names of standard deviations of several coordinates."""
BIAS = _words("bias offset")
PHOTO = _words(
    "image images img photo photos foto fotos picture pictures pic bild bilder bildname frame imagen imagename"
)
FILE = _words("file filename filenames name names path datei dateiname fichier nom source sourcefile archivo")
# Words of a name of photos without an ending, and those beside them.
NAMING_PHOTOS = (PHOTO, FILE | ID)
# Words in the names of columns of measured lengths, and of marks in photos.
FROM = _words("from von de desde da start begin anfang début debut inicio")
TO = _words("to nach bis à hasta end ende fin")
FIRST_AND_SECOND = (_words("1 a first erster premier"), _words("2 b second zweiter deuxième"))
LENGTH = RANGE | _words("length lengths länge laenge längen longueur strecke mass maß messung mesure d")
KIND = _words("kind role type use art")
REMARK = _words("remark remarks comment comments note notes bemerkung bemerkungen kommentar remarque commentaire")
MARK = _words("marker markers mark marks marke marken gcp target targets zielmarke passpunkt passpunkte repère cible")
PIXEL = _words("px pix pixel pixels image img bild coord coordinate koordinate pos position")
PIXEL_AXES = {"x": _words("x u col column spalte colonne"), "y": _words("y v row zeile ligne")}
# Words in the name of a file that is about anchors.
ABOUT_ANCHORS = _words("anchor anchors anker beacon beacons ancla anclas ancre ancres balise balises")
