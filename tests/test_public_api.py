"""The package as a library: every public name exists, is documented, and is imported only when it is used."""

from __future__ import annotations

import inspect
import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from tests.export.models import synthesized

import rangesfm
from rangesfm.mapper_options import MapperOptions
from rangesfm.options import CameraOptions

# Packages that are slow to import, and not needed to see which names exist.
HEAVY = {"numpy", "scipy", "pycolmap", "pyceres", "PIL", "jinja2", "vl_convert"}


def modules_after(code: str) -> set[str]:
    """Return the top-level modules that a fresh interpreter has loaded after running ``code``."""
    code += "\nimport json, sys; print(json.dumps(sorted({name.partition('.')[0] for name in sys.modules})))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return set(json.loads(done.stdout))


def test_errors_and_the_command_line_need_nothing_heavy() -> None:
    assert not HEAVY & modules_after("import rangesfm.cli; rangesfm.InputError, rangesfm.GeometryError")


def test_surveys_and_logs_are_read_without_pycolmap() -> None:
    names = ("read_survey", "read_ranges", "read_anchors", "RangeLog")
    loaded = modules_after("import rangesfm; " + ", ".join(f"rangesfm.{name}" for name in names))
    assert "numpy" in loaded
    assert not {"pycolmap", "pyceres"} & loaded


def test_stages_are_not_hidden_by_modules_of_their_name() -> None:
    code = "import rangesfm.pipeline.run, rangesfm.cli.arguments as a; a.parse(['doctor'])\n"
    code += "assert all(callable(getattr(rangesfm, name)) for name in rangesfm.__all__[1:])"
    modules_after(code)


@pytest.mark.parametrize("name", [name for name in rangesfm.__all__ if name != "__version__"])
def test_public_name_is_there_and_explained(name: str) -> None:
    found = getattr(rangesfm, name)
    assert callable(found)
    assert found.__name__ == name
    assert found.__module__.partition(".")[0] == "rangesfm"
    text = inspect.getdoc(found)
    assert text is not None
    assert not text.startswith(f"{name}(")  # the docstring that a dataclass generates if nobody writes one
    assert len(text) > 20


@pytest.mark.parametrize(
    "name",
    ["select_keyframes", "reconstruct", "read_ranges", "initialize_scale", "rescale", "refine_with_ranges", "compare"],
)
def test_each_stage_is_a_plain_function(name: str) -> None:
    assert inspect.isfunction(getattr(rangesfm, name))


def test_names_are_sorted_listed_and_no_others() -> None:
    assert list(rangesfm.__all__) == ["__version__", *sorted(rangesfm.__all__[1:])]
    assert dir(rangesfm) == sorted(rangesfm.__all__)
    with pytest.raises(AttributeError, match="has no attribute 'rescale_everything'"):
        rangesfm.rescale_everything  # noqa: B018


def test_import_is_silent_and_leaves_logging_alone() -> None:
    code = "import logging, rangesfm, rangesfm.pipeline.run\nassert not logging.getLogger().handlers"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert (done.stdout, done.stderr) == ("", "")


class Elsewhere:
    """A path of another library."""

    def __init__(self, path: Path) -> None:
        self._path = str(path)

    def __fspath__(self) -> str:
        return self._path


@pytest.mark.parametrize("kind", [str, Path, Elsewhere])
def test_every_path_may_be_a_text_or_a_path_of_any_library(kind: Callable[[Path], Any], tmp_path: Path) -> None:
    path, folder = kind(tmp_path / "missing"), kind(tmp_path / "export")
    readers = (rangesfm.read_anchors, rangesfm.read_image_times_csv, rangesfm.read_plan, rangesfm.read_ranges)
    for read in (*readers, rangesfm.read_reference, rangesfm.read_survey, rangesfm.write_report):
        with pytest.raises(rangesfm.InputError, match="missing"):
            read(path)
    with pytest.raises(rangesfm.InputError, match="missing"):
        rangesfm.read_ranges([path, path])
    with pytest.raises(rangesfm.InputError, match="missing"):
        rangesfm.measure(path, [("a", "b")], markers=path)
    with pytest.raises(rangesfm.InputError, match="missing"):
        rangesfm.export_result(path, ["ply"], folder, images_path=path)
    with pytest.raises(rangesfm.InputError, match="missing"):
        rangesfm.find_image_times(path, ["a.jpg"], path)
    with pytest.raises(rangesfm.ReconstructionError, match="missing"):
        rangesfm.reconstruct(path, ["a.jpg", "b.jpg"], folder, camera=CameraOptions(), mapper=MapperOptions())
    written = rangesfm.export_model(synthesized(3, 20, seed=0), ["ply"], folder)
    assert written == (tmp_path / "export" / "points.ply",)


def test_version_is_that_of_the_package() -> None:
    from importlib.metadata import version

    assert rangesfm.__version__ == version("rangesfm")
