"""The command that runs the checkers fails with what the failed checker says."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest
from tests import checkers


def test_the_output_of_a_checker_that_fails_is_printed(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    finds_something = (sys.executable, "-c", "print('a.py:3: too long'); exit(2)")
    finds_nothing = (sys.executable, "-c", "print('all fine')")
    monkeypatch.setattr(checkers, "configure_cpp", lambda build: None)
    monkeypatch.setattr(checkers, "simple_checkers", lambda: [finds_nothing])
    monkeypatch.setattr(checkers, "clang_tidy", lambda build: [finds_something])
    assert checkers.main() == 1
    printed = capsys.readouterr().out
    assert "a.py:3: too long" in printed
    assert "all fine" not in printed
    monkeypatch.setattr(checkers, "clang_tidy", lambda build: [finds_nothing])
    assert checkers.main() == 0


def test_a_source_of_no_target_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    bundle = tmp_path / "unity.cxx"
    bundle.write_text('#include "/source/a.cc"\n')
    (tmp_path / "compile_commands.json").write_text(f'[{{"file": "{bundle}"}}]')
    monkeypatch.setattr(checkers, "CPP_SOURCES", [Path("/source/a.cc"), Path("/source/forgotten.cc")])
    with pytest.raises(SystemExit, match=r"forgotten\.cc is in no target"):
        checkers.clang_tidy(tmp_path)
