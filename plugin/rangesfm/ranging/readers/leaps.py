"""LEAPS and PANS PRO: as the DWM1001 prints, with a quality in percent after each anchor's position."""

from __future__ import annotations

import re

from rangesfm.ranging.readers.dwm1001 import NUMBER, XYZ
from rangesfm.ranging.readers.printed import Phrases, printed_reader

_QUALITY = r"\d{1,3}"
_MEAS = rf"AN\d{{1,2}},(?P<anchor_id>[0-9A-F]{{4}}),{XYZ},{_QUALITY},(?P<range>{NUMBER})"
_LEA = rf"(?<![0-9A-Za-z])(?P<anchor_id>[0-9A-F]{{4}})\[{XYZ},{_QUALITY}\]=(?P<range>{NUMBER})"

MEAS = printed_reader(
    "leaps_meas",
    "LEAPS or PANS PRO: POS,..,MEAS,4,AN0,8EAA,5.14,-2.16,0.00,100,1.41,..",
    Phrases(
        begin=re.compile(r"(?:POS,[-\d.,]{0,60})?MEAS,\d{1,2},AN\d", re.ASCII),
        each=re.compile(r"AN\d{1,2},", re.ASCII),
        whole=re.compile(_MEAS, re.ASCII),
    ),
)
LEA = printed_reader(
    "leaps_lea",
    "LEAPS, lea: 8EAA[5.14,-2.16,0.00,100]=1.41 ..",
    Phrases(
        begin=re.compile(rf"(?:POS\[[-\d.,]{{0,60}}\]\s*)?(?<![0-9A-Za-z])[0-9A-F]{{4}}\[{XYZ},{_QUALITY}\]", re.ASCII),
        each=re.compile(r"(?<![0-9A-Za-z])[0-9A-F]{4}\[", re.ASCII),
        whole=re.compile(_LEA, re.ASCII),
    ),
)
