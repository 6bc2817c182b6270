"""README.md and the pages in examples/ are true: commands run, the shown output is printed, and links work.

A page's fences are processed from top to bottom in one folder that holds a small survey. The kind of a fence says what
is done with it:

- ``bash``: each command is run as it is;
- ``sh``: the program's parser reads each command, which is not run, because it installs something, takes long, or needs
  what only a user has;
- ``text``: each line was printed by the block before it;
- ``csv NAME``: written to a file of that name, for the blocks after it.
"""

from __future__ import annotations

import io
import re
import runpy
import shlex
import shutil
import sys
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import pytest
from tests.conftest import SITE_M, TAG_IN_CAM_M, TIME_OFFSET_S
from tests.simulated.path import loop_path

from rangesfm.cli.arguments import Commands, normalize, parse
from rangesfm.export import EXPORTERS
from rangesfm.measurements.ranges.readers import read_ranges, reader_names, write_ranges_csv
from rangesfm.planning.plan_file import plan_tables
from rangesfm.survey.settings import KEYS
from rangesfm.survey.survey_reader import read_survey

if TYPE_CHECKING:
    from tests.conftest import Command, PhotoRun, WalkedSurvey

ROOT = Path(__file__).parents[1]
README = ROOT / "README.md"
PAGES = (README, *sorted((ROOT / "examples").glob("*.md")))
# Pages that begin with a model; the others begin with a survey that has photos, run once.
WITH_A_MODEL = {
    "existing_model",
    "conventions",
    "unknown_anchors",
    "lengths",
    "verdicts",
    "checks",
    "radios",
    "many_surveys",
}


class Block(NamedTuple):
    kind: str
    name: str
    text: str

    @property
    def commands(self) -> list[list[str]]:
        """Return the words of each command; a line that ends with a backslash continues."""
        lines = self.text.replace("\\\n", " ").splitlines()
        return [words for line in lines if (words := shlex.split(line, comments=True))]


def blocks_of(page: Path) -> list[Block]:
    found = re.findall(r"^```(\w+) ?(\S*)\n(.*?)^```$", page.read_text(encoding="utf-8"), re.DOTALL | re.MULTILINE)
    return [Block(*parts) for parts in found]


MODEL_SURVEY = f"""
[images]
times = "images.csv"
[ranges]
path = "uwb.csv"
time_offset = {TIME_OFFSET_S}
[anchors]
path = "anchors.csv"
[tag]
tag_in_cam_m = {list(TAG_IN_CAM_M)}
"""


@pytest.fixture(scope="module")
def model_folder(
    walked_survey: WalkedSurvey, rangesfm_command: Command, tmp_path_factory: pytest.TempPathFactory
) -> Path:
    """A model without photos with its survey, tag positions as from a total station, and results of two days."""
    folder = shutil.copytree(walked_survey.folder, tmp_path_factory.mktemp("pages") / "survey")
    (folder / "survey.toml").write_text(MODEL_SURVEY)
    shutil.copytree(folder / "sparse", folder / "out" / "sparse")
    path, times = loop_path(42.0, start_s=99.0, seed=3), np.arange(99.5, 140.5, 0.1)
    tag_m = SITE_M + path.centers(times) + path.world_from_cam(times) @ np.array(TAG_IN_CAM_M)
    rows = [",".join(map(repr, row)) for row in np.column_stack([times - TIME_OFFSET_S, tag_m]).tolist()]
    (folder / "tag.csv").write_text("\n".join(["timestamp_s,x_m,y_m,z_m", *rows]) + "\n")
    log = read_ranges(folder / "uwb.csv")
    noise_m = 0.01 * np.random.default_rng(4).standard_normal(len(log))
    write_ranges_csv(replace(log, range_m=log.range_m + noise_m), folder / "other_uwb.csv")
    for day, ranges in (("monday", "uwb.csv"), ("tuesday", "other_uwb.csv")):
        flags = ("survey.toml", "--input_path", "sparse/0", "--ranges", ranges, "--output_path", f"{day}/out")
        rangesfm_command("refine", *flags, "--no_report", cwd=folder)
    (folder / "other_uwb.csv").unlink()
    return folder


