"""DWM1001, MDEK1001, LEAPS and PANS PRO: the lines that the shell commands ``lec``, ``les`` and their like print.

LEAPS and PANS PRO print a quality in percent after each anchor's position.
"""

from __future__ import annotations

from rangesfm.ranging.readers.printed import printed_reader

# Always two decimals: a number with fewer was cut off.
_NUMBER = r"-?\d{1,6}\.\d\d(?![\d.])"
_XYZ = rf"(?P<x>{_NUMBER}),(?P<y>{_NUMBER}),(?P<z>{_NUMBER})"
_RANGE = rf"(?P<range>{_NUMBER})"
_QUALITY = r"\d{1,3}"
_ANCHOR = r"(?P<anchor_id>[0-9A-F]{4})"
_ALONE = r"(?<![0-9A-Za-z])"

LEC = printed_reader(
    "dwm1001_lec",
    "DWM1001 shell, lec: DIST,4,AN0,022E,7.94,8.03,0.00,3.44,..",
    begin=rf"(?:DIST,\d{{1,2}},)?{_ALONE}AN\d{{1,2}},[0-9A-F]{{4}},",
    each=r"AN\d{1,2},",
    whole=rf"AN\d{{1,2}},{_ANCHOR},{_XYZ},{_RANGE}",
)
LES = printed_reader(
    "dwm1001_les",
    "DWM1001 shell, les: 022E[7.94,8.03,0.00]=3.38 ..",
    begin=rf"{_ALONE}[0-9A-F]{{4}}\[-?\d{{1,6}}\.\d\d,",
    each=rf"{_ALONE}[0-9A-F]{{4}}\[",
    whole=rf"{_ALONE}{_ANCHOR}\[{_XYZ}\]={_RANGE}",
)
MEAS = printed_reader(
    "leaps_meas",
    "LEAPS or PANS PRO: POS,..,MEAS,4,AN0,8EAA,5.14,-2.16,0.00,100,1.41,..",
    begin=r"(?:POS,[-\d.,]{0,60})?MEAS,\d{1,2},AN\d",
    each=r"AN\d{1,2},",
    whole=rf"AN\d{{1,2}},{_ANCHOR},{_XYZ},{_QUALITY},{_RANGE}",
)
LEA = printed_reader(
    "leaps_lea",
    "LEAPS, lea: 8EAA[5.14,-2.16,0.00,100]=1.41 ..",
    begin=rf"(?:POS\[[-\d.,]{{0,60}}\]\s*)?{_ALONE}[0-9A-F]{{4}}\[{_XYZ},{_QUALITY}\]",
    each=rf"{_ALONE}[0-9A-F]{{4}}\[",
    whole=rf"{_ALONE}{_ANCHOR}\[{_XYZ},{_QUALITY}\]={_RANGE}",
)
