"""The tables of a result are read as they were written, or refused with the number of the wrong line."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.outputs import names_in

from rangesfm.errors import InputError
from rangesfm.result.result_tables import (
    RESULT_TABLES,
    CenterCovariances,
    PhotoTimes,
    ScaleConsensus,
    TableFile,
    TimeOffsetCurve,
)


def example(kind: type[TableFile], num_rows: int) -> TableFile:
    """Return rows in which the second has every cell empty that may be empty."""
    columns: dict[str, Any] = {}
    for name, (format_spec, may_be_empty) in kind.columns().items():
        if format_spec == "s":
            texts = [f'{name},"{row}"' for row in range(num_rows)]
            columns[name] = tuple("" if may_be_empty and row == 1 else text for row, text in enumerate(texts))
        else:
            values = np.arange(1.0, num_rows + 1)
            columns[name] = np.where(may_be_empty & (values == 2), np.nan, values)
    return kind(**columns)


@pytest.mark.parametrize("num_rows", [0, 3])
@pytest.mark.parametrize("kind", RESULT_TABLES, ids=lambda kind: kind.NAME)
def test_table_is_read_as_it_was_written(kind: type[TableFile], num_rows: int, tmp_path: Path) -> None:
    written = example(kind, num_rows)
    written.write(tmp_path)
    found = kind.read(tmp_path)
    assert names_in(tmp_path) == [kind.NAME]
    for name in kind.columns():
        np.testing.assert_array_equal(getattr(found, name), getattr(written, name))


def test_times_keep_every_digit_and_other_numbers_six(tmp_path: Path) -> None:
    PhotoTimes(("a.jpg",), np.array([1778768429.9161234])).write(tmp_path)
    assert (tmp_path / "images.csv").read_text() == "image_name,timestamp_s\na.jpg,1778768429.9161234\n"
    ScaleConsensus(np.array([1 / 3]), np.array([75.0])).write(tmp_path)
    assert (tmp_path / "scale_consensus.csv").read_text() == "scale,num_agreeing\n0.333333,75\n"


def test_covariances_are_symmetric_matrices() -> None:
    (matrix,) = CenterCovariances(("a.jpg",), *np.arange(1.0, 7.0)[:, None]).by_photo_m2.values()
    assert matrix.tolist() == [[1.0, 2.0, 3.0], [2.0, 4.0, 5.0], [3.0, 5.0, 6.0]]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("time_offset_s\n1\n", r"time_offset_curve\.csv:1: no column cost"),
        ("time_offset_s,cost\n1,2\nx,2\n", r"time_offset_curve\.csv:3: time_offset_s is 'x', expected a number"),
        ("time_offset_s,cost\n,2\n", r"time_offset_curve\.csv:2: time_offset_s is empty, expected a number"),
    ],
)
def test_damaged_table_is_named_with_its_line(text: str, message: str, tmp_path: Path) -> None:
    (tmp_path / TimeOffsetCurve.NAME).write_text(text)
    with pytest.raises(InputError, match=message):
        TimeOffsetCurve.read(tmp_path)
