"""Inputs of solvers of factor graphs, in which a line's first word says what it holds: libRSF and PyFactorGraph."""

from __future__ import annotations

from rangesfm.ranging.readers.printed import printed_reader

_NUMBER = r"-?\d{1,19}(?:\.\d{0,20})?(?:[eE][-+]?\d{1,3})?"
_TIME_AND = rf"(?P<time>{_NUMBER}) "
_RANGE_AND_VARIANCE = rf"(?P<range>{_NUMBER}) (?P<variance>{_NUMBER})"

LIBRSF = printed_reader(
    "librsf",
    "libRSF: range2 TIME RANGE VARIANCE X Y ID SNR, or range3",
    begin=rf"^range[23] {_NUMBER} ",
    each=r"^range[23] ",
    whole=(
        rf"^range[23] {_TIME_AND}{_RANGE_AND_VARIANCE} (?P<x>{_NUMBER}) (?P<y>{_NUMBER}) "
        rf"(?:(?P<z>{_NUMBER}) )?(?P<anchor_id>\w{{1,16}}) {_NUMBER}\s*$"
    ),
)
# A12 is where the robot A was at its twelfth pose; L3 is a landmark, and has no other name.
_ROBOT_OR_LANDMARK = r"L\d{1,9}|[A-KM-Za-z](?=\d{1,9} )"
PYFG = printed_reader(
    "pyfg",
    "PyFactorGraph: EDGE_RANGE TIME POSE LANDMARK RANGE VARIANCE",
    begin=rf"^(?:EDGE_RANGE|VERTEX_SE2|VERTEX_SE3:QUAT) {_NUMBER} [A-Za-z]",
    each=r"^EDGE_RANGE ",
    whole=(
        rf"^EDGE_RANGE {_TIME_AND}(?P<tag_id>[A-KM-Za-z])\d{{1,9}} (?P<anchor_id>{_ROBOT_OR_LANDMARK})\d{{0,9}} "
        rf"{_RANGE_AND_VARIANCE}\s*$"
    ),
)
