"""Files and folders appear whole or not at all."""

from __future__ import annotations

import errno
import json
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from tests.outputs import names_in, paths_below

from rangesfm.errors import InputError
from rangesfm.util.files.atomic import new_file, new_folder, require_apart, scratch_folder, write_text
from rangesfm.util.files.output_folder import PRIVATE_NAME, sole_writer

ROOT = Path(__file__).parents[3]
KILLED_IN_PUBLISHING = """
import os, signal, sys
from pathlib import Path
from tests.util.files.test_atomic import TestPublishing

left, rename = {num_renames}, os.rename

def rename_or_die(source, target):
    global left
    if left == 0:
        os.kill(os.getpid(), signal.SIGKILL)
    left -= 1
    rename(source, target)

os.rename = rename_or_die
TestPublishing().write(Path(sys.argv[1]), "new")
os.kill(os.getpid(), signal.SIGKILL)
"""


def interrupting_once(function: Callable[..., Any]) -> Callable[..., Any]:
    """Wrap a function so that its first call is interrupted by Ctrl-C."""
    is_first = True

    def called(*arguments: Any, **options: Any) -> None:
        nonlocal is_first
        if is_first:
            is_first = False
            raise KeyboardInterrupt
        function(*arguments, **options)

    return called


class TestNewFile:
    def test_replaces_what_it_wrote_itself_and_nothing_else(self, tmp_path: Path) -> None:
        for text in ("first", "second"):
            write_text(text, tmp_path / "a.csv")
        (tmp_path / "a.csv").write_text("mine")
        with pytest.raises(InputError, match=r"a\.csv: is not a file that rangesfm wrote, or has changed since"):
            write_text("third", tmp_path / "a.csv")
        assert (tmp_path / "a.csv").read_text() == "mine"

    def test_knows_its_own_file_in_a_copy_of_the_folder(self, tmp_path: Path) -> None:
        (tmp_path / "here").mkdir()
        write_text("first", tmp_path / "here" / "a.csv")
        shutil.copytree(tmp_path / "here", tmp_path / "there", copy_function=shutil.copyfile)
        write_text("second", tmp_path / "there" / "a.csv")
        assert (tmp_path / "there" / "a.csv").read_text() == "second"

    def test_is_refused_before_anything_is_computed(self, tmp_path: Path) -> None:
        (tmp_path / "a.csv").write_text("mine")
        with pytest.raises(InputError), new_file(tmp_path / "a.csv"):
            pytest.fail("the block was entered")

    @pytest.mark.parametrize("kind", ["link", "dead link", "folder", "pipe"])
    def test_replaces_no_link_folder_or_pipe(self, kind: str, tmp_path: Path) -> None:
        path, other = tmp_path / "a.csv", tmp_path / "other"
        if kind == "folder":
            path.mkdir()
        elif kind == "pipe":
            os.mkfifo(path)
        else:
            path.symlink_to(other)
        if kind == "link":
            other.write_text("mine")
        with pytest.raises(InputError, match=r"a\.csv: is "):
            write_text("new", path)
        assert names_in(tmp_path) == (["a.csv", "other"] if kind == "link" else ["a.csv"])
        assert kind != "link" or other.read_text() == "mine"

    def test_does_not_follow_a_link_that_stands_for_a_folder_of_the_output(self, tmp_path: Path) -> None:
        (tmp_path / "elsewhere").mkdir()
        (tmp_path / "out").mkdir()
        (tmp_path / "out" / "figures").symlink_to(tmp_path / "elsewhere")
        with pytest.raises(InputError, match="is a link, expected a folder"), sole_writer(tmp_path / "out") as output:
            output.require_own([output.path / "figures" / "scale.png"])

    @pytest.mark.parametrize("name", [".a.csv.20240101.part.csv", ".bashrc.20240101.old", ".mozilla.20210101.old"])
    def test_leaves_hidden_files_alone_whatever_they_are_called(self, name: str, tmp_path: Path) -> None:
        (tmp_path / name).write_text("mine")
        write_text("new", tmp_path / "a.csv")
        with sole_writer(tmp_path):
            pass
        assert (tmp_path / name).read_text() == "mine"

    def test_leaves_what_is_in_the_place_of_its_own_folder(self, tmp_path: Path) -> None:
        (tmp_path / PRIVATE_NAME).write_text("mine")
        with pytest.raises(InputError, match="expected rangesfm's own folder or nothing here"):
            write_text("new", tmp_path / "a.csv")
        assert (tmp_path / PRIVATE_NAME).read_text() == "mine"

    @pytest.mark.parametrize("name", ["manifest.json", "lock"])
    def test_leaves_what_is_in_the_place_of_its_own_files(self, name: str, tmp_path: Path) -> None:
        (tmp_path / PRIVATE_NAME).mkdir()
        (tmp_path / PRIVATE_NAME / name).write_text("mine")
        with pytest.raises(InputError, match=f"{name}: is .*move it away, or give another output path"):
            write_text("new", tmp_path / "a.csv")
        assert (tmp_path / PRIVATE_NAME / name).read_text() == "mine"

    def test_names_the_file_that_a_full_disk_has_no_room_for(self, tmp_path: Path) -> None:
        with pytest.raises(OSError, match="No space left") as caught, new_file(tmp_path / "a.csv"):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        assert caught.value.filename == str(tmp_path / "a.csv")


