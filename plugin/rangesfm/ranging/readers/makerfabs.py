"""Arduino sketches for the DW1000, as Makerfabs ships them: text lines and JSON links."""

from __future__ import annotations

import re

from rangesfm.ranging.readers.printed import Phrases, printed_reader

TEXT = printed_reader(
    "arduino",
    "Arduino DW1000 sketch: from: D325 Range: 29.40 m ..",
    Phrases(
        begin=re.compile(r"from:\s{0,9}[0-9A-Fa-f]{1,16}\s{1,9}Range:", re.ASCII),
        each=re.compile(r"from:", re.ASCII),
        whole=re.compile(
            r"from:\s{0,9}(?P<anchor_id>[0-9A-Fa-f]{1,16})\s{1,9}Range:\s{0,9}(?P<range>-?\d{1,6}\.\d{1,4}) ?m\b",
            re.ASCII,
        ),
    ),
)
JSON = printed_reader(
    "makerfabs_json",
    'Makerfabs JSON: {"links":[{"A":"1782","R":"1.2"},..]}',
    Phrases(
        begin=re.compile(r'\{\s*"links"\s*:\s*\[\s*\{\s*"A"', re.ASCII),
        each=re.compile(r'"A"', re.ASCII),
        whole=re.compile(
            r'"A"\s*:\s*"(?P<anchor_id>[0-9A-Fa-f]{1,16})"\s*,\s*"R"\s*:\s*"?(?P<range>-?\d{1,6}(?:\.\d{1,4})?)"?\s*\}',
            re.ASCII,
        ),
    ),
)
