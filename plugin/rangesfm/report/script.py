"""The page's script: its files one after another, and the hash by which the page's policy allows it."""

from __future__ import annotations

import base64
import hashlib
from pathlib import Path

ASSETS = Path(__file__).with_name("assets")

_FILES = (
    "data.js",
    "theme.js",
    "stage.js",
    "points.js",
    "cameras.js",
    "anchors.js",
    "ranges.js",
    "grid.js",
    "labels.js",
    "picking.js",
    "measuring.js",
    "photo_panel.js",
    "print.js",
    "charts.js",
    "csv.js",
    "main.js",
)


def page_script() -> str:
    """three.js and Vega, then the page's own files in one scope of their own."""
    libraries = [(ASSETS / "vendor" / name).read_text(encoding="utf-8") for name in ("three.min.js", "vega.min.js")]
    files = [(ASSETS / "view" / name).read_text(encoding="utf-8") for name in _FILES]
    return f'{"".join(libraries)}\n(() => {{\n"use strict";\n{"".join(files)}}})();\n'


def policy_source(script: str) -> str:
    """What Content-Security-Policy calls an inline script by."""
    digest = hashlib.sha256(script.encode("utf-8")).digest()
    return f"'sha256-{base64.b64encode(digest).decode('ascii')}'"
