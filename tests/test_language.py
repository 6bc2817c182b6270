"""Docstrings begin with a sentence or a noun phrase, public names stand once, and class variables have a type."""

from __future__ import annotations

import ast
import re
from collections import Counter
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
FILES = sorted(path for name in ("plugin", "tests", "examples") for path in (ROOT / name).rglob("*.py"))
PACKAGE_FILES = sorted((ROOT / "plugin").rglob("*.py"))

# A docstring that begins with one of these is a fragment ("Of features whose ...", "As they are", "Whether it is") or
# hides what comes out. All of them can be avoided: "Photos by name" in place of "By name, the photos". Articles,
# numbers ("One", "All", "Each") and shapes ("(n, 3) points") begin noun phrases, so they are allowed.
_WORDS = "and as at but by for from how if in none not of on or that to what when where whether which with without"
FRAGMENT_WORDS = frozenset(_WORDS.split())


def docstrings(source: str) -> list[tuple[int, str]]:
    """Return line and text of each docstring of a file: of modules, classes, functions and attributes."""
    return [
        (node.lineno, node.value.value)
        for node in ast.walk(ast.parse(source))
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str)
    ]


def fragments(source: str) -> list[tuple[int, str]]:
    """Return line and first words of each docstring that begins with a fragment word."""
    first_words = ((line, text.split()) for line, text in docstrings(source))
    return [
        (line, " ".join(words[:8]))
        for line, words in first_words
        if words and words[0].rstrip(",.:;").lower() in FRAGMENT_WORDS
    ]


@pytest.mark.parametrize(
    ("source", "found"),
    [
        ('"""Of features."""', [(1, "Of features.")]),
        ('x = 1\n"""As, for example, this."""', [(2, "As, for example, this.")]),
        ('def f():\n    """None: it is not known."""', [(2, "None: it is not known.")]),
        ('class A:\n    """What it is."""\n    def f(self):\n        """Off."""', [(2, "What it is.")]),
        ('"""Offsets by name."""\nprint("of a string that is no docstring")', []),
        ('def f():\n    """(n, 3) points."""', []),
    ],
)
def test_a_fragment_is_recognised_by_its_first_word(source: str, found: list[tuple[int, str]]) -> None:
    assert fragments(source) == found


def test_docstrings_begin_with_no_fragment() -> None:
    found = [
        f"{path.relative_to(ROOT)}:{line}: {words}"
        for path in FILES
        for line, words in fragments(path.read_text(encoding="utf-8"))
    ]
    assert found == []


@pytest.mark.parametrize("files", [PACKAGE_FILES, sorted(ROOT.glob("tests/**/*.py"))], ids=["package", "tests"])
def test_no_two_files_share_a_name(files: list[Path]) -> None:
    names = Counter(path.name for path in files if path.name not in {"__init__.py", "conftest.py"})
    assert [name for name, num in names.items() if num > 1] == []


def test_no_two_public_functions_or_classes_share_a_name() -> None:
    names = Counter(
        node.name
        for path in PACKAGE_FILES
        for node in ast.parse(path.read_text(encoding="utf-8")).body
        if isinstance(node, ast.FunctionDef | ast.ClassDef) and not node.name.startswith("_")
    )
    assert [name for name, num in names.items() if num > 1] == []


def test_class_variables_have_a_type() -> None:
    """Pydantic refuses a plain ``ClassVar`` on Python 3.10 in a model when its module is imported."""
    texts = {path.name: path.read_text(encoding="utf-8") for path in PACKAGE_FILES}
    assert [name for name, text in texts.items() if re.search(r": ClassVar(?!\[)\b", text)] == []
