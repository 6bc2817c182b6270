"""Files and folders that appear whole or not at all."""

from __future__ import annotations

import errno
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from rangesfm.files.atomic import new_file, new_folder, scratch_folder


def interrupting_once(function: Callable[..., Any]) -> Callable[..., Any]:
    """The function, its first call ended by Ctrl-C."""
    is_first = True

    def called(*arguments: Any, **options: Any) -> None:
        nonlocal is_first
        if is_first:
            is_first = False
            raise KeyboardInterrupt
        function(*arguments, **options)

    return called


class TestNewFile:
    def test_clears_away_what_killed_processes_left_of_the_same_file(self, tmp_path: Path) -> None:
        ended = subprocess.Popen([sys.executable, "-c", ""])
        ended.wait()
        dead, alive, other = (
            tmp_path / name for name in (f".a.{ended.pid}.part.csv", f".a.{os.getppid()}.part.csv", ".b.1.part.csv")
        )
        for path in (dead, alive, other):
            path.write_text("half")
        with new_file(tmp_path / "a.csv") as temporary:
            temporary.write_text("whole")
        assert sorted(tmp_path.iterdir()) == sorted([alive, other, tmp_path / "a.csv"])

    def test_names_the_file_that_a_full_disk_has_no_room_for(self, tmp_path: Path) -> None:
        with pytest.raises(OSError, match="No space left") as caught, new_file(tmp_path / "a.csv"):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        assert caught.value.filename == str(tmp_path / "a.csv")


class TestScratchFolder:
    def test_is_there_and_then_gone(self, tmp_path: Path) -> None:
        with scratch_folder(tmp_path / "a") as folder:
            (folder / "file").write_text("x")
            assert folder.parent == tmp_path
        assert list(tmp_path.iterdir()) == []

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
        assert [path.name for path in tmp_path.rglob("*")] == ["a", "b"]

    def test_leaves_the_old_one_when_interrupted(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        with new_folder(tmp_path / "a") as folder:
            (folder / "old").write_text("")

        def rename_and_interrupt(path: Path, target: Path) -> Path:
            monkeypatch.setattr(Path, "rename", rename)
            rename(path, target)
            raise KeyboardInterrupt

        rename = Path.rename
        monkeypatch.setattr(Path, "rename", rename_and_interrupt)
        with pytest.raises(KeyboardInterrupt), new_folder(tmp_path / "a") as folder:
            (folder / "new").write_text("")
        assert [path.name for path in tmp_path.rglob("*")] == ["a", "old"]


@pytest.mark.parametrize(
    "locale", [{"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}, {"PYTHONUTF8": "1"}]
)
def test_path_that_a_file_names_is_found_in_any_locale(locale: dict[str, str], tmp_path: Path) -> None:
    (tmp_path / "bildär").touch()
    found = "import os; from rangesfm.files.atomic import path_of; assert os.path.isfile(path_of('bild\\xe4r'))"
    subprocess.run([sys.executable, "-c", found], cwd=tmp_path, env={**os.environ, **locale}, check=True)
