"""Arduino sketches for the DW1000, as Makerfabs ships them: text lines and JSON links."""

from __future__ import annotations

from rangesfm.ranging.readers.printed import printed_reader

TEXT = printed_reader(
    "arduino",
    "Arduino DW1000 sketch: from: D325 Range: 29.40 m ..",
    begin=r"from:\s{0,9}[0-9A-Fa-f]{1,16}\s{1,9}Range:",
    each=r"from:",
    whole=r"from:\s{0,9}(?P<anchor_id>[0-9A-Fa-f]{1,16})\s{1,9}Range:\s{0,9}(?P<range>-?\d{1,6}\.\d{1,4}) ?m\b",
)
JSON = printed_reader(
    "makerfabs_json",
    'Makerfabs JSON: {"links":[{"A":"1782","R":"1.2"},..]}',
    begin=r'\{\s*"links"\s*:\s*\[\s*\{\s*"A"',
    each=r'"A"',
    whole=r'"A"\s*:\s*"(?P<anchor_id>[0-9A-Fa-f]{1,16})"\s*,\s*"R"\s*:\s*"?(?P<range>-?\d{1,6}(?:\.\d{1,4})?)"?\s*\}',
)
