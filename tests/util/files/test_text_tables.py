"""Tables are read whole, or refused with the number of the wrong line."""

from __future__ import annotations

import csv
import tempfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rangesfm.errors import InputError
from rangesfm.util.files.text_tables import FOUND, header_names, read_table, read_text, write_table


def write(folder: Path, content: str | bytes) -> Path:
    path = folder / "table.csv"
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


def refusal(path: Path, required: tuple[str, ...] = ("a", "b")) -> InputError:
    with pytest.raises(InputError) as caught:
        np.column_stack(list(map(read_table(path, required).numbers, required)))
    assert "\n" not in str(caught.value)
    return caught.value


def test_columns_are_found_by_name_whatever_their_order(tmp_path: Path) -> None:
    table = read_table(write(tmp_path, "b,other,a\n2,x,1\n4,y,3\n"), ["a", "b"])
    np.testing.assert_array_equal(table.numbers("a"), [1, 3])
    np.testing.assert_array_equal(table.numbers("b"), [2, 4])
    assert len(table) == 2


def test_line_numbers_count_comments_and_blank_lines(tmp_path: Path) -> None:
    table = read_table(write(tmp_path, "# made by hand\n\na,b\n1,2\n  # pause\n   \n3,4\n"), ["a", "b"])
    np.testing.assert_array_equal(table.line, [4, 7])
    np.testing.assert_array_equal(table.numbers("a"), [1, 3])


@pytest.mark.parametrize(
    "content",
    [
        b"\xef\xbb\xbfa,b\n1,2\n3,4\n",
        b"a,b\r\n1,2\r\n3,4\r\n",
        b"a,b\r1,2\r3,4",
        b" a , b \n 1 ,\t2\n3,4",
        b'"a","b"\n"1","2"\n3,4\n',
        "a,b\n1,2\n3,4\n".encode("utf-16"),
        b"a,b\n1,2\na,b\n3,4\n",
    ],
    ids=["byte order mark", "CRLF", "CR and no last line end", "blanks around cells", "quotes", "UTF-16", "two files"],
)
def test_the_same_table_in_another_dress(tmp_path: Path, content: bytes) -> None:
    table = read_table(write(tmp_path, content), ["a", "b"])
    np.testing.assert_array_equal(table.numbers("a"), [1, 3])
    np.testing.assert_array_equal(table.numbers("b"), [2, 4])


def test_quoted_cells_may_hold_the_separator(tmp_path: Path) -> None:
    table = read_table(write(tmp_path, 'a,b\n"x, y",2\n'), ["a", "b"])
    assert table.text("a") == ["x, y"]


@pytest.mark.parametrize("content", ["a;b\n1;2\n", "a\tb\n1\t2\n", "a   b\n 1  2 \n"])
def test_separator_is_told_from_the_header_row(tmp_path: Path, content: str) -> None:
    table = read_table(write(tmp_path, content), ["a", "b"], separator=FOUND)
    np.testing.assert_array_equal(table.numbers("b"), [2])


def test_aliases_rename_columns_unless_the_real_name_is_there(tmp_path: Path) -> None:
    table = read_table(write(tmp_path, ",x\n7,1\n"), ["id", "x_m"], aliases={"": "id", "x": "x_m"})
    assert table.text("id") == ["7"]
    np.testing.assert_array_equal(table.numbers("x_m"), [1])


def test_optional_columns_may_be_missing_and_empty(tmp_path: Path) -> None:
    table = read_table(write(tmp_path, "a,b,c\n1,,\n2,5,z\n"), ["a"], ["b", "c", "d"])
    np.testing.assert_array_equal(table.numbers("b", empty=np.nan), [np.nan, 5])
    assert table.text("c", empty="none") == ["none", "z"]
    assert "d" not in table


def test_a_wrong_cell_far_down_is_named_with_its_line(tmp_path: Path) -> None:
    lines = ["a,b"] + ["1,2"] * 30_000
    lines[25_000] = "1,oops"
    error = refusal(write(tmp_path, "\n".join(lines)))
    assert error.line == 25_001
    assert "b is 'oops', expected a number" in str(error)


@pytest.mark.parametrize("cell", ["nan", "inf", "-Infinity", "1e999"])
def test_numbers_are_finite(tmp_path: Path, cell: str) -> None:
    error = refusal(write(tmp_path, f"a,b\n1,2\n1,{cell}\n"))
    assert error.line == 3
    assert f"b is {cell}" in str(error)


def test_pythons_own_number_spelling_is_not_a_number(tmp_path: Path) -> None:
    assert "'1_000'" in str(refusal(write(tmp_path, "a,b\n1,1_000\n")))


def test_empty_cell_is_refused(tmp_path: Path) -> None:
    error = refusal(write(tmp_path, "a,b\n1, \n"))
    assert "b is empty" in str(error)


@pytest.mark.parametrize(("row", "num"), [("1", "1 cell,"), ("1,2,3", "3 cells,")])
def test_rows_have_as_many_cells_as_the_header(tmp_path: Path, row: str, num: str) -> None:
    error = refusal(write(tmp_path, f"a,b\n1,2\n\n{row}\n1,2\n"))
    assert error.line == 4
    assert f"has {num} the header row has 2" in str(error)


