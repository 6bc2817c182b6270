"""The fast way through a table gives what the slow one gives."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rangesfm.files.plain_tables import find_columns


@pytest.mark.parametrize(
    "cells",
    [
        ["0", "-0", "7", "123456789012345"],
        ["1.5", "-1.5", ".5", "5.", "-.25", "00012.500"],
        ["1700000000.123456", "0.1", "0.3", "123.456789"],
        ["9007199254740991", "0.00000000000000000001"],
    ],
)
def test_plain_numbers_are_those_of_float_to_the_last_bit(cells: list[str]) -> None:
    columns = find_columns("\n".join(f"x,{cell}" for cell in cells), 2, ",")
    assert columns is not None
    numbers = columns[1].numbers()
    assert numbers is not None
    expected = np.array(list(map(float, cells)))
    np.testing.assert_array_equal(numbers, expected)
    np.testing.assert_array_equal(np.signbit(numbers), np.signbit(expected))


@given(st.lists(st.decimals(-1e7, 1e7, places=6).map(str) | st.integers(-(10**15), 10**15).map(str), min_size=1))
def test_any_decimals_are_those_of_float_to_the_last_bit(cells: list[str]) -> None:
    columns = find_columns("\n".join(f"x,{cell}" for cell in cells), 2, ",")
    assert columns is not None
    numbers = columns[1].numbers()
    assert numbers is not None or any("E" in cell for cell in cells)
    if numbers is not None:
        np.testing.assert_array_equal(numbers, list(map(float, cells)))


@pytest.mark.parametrize(
    "cell", ["", "-", ".", "-.", "1e3", "+1", " 1", "1_0", "1-2", "1.2.3", "--1", "9007199254740993"]
)
def test_what_is_no_plain_number_is_left_to_others(cell: str) -> None:
    columns = find_columns(f"x,1.5\nx,{cell}\nx,2.5\n", 2, ",")
    assert columns is not None
    assert columns[1].numbers() is None


def test_texts_are_the_cells_whatever_their_length() -> None:
    cells = ["a", "", " b ", "c" * 60, "a"]
    columns = find_columns("".join(f"{cell},x,{cell[:9]}\n" for cell in cells), 3, ",")
    assert columns is not None
    assert columns[0].texts() == cells
    assert columns[2].texts() == [cell[:9] for cell in cells]


@pytest.mark.parametrize(
    "text",
    ['"a",b\n', "a,b\n#c,d\n", "a,b\n\nc,d\n", "a,b\nc\n", "a,b,c\nd\n", "\u00e9,b\n", "a\0,b\n", "a,b\n,\n,,\n"],
)
def test_tables_that_are_not_plain_are_left_to_others(text: str) -> None:
    assert find_columns(text, 2, ",") is None


def test_tables_of_one_column_or_of_blanks_are_left_to_others() -> None:
    assert find_columns("a\nb\n", 1, ",") is None
    assert find_columns("a\tb\n", 2, "\t") is None
    assert find_columns("a b\n", 2, " ") is None


def test_no_rows_are_no_cells() -> None:
    columns = find_columns("", 2, ",")
    assert columns is not None
    assert (columns[0].texts(), len(columns[1])) == ([], 0)
    numbers = columns[1].numbers()
    assert numbers is not None
    assert len(numbers) == 0


@pytest.mark.parametrize("num_names", [1, 7, 50, 400])
@pytest.mark.parametrize("width", [1, 5, 12])
def test_categories_are_the_texts_told_apart(num_names: int, width: int) -> None:
    rng = np.random.default_rng(num_names + width)
    names = [f"{k:0{width}d}" for k in range(num_names)]
    texts = [names[k] for k in rng.integers(0, num_names, 3000)]
    columns = find_columns("".join(f"{text},1\n" for text in texts), 2, ",")
    assert columns is not None
    found, index = columns[0].categories()
    assert [found[k] for k in index] == texts
    assert found == list(dict.fromkeys(texts))
