"""HTML and SVG elements from Python: whatever is not Markup is escaped, so nobody can forget to."""

from __future__ import annotations

import html
from collections.abc import Iterable
from typing import TypeAlias

VOID_TAGS = {"meta", "br", "img", "input"}


class Markup(str):
    """Text that is HTML already."""


Child: TypeAlias = Markup | str | Iterable["Child"] | None


def element(tag: str, *children: Child, **attributes: str | float | None) -> Markup:
    """``<tag attributes>children</tag>``.

    Args:
        children: Markup as it is, strings escaped, None left out, iterables one by one.
        attributes: names with ``_`` for ``-`` and a trailing ``_`` dropped (``class_``);
            numbers to a hundredth; None left out.
    """
    opening = tag + "".join(
        f' {name.rstrip("_").replace("_", "-")}="{html.escape(_attribute(value))}"'
        for name, value in attributes.items()
        if value is not None
    )
    return Markup(f"<{opening}>" if tag in VOID_TAGS else f"<{opening}>{join(children)}</{tag}>")


def join(child: Child) -> Markup:
    """All children in a row, escaped where needed."""
    if child is None:
        return Markup("")
    if isinstance(child, Markup):
        return child
    if isinstance(child, str):
        return Markup(html.escape(child))
    return Markup("".join(join(part) for part in child))


def _attribute(value: str | float) -> str:
    return value if isinstance(value, str) else f"{value:.2f}".rstrip("0").rstrip(".")
