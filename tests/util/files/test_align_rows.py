"""Printed tables are aligned in columns, whatever their cells hold."""

from __future__ import annotations

import pytest

from rangesfm.util.files.text_tables import align_rows


def test_first_columns_begin_alike_and_others_end_alike() -> None:
    rows = [("model", "", "m"), ("a", "bc", "1.5"), ("longer", "d", "10.25")]
    assert align_rows(rows).split("\n") == ["model           m", "a       bc    1.5", "longer   d  10.25"]
    assert align_rows(rows, num_left=2).split("\n")[2] == "longer  d   10.25"


def test_cells_are_neither_cut_nor_obeyed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "20")
    monkeypatch.setenv("FORCE_COLOR", "1")
    name = "[red]x[/] :smile: " + "long " * 100 + "3.5"
    assert align_rows([("a", "b"), (name, "1")]).split("\n")[1] == f"{name}  1"


def test_wide_letters_take_two_columns() -> None:
    assert align_rows([("測量", "1"), ("abcd", "2")]).split("\n") == ["測量  1", "abcd  2"]