def test_empty_cells_at_the_end_of_rows_are_no_cells(tmp_path: Path) -> None:
    table = read_table(write(tmp_path, "a,b\n1,2,\n3,,, \n"), ["a", "b"])
    assert (table.text("a"), table.text("b", empty="none")) == (["1", "3"], ["2", "none"])


def test_missing_column_names_what_was_found_and_expected(tmp_path: Path) -> None:
    error = refusal(write(tmp_path, "# c\na,c\n1,2\n"))
    assert error.line == 2
    assert "no column b; found a, c; expected a, b" in str(error)


def test_column_that_stands_twice_is_refused(tmp_path: Path) -> None:
    assert "2 columns are named a" in str(refusal(write(tmp_path, "a,b,a\n1,2,3\n")))


def test_table_without_header_row_is_refused(tmp_path: Path) -> None:
    error = refusal(write(tmp_path, "1,2\n3,4\n"))
    assert error.line == 1
    assert "no header row" in str(error)


@pytest.mark.parametrize("content", [b"", b"\n\n", b"# only a comment\n", b"\xef\xbb\xbf"])
def test_empty_file_is_refused(tmp_path: Path, content: bytes) -> None:
    assert "empty" in str(refusal(write(tmp_path, content)))


def test_missing_file_and_folder_are_refused(tmp_path: Path) -> None:
    assert "no such file" in str(refusal(tmp_path / "none.csv"))
    assert "is a folder" in str(refusal(tmp_path))


def test_bytes_that_are_no_text_are_named_with_their_line(tmp_path: Path) -> None:
    error = refusal(write(tmp_path, b"a,b\n1,2\n1,\xff\n"))
    assert error.line == 3
    assert "0xff" in str(error)


def test_quote_that_never_ends_is_refused(tmp_path: Path) -> None:
    assert refusal(write(tmp_path, 'a,b\n1,2\n"1,2\n3,4\n')).line == 3


def test_message_of_control_characters_stays_on_one_line(tmp_path: Path) -> None:
    assert str(refusal(write(tmp_path, "a,b\n1,\x1b[2J\x0bx\n"))).isprintable()


def test_header_names_of_no_table_at_all_are_empty() -> None:
    assert header_names("") == []
    assert header_names('"unfinished') == []


def test_text_of_any_line_ending_is_the_same(tmp_path: Path) -> None:
    assert read_text(write(tmp_path, b"\xef\xbb\xbfa\r\nb\rc\n")) == "a\nb\nc\n"


FORMULAS = ["=1+1", "+49 89 1", "-@SUM(1)", "@SUM(A1)", "\uff1d1", "'=1", "''-x", "-", "='#'!A1"]


@pytest.mark.parametrize("text", ["#1", "##", '#"', *FORMULAS, "'quoted", "'", '"', "a,b", "-3.2", "1e-5"])
def test_what_is_written_is_read_as_it_was(text: str, tmp_path: Path) -> None:
    path = tmp_path / "table.csv"
    write_table(path, ("a", "b", "c"), [(text, text, "-1.5"), ("plain", text, "+2")])
    table = read_table(path, ["a", "b", "c"])
    assert (table.text("a"), table.text("b")) == ([text, "plain"], [text, text])
    assert (table.categories("a").names, table.categories("b").names) == ((text, "plain"), (text,))
    np.testing.assert_array_equal(table.numbers("c"), [-1.5, 2])


@given(st.lists(st.text("'=+-@#\uff1d1x.\"", min_size=1, max_size=5)))
def test_whatever_is_written_is_read_as_it_was(texts: list[str]) -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "table.csv")
        write_table(path, ("a", "b"), [(text, "1") for text in texts])
        assert read_table(path, ["a", "b"]).text("a") == texts


@pytest.mark.parametrize("text", FORMULAS)
def test_nothing_is_written_that_a_spreadsheet_would_compute(text: str, tmp_path: Path) -> None:
    path = tmp_path / "table.csv"
    write_table(path, ("a", "b"), [(text, "-1.5")])
    with path.open(newline="") as file:
        assert list(csv.reader(file))[1] == [f"'{text}", "-1.5"]


def test_comments_of_the_user_are_comments_and_quoted_cells_are_cells(tmp_path: Path) -> None:
    table = read_table(write(tmp_path, '# c\n#a,b\na,b\n#x,1\n"#x",2\n  # y\n'), ["a", "b"])
    assert (table.text("a"), table.text("b")) == (["#x"], ["2"])


def test_a_name_does_not_make_a_packed_file(tmp_path: Path) -> None:
    path = write(tmp_path, "a,b\n1,2\n").rename(tmp_path / "table.gz")
    assert read_table(path, ["a"]).numbers("a").tolist() == [1.0]


@pytest.mark.parametrize("num_names", [1, 7, 400])
def test_categories_are_the_texts_told_apart(num_names: int, tmp_path: Path) -> None:
    texts = [f"n{k}" for k in np.random.default_rng(num_names).integers(0, num_names, 3000)]
    found = read_table(write(tmp_path, "a,b\n" + "".join(f"{text} ,1\n" for text in texts)), ["a"]).categories("a")
    assert [found.names[k] for k in found.index] == texts
    assert list(found.names) == list(dict.fromkeys(texts))