def test_a_disk_with_no_room_for_the_record_is_named_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr("rangesfm.util.files.manifest.Manifest.save", full)
    with pytest.raises(OSError, match="No space left") as caught:
        write_text("new", tmp_path / "a.csv")
    assert caught.value.filename == str(tmp_path / "a.csv")
    assert names_in(tmp_path) == []


@pytest.mark.parametrize("output", ["in.csv", "link/in.csv", "folder", "folder/new.csv"])
def test_no_output_is_an_input_or_inside_one(output: str, tmp_path: Path) -> None:
    (tmp_path / "in.csv").touch()
    (tmp_path / "folder").mkdir()
    (tmp_path / "link").symlink_to(tmp_path)
    with pytest.raises(InputError, match="the result would overwrite this input"):
        require_apart([tmp_path / "in.csv", tmp_path / "folder"], tmp_path / output)
    require_apart([tmp_path / "in.csv", tmp_path / "folder"], tmp_path / "new.csv")


class TestScratchFolder:
    @pytest.mark.parametrize("when", ["made", "used", "removed"])
    def test_is_gone_after_ctrl_c(self, when: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        def make_and_interrupt(path: Path, *arguments: Any, **options: Any) -> None:
            make(path, *arguments, **options)
            raise KeyboardInterrupt

        make = Path.mkdir
        if when == "made":
            monkeypatch.setattr(Path, "mkdir", make_and_interrupt)

        def use() -> None:
            with scratch_folder(tmp_path / "a"):
                if when == "used":
                    raise KeyboardInterrupt
                monkeypatch.setattr(shutil, "rmtree", interrupting_once(shutil.rmtree))

        with pytest.raises(KeyboardInterrupt):
            use()
        assert list(tmp_path.iterdir()) == []


class TestNewFolder:
    def test_takes_the_place_of_the_old_one(self, tmp_path: Path) -> None:
        for text in "ab":
            with new_folder(tmp_path / "a") as folder:
                (folder / text).write_text(text)
        assert [path.name for path in paths_below(tmp_path)] == ["a", "b"]

    @pytest.mark.parametrize("num_renames", [1, 2])
    @pytest.mark.parametrize("error", [KeyboardInterrupt, PermissionError])
    def test_leaves_the_old_one_when_interrupted(
        self, num_renames: int, error: type[BaseException], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        with new_folder(tmp_path / "a") as folder:
            (folder / "old").write_text("")
        num = 0

        def rename_and_interrupt(source: Path, target: Path) -> None:
            nonlocal num
            rename(source, target)
            num += 1
            if num == num_renames:
                raise error

        rename = os.rename
        monkeypatch.setattr(os, "rename", rename_and_interrupt)
        with pytest.raises(error), new_folder(tmp_path / "a") as folder:
            (folder / "new").write_text("")
        assert [path.name for path in paths_below(tmp_path)] == ["a", "old"]
        with new_folder(tmp_path / "a") as folder:
            (folder / "new").write_text("")


class TestPublishing:
    """Publishing several files and folders in one step: ``result.json`` goes first and comes last."""

    NAMES = ("model", "result.json", "table.csv")

    def write(self, folder: Path, text: str) -> None:
        with sole_writer(folder) as output, scratch_folder(folder / "staged") as staged:
            (staged / "model").mkdir()
            for name in ("model/a.bin", "result.json", "table.csv"):
                (staged / name).write_text(text)
            new = {output.path / name: staged / name for name in self.NAMES}
            output.publish(new, [output.path / "gone.csv"], last=output.path / "result.json")

    def texts(self, folder: Path) -> set[str]:
        return {path.read_text() for path in paths_below(folder) if path.is_file()}

    @pytest.mark.parametrize("num_renames", range(8))
    def test_of_a_process_killed_in_between_is_finished_by_the_next(self, num_renames: int, tmp_path: Path) -> None:
        self.write(tmp_path, "old")
        with sole_writer(tmp_path):
            write_text("old", tmp_path / "gone.csv")
        program = KILLED_IN_PUBLISHING.format(num_renames=num_renames)
        done = subprocess.run([sys.executable, "-c", program, str(tmp_path)], cwd=ROOT, check=False)
        assert done.returncode == -signal.SIGKILL
        has_result = (tmp_path / "result.json").exists()
        assert not has_result or self.texts(tmp_path) in ({"old"}, {"new"})
        with sole_writer(tmp_path):
            pass
        assert self.texts(tmp_path) == {"new"}
        assert names_in(tmp_path) == [*self.NAMES]
        self.write(tmp_path, "newest")
        assert self.texts(tmp_path) == {"newest"}

    def test_is_not_finished_over_a_file_that_somebody_put_there_meanwhile(self, tmp_path: Path) -> None:
        self.write(tmp_path, "old")
        program = KILLED_IN_PUBLISHING.format(num_renames=1)
        subprocess.run([sys.executable, "-c", program, str(tmp_path)], cwd=ROOT, check=False)
        (tmp_path / "table.csv").write_text("mine")
        with pytest.raises(InputError, match=r"table\.csv: is not a file that rangesfm wrote"), sole_writer(tmp_path):
            pytest.fail("the block was entered")
        assert (tmp_path / "table.csv").read_text() == "mine"

    def test_removes_nothing_that_is_not_its_own(self, tmp_path: Path) -> None:
        self.write(tmp_path, "old")
        (tmp_path / "gone.csv").write_text("mine")
        with pytest.raises(InputError, match=r"gone\.csv: is not a file that rangesfm wrote"):
            self.write(tmp_path, "new")
        assert self.texts(tmp_path) == {"old", "mine"}

    @pytest.mark.parametrize("target", ["../outside.csv", "/outside.csv", "a\0", "\ud800", ".", 7, None])
    def test_a_record_that_names_places_outside_is_refused(self, target: object, tmp_path: Path) -> None:
        self.write(tmp_path / "out", "old")
        record = tmp_path / "out" / PRIVATE_NAME / "manifest.json"
        content = json.loads(record.read_text())
        content["moves"] = [["parts/", "ours.csv"], ["", target]]
        record.write_text(json.dumps(content))
        (tmp_path / "outside.csv").write_text("mine")
        with pytest.raises(InputError, match="is not a record of written files"):
            self.write(tmp_path / "out", "new")
        assert (tmp_path / "outside.csv").read_text() == "mine"


@pytest.mark.parametrize(
    "locale", [{"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}, {"PYTHONUTF8": "1"}]
)
def test_path_that_a_file_names_is_found_in_any_locale(locale: dict[str, str], tmp_path: Path) -> None:
    (tmp_path / "bildär").touch()
    found = "import os; from rangesfm.util.files.atomic import path_of; assert os.path.isfile(path_of('bild\\xe4r'))"
    subprocess.run([sys.executable, "-c", found], cwd=tmp_path, env={**os.environ, **locale}, check=True)
