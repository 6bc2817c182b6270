from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pycolmap
import pytest

from rangesfm.colmap.colmap_log import colmap_log
from rangesfm.colmap.passthrough import apply_options
from rangesfm.errors import InputError


def test_sets_values_of_every_kind_in_place() -> None:
    options = pycolmap.IncrementalPipelineOptions()
    values = {
        "min_num_matches": 20,
        "multiple_models": False,
        "ba_global_frames_ratio": 2,
        "snapshot_path": "snapshots",
        "ba_local_backend": "CERES",
        "image_names": ["a.jpg"],
        "constant_cameras": [3],
        "mapper": {"init_min_tri_angle": 4.0, "image_selection_method": "MIN_UNCERTAINTY"},
    }
    apply_options(options, values, "mapper.pipeline")
    assert (options.min_num_matches, options.multiple_models, options.ba_global_frames_ratio) == (20, False, 2.0)
    assert options.snapshot_path == Path("snapshots")
    assert options.ba_local_backend == pycolmap.BundleAdjustmentBackend.CERES
    assert (options.image_names, options.constant_cameras) == (["a.jpg"], {3})
    assert options.mapper.init_min_tri_angle == 4.0


def test_reaches_options_inside_options_inside_options() -> None:
    options = pycolmap.BundleAdjustmentOptions()
    apply_options(options, {"ceres": {"loss_function_type": "CAUCHY"}}, "refine.bundle_adjustment")
    assert options.ceres.loss_function_type == pycolmap.LossFunctionType.CAUCHY


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"min_num_match": 1}, "unknown key 'min_num_match' in [m]; the nearest known one is 'min_num_matches'"),
        ({"mapper": {"num_thread": 1}}, "unknown key 'num_thread' in [m.mapper]; the nearest known one is 'num_th"),
        ({"min_num_matches": "x"}, "[m] min_num_matches is 'x', expected a whole number"),
        ({"min_num_matches": 3.0}, "[m] min_num_matches is 3.0, expected a whole number"),
        ({"min_num_matches": True}, "[m] min_num_matches is True, expected a whole number"),
        ({"multiple_models": 1}, "[m] multiple_models is 1, expected true or false"),
        ({"ba_global_frames_ratio": "2"}, "[m] ba_global_frames_ratio is '2', expected a number"),
        ({"ba_local_backend": "GTSAM"}, "[m] ba_local_backend is 'GTSAM', expected one of CERES, CASPAR"),
        ({"ba_local_backend": []}, "[m] ba_local_backend is [], expected one of CERES, CASPAR"),
        ({"constant_cameras": ["a"]}, "[m] constant_cameras is ['a'], expected a list that COLMAP accepts"),
        ({"min_num_matches": 10**12}, "[m] min_num_matches is 1000000000000, expected a whole number that COLMAP"),
        ({"mapper": 3}, "[m] mapper is 3, expected a table"),
        ({"min_num_matches": -5}, "[m] COLMAP refuses a value, expected min_num_matches > 0 (-5 vs. 0)"),
        ({"mapper": {"init_max_error": -1.0}}, "[m] COLMAP refuses a value, expected init_max_error > 0"),
    ],
)
def test_refuses_in_one_line_and_says_what_was_expected(
    values: dict[str, Any], message: str, capfd: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(InputError, match=re.escape(message)) as error:
        apply_options(pycolmap.IncrementalPipelineOptions(), values, "m")
    assert "\n" not in str(error.value)
    assert capfd.readouterr() == ("", "")


def test_colmap_log_goes_to_the_file_and_only_inside_the_block(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    log = tmp_path / "mapper.log"
    for text in ("first block", "second block"):
        with colmap_log(log):
            pycolmap.logging.info(text)
            pycolmap.logging.error(f"error in {text}")
    assert capfd.readouterr() == ("", "")
    lines = log.read_text()
    assert [lines.count(text) for text in ("] first block", "] second block", "error in")] == [1, 1, 2]
    assert list(tmp_path.iterdir()) == [log]
    pycolmap.logging.warning("afterwards")
    assert "afterwards" in capfd.readouterr().err
    assert "afterwards" not in log.read_text()


def test_colmap_log_gives_its_flags_back_after_an_error(tmp_path: Path) -> None:
    flags = ("alsologtostderr", "logtostderr", "stderrthreshold", "minloglevel")
    before = [getattr(pycolmap.logging, flag) for flag in flags]
    with pytest.raises(KeyError), colmap_log(tmp_path / "mapper.log"):
        raise KeyError
    assert [getattr(pycolmap.logging, flag) for flag in flags] == before
