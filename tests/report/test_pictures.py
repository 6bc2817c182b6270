"""The report's figures as pictures for a paper, and the figures of ranges alone."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from tests.outputs import names_in

from rangesfm.errors import InputError
from rangesfm.measurements.ranges.range_log import RangeLog
from rangesfm.report import write_report_pictures
from rangesfm.report.chart import figure_spec, write_picture
from rangesfm.report.content import Content
from rangesfm.report.figures_mistakes import mistakes_figure
from rangesfm.report.figures_ranges import plot_ranges
from rangesfm.result.result_folder import read_result_folder

MakeResult = Callable[..., Path]
LOG = RangeLog.from_arrays(["a", "b", "a"], [1.0, 2.0, 3.0], timestamp_s=[1.7e9, 1.7e9 + 1, 1.7e9 + 2])


def test_every_figure_has_its_pictures_with_something_on_them(make_result: MakeResult) -> None:
    folder = make_result(num_keyframes=60, num_ranges_per_anchor=60, num_points=3000)
    written = write_report_pictures(folder)
    assert len(written) == 2 * 11
    assert {path.parent for path in written} == {folder / "figures"}
    for path in written:
        if path.suffix == ".svg":
            assert len(list(ET.parse(path).iter("{http://www.w3.org/2000/svg}path"))) > 3, path.name
            continue
        pixels = np.asarray(Image.open(path).convert("RGB"), dtype=np.int64)
        assert pixels.shape[1] > 900
        colorful = np.ptp(pixels, axis=2) > 60
        assert colorful.mean() > 1e-3, path.name


def test_texts_beside_rows_stand_beside_the_panel_in_each_of_several_panels(make_result: MakeResult) -> None:
    """The texts on the right of a row once stood on its bar."""
    content = Content(read_result_folder(make_result(num_keyframes=20, num_ranges_per_anchor=20)))
    (figure,) = mistakes_figure(content)
    for panel in figure_spec(figure)["concat"]:
        texts = [layer for layer in panel["layer"] if layer["mark"]["type"] == "text"]
        sides = {layer["mark"]["align"]: (layer["encoding"]["x"]["value"], layer["mark"]["dx"]) for layer in texts}
        assert sides == {"right": (0, -8), "left": ("width", 8)}


def test_plot_shows_each_anchors_ranges_over_the_time_since_the_first() -> None:
    (panel,) = plot_ranges(LOG).panels
    assert {one.name: one.points.tolist() for one in panel.series} == {"a": [[0, 1], [2, 3]], "b": [[1, 2]]}


def test_log_by_photos_is_drawn_by_number() -> None:
    (panel,) = plot_ranges(RangeLog.from_arrays(["a", "a"], [1.0, 2.0], image_name=["1.jpg", "2.jpg"])).panels
    assert panel.series[0].points.tolist() == [[0, 1], [1, 2]]


@pytest.mark.parametrize("name", ["$\\foo$", "<b>&amp;", "a.b[0]", "a'b\"c", "\\"])
def test_names_are_drawn_as_they_are(tmp_path: Path, name: str) -> None:
    log = RangeLog.from_arrays([name, "other"], [1.0, 2.0], timestamp_s=[0.0, 1.0])
    write_picture(plot_ranges(log), tmp_path / "out.svg")
    texts = [text.text for text in ET.parse(tmp_path / "out.svg").iter("{http://www.w3.org/2000/svg}text")]
    assert name in texts


def test_figure_is_written_as_its_name_says(tmp_path: Path) -> None:
    write_picture(plot_ranges(LOG), tmp_path / "out.PNG")
    with Image.open(tmp_path / "out.PNG") as image:
        assert (image.format, image.width > 1440) == ("PNG", True)
    with pytest.raises(InputError, match="no figure format is named 'doc', expected one of png, svg"):
        write_picture(plot_ranges(LOG), tmp_path / "out.doc")
    with pytest.raises(InputError, match="cannot be written"):
        write_picture(plot_ranges(LOG), tmp_path / "none" / "out.png")
    assert names_in(tmp_path) == ["out.PNG"]


def test_pictures_have_the_pages_light_colours() -> None:
    assert figure_spec(plot_ranges(LOG))["config"]["axis"]["labelColor"] == "#556170"