@pytest.fixture
def page_folder(page: Path, request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    """The folder in which a reader of this page types the commands."""
    if page.stem in WITH_A_MODEL:
        folder = shutil.copytree(request.getfixturevalue("model_folder"), tmp_path / "survey")
    else:
        run: PhotoRun = request.getfixturevalue("photo_run")
        folder = shutil.copytree(run.survey.folder, tmp_path / "survey")
        if page == README:
            shutil.copytree(folder, folder / "my_survey", ignore=shutil.ignore_patterns("out", "survey.toml"))
    (folder / "examples").symlink_to(ROOT / "examples")
    return folder


@pytest.mark.parametrize("page", [page for page in PAGES if "```bash" in page.read_text()], ids=lambda page: page.stem)
def test_commands_of_a_page_run_as_they_stand(page: Path, page_folder: Path, rangesfm_command: Command) -> None:
    printed: list[str] = []
    for block in blocks_of(page):
        if block.kind == "bash":
            printed = []
            for program, *arguments in block.commands:
                if program == "python":
                    printed += run_program(arguments, page_folder)
                else:
                    assert program == "rangesfm"
                    printed += rangesfm_command(*arguments, cwd=page_folder).stdout.splitlines()
        elif block.kind == "text":
            assert [line for line in block.text.splitlines() if line not in printed] == []
        elif block.name:
            (page_folder / block.name).write_text(block.text)


def run_program(arguments: list[str], cwd: Path) -> list[str]:
    with pytest.MonkeyPatch.context() as patch, redirect_stdout(io.StringIO()) as out, redirect_stderr(out):
        patch.chdir(cwd)
        patch.setattr(sys, "argv", arguments)
        runpy.run_path(arguments[0], run_name="__main__")
    return out.getvalue().splitlines()


def shown_commands() -> list[list[str]]:
    """Return every call of rangesfm in a fence, without the program's name."""
    words = (
        words for page in PAGES for block in blocks_of(page) if block.kind in ("bash", "sh") for words in block.commands
    )
    commands = [" ".join(each).split(" && ")[-1].split() if "&&" in each else each for each in words]
    return [rest for program, *rest in commands if Path(program).name == "rangesfm"]


@pytest.mark.parametrize("arguments", shown_commands(), ids=" ".join)
def test_a_command_that_is_shown_is_one(arguments: list[str]) -> None:
    assert parse(normalize(arguments)).command in Commands().by_name


def test_every_command_is_on_a_page() -> None:
    text = "".join(page.read_text(encoding="utf-8") for page in PAGES)
    assert [command for command in Commands().by_name if f"rangesfm {command}" not in text] == []


def test_every_log_format_and_every_export_format_is_on_a_page() -> None:
    logs, exports = ((ROOT / "examples" / name).read_text(encoding="utf-8") for name in ("log_formats.md", "export.md"))
    assert [name for name in EXPORTERS if f"`{name}`" not in exports] == []
    assert [name for name in reader_names() if PAGE_NAMES.get(name, f"`{name}`").lower() not in logs.lower()] == []


# Names in log_formats.md of readers that are known to users by another name.
PAGE_NAMES = {
    "ros": "ROS 1 and 2 bags",
    "canonical": "canonical CSV",
    "mapped": "--columns",
    "table": "any table of text",
    "librsf": "libRSF",
    "pyfg": "PyFactorGraph",
    "leaps_meas": "LEAPS",
    "leaps_lea": "LEAPS",
    "qorvo": "Qorvo",
    "dwm1001_lec": "DWM1001 `lec`",
    "dwm1001_les": "and `les`",
    "mauwb": "MaUWB",
    "arduino": "Arduino",
    "makerfabs_json": "Makerfabs",
    "trek1000": "TREK1000",
}


def test_the_readme_is_read_in_one_go() -> None:
    assert len(README.read_text(encoding="utf-8").splitlines()) <= 150


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_links_lead_to_what_is_there(page: Path) -> None:
    for target, anchor in re.findall(r"\]\((?!https?:)([^)#]*)(?:#([^)]*))?\)", page.read_text(encoding="utf-8")):
        linked = page.parent / target if target else page
        assert linked.is_file(), target
        if anchor:
            titles = re.findall(r"^#+ (.*)$", linked.read_text(encoding="utf-8"), re.MULTILINE)
            assert anchor in {re.sub(r"[^\w -]", "", title.lower()).replace(" ", "-") for title in titles}


def test_the_numbers_that_decide_are_those_of_the_program() -> None:
    text = (ROOT / "examples" / "model.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| `([\w.]+)\.(\w+)` \| ([\d.]+) \|", text, flags=re.MULTILINE)
    assert len(rows) >= 10
    assert {name: getattr(import_module(f"rangesfm.{module}"), name) for module, name, _ in rows} == {
        name: float(value) for _, name, value in rows
    }


def test_the_pages_are_one_tour() -> None:
    """The README lists every page once, in the order in which the last line of each leads to the next."""
    text = README.read_text(encoding="utf-8")
    tour = re.findall(r"\(examples/(\w+\.md)\)", text[text.index("## The tour") : text.index("## Compatibility")])
    assert sorted(tour) == sorted(page.name for page in PAGES if page != README)
    last_lines = [(ROOT / "examples" / name).read_text(encoding="utf-8").splitlines()[-1] for name in tour]
    assert [re.findall(r"^Next\b.*?\]\(([\w.]+)\)", line) for line in last_lines] == [[name] for name in tour[1:]] + [
        []
    ]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_keys_in_the_text_exist(page: Path) -> None:
    of_a_plan = {(table, key) for table, model in plan_tables().items() for key in model.model_fields}
    named = set(re.findall(r"`\[(\w+)\] (\w+)", page.read_text(encoding="utf-8")))
    assert named - {(key.table, key.name) for key in KEYS} - of_a_plan == set()


def test_flags_in_the_text_exist() -> None:
    known = set()
    for command in Commands().by_name:
        with pytest.raises(SystemExit) as helped:
            parse([*command.split(), "--help"])
        known |= set(re.findall(r"--\w+", str(helped.value.code)))
    text = "".join(
        re.sub(r"^```.*?^```$", "", page.read_text(encoding="utf-8"), flags=re.DOTALL | re.MULTILINE) for page in PAGES
    )
    named = {flag.replace("-", "_").replace("__", "--", 1) for flag in re.findall(r"(?<=[` ])--\w[\w-]*", text)}
    assert named - known == OF_OTHER_PROGRAMS | OF_STUDIES
    everything = "".join(page.read_text(encoding="utf-8") for page in PAGES)
    assert {flag for flag in known if flag not in everything} == OF_THE_HELP


# These need no page: the help says all.
OF_THE_HELP = {"--num_photos", "--quiet"}
OF_OTHER_PROGRAMS = {
    "--auto_scale_poses",
    "--center_method",
    "--config_settings",
    "--csv",
    "--orientation_method",
    "--ref_images_path",
    "--transform_path",
}
OF_STUDIES = {"--data", "--leave_radio_out", "--photos", "--quick", "--room", "--store"}


def test_the_survey_file_on_its_page_is_one(tmp_path: Path) -> None:
    (text,) = (block.text for block in blocks_of(ROOT / "examples" / "survey_file.md") if block.kind == "toml")
    (tmp_path / "survey.toml").write_text(text, encoding="utf-8")
    for name in ("images.csv", "uwb.csv", "anchors.csv"):
        (tmp_path / name).touch()
    survey = read_survey(tmp_path / "survey.toml")
    assert survey.images.every_nth == 3
    assert survey.camera.model == "OPENCV"
    assert survey.ranges.time_offset_s is None
    assert survey.tag.tag_in_cam_m == (-0.0012, -0.09, -0.0663)
