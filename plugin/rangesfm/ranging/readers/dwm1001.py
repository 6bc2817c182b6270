"""DWM1001 and MDEK1001: the lines that the shell commands ``lec`` and ``les`` print."""

from __future__ import annotations

import re

from rangesfm.ranging.readers.printed import Phrases, printed_reader

# Always two decimals: a number with fewer was cut off.
NUMBER = r"-?\d{1,6}\.\d\d(?![\d.])"
XYZ = rf"(?P<x>{NUMBER}),(?P<y>{NUMBER}),(?P<z>{NUMBER})"
_LEC = rf"AN\d{{1,2}},(?P<anchor_id>[0-9A-F]{{4}}),{XYZ},(?P<range>{NUMBER})"
_LES = rf"(?<![0-9A-Za-z])(?P<anchor_id>[0-9A-F]{{4}})\[{XYZ}\]=(?P<range>{NUMBER})"

LEC = printed_reader(
    "dwm1001_lec",
    "DWM1001 shell, lec: DIST,4,AN0,022E,7.94,8.03,0.00,3.44,..",
    Phrases(
        begin=re.compile(r"(?:DIST,\d{1,2},)?(?<![0-9A-Za-z])AN\d{1,2},[0-9A-F]{4},", re.ASCII),
        each=re.compile(r"AN\d{1,2},", re.ASCII),
        whole=re.compile(_LEC, re.ASCII),
    ),
)
LES = printed_reader(
    "dwm1001_les",
    "DWM1001 shell, les: 022E[7.94,8.03,0.00]=3.38 ..",
    Phrases(
        begin=re.compile(r"(?<![0-9A-Za-z])[0-9A-F]{4}\[-?\d{1,6}\.\d\d,", re.ASCII),
        each=re.compile(r"(?<![0-9A-Za-z])[0-9A-F]{4}\[", re.ASCII),
        whole=re.compile(_LES, re.ASCII),
    ),
)
