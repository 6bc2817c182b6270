from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from rangesfm.files.output_folder import LOCK_NAME, PRIVATE_NAME
from rangesfm.vision.steps import Steps, fingerprint

if TYPE_CHECKING:
    from tests.vision.conftest import Listener

Run = Callable[..., list[str]]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A folder in which everything belongs to the tool."""
    (tmp_path / PRIVATE_NAME).mkdir()
    (tmp_path / LOCK_NAME).touch()
    return tmp_path / PRIVATE_NAME


@pytest.fixture
def run(folder: Path, listener: Listener) -> Run:
    """Return a function that runs steps a and b and lists what was done: "prepare a", "work a", ..."""
    tmp_path = folder

    def run_both(
        a: str = "1", b: str = "1", *, forget: str | None = None, interrupted_in: str | None = None
    ) -> list[str]:
        steps = Steps(tmp_path / "steps.json", listener)
        done: list[str] = []
        if forget is not None:
            steps.forget(forget)

        def do(what: str) -> None:
            done.append(what)
            (tmp_path / what[-1]).touch()
            if what == interrupted_in:
                raise KeyboardInterrupt

        try:
            for name, inputs in (("a", a), ("b", b)):
                steps.run(
                    name,
                    inputs,
                    tmp_path / name,
                    lambda name=name: do(f"prepare {name}"),  # type: ignore[misc]
                    lambda name=name: do(f"work {name}"),  # type: ignore[misc]
                )
        except KeyboardInterrupt:
            done.append("interrupted")
        else:
            assert set(steps.seconds) == {what[-1] for what in done}
        return done

    return run_both


ALL = ["prepare a", "work a", "prepare b", "work b"]


def test_steps_are_done_once(run: Run, listener: Listener) -> None:
    assert run() == ALL
    assert run() == []
    assert listener.stages == ["a", "b"]
    assert listener.messages == ["a: taken over from an earlier run", "b: taken over from an earlier run"]


def test_a_step_with_other_inputs_is_done_anew_and_all_after_it(run: Run) -> None:
    run()
    assert run(b="2") == ["prepare b", "work b"]
    assert run(a="2", b="2") == ALL


def test_a_forgotten_step_is_done_anew_and_all_after_it(run: Run) -> None:
    run()
    assert run(forget="a") == ALL
    assert run(forget="b") == ["prepare b", "work b"]


def test_an_interrupted_step_goes_on_without_preparation(run: Run) -> None:
    assert run(interrupted_in="work b") == [*ALL, "interrupted"]
    assert run() == ["work b"]
    assert run() == []


def test_what_an_interrupted_step_has_to_go_on_from_may_be_elsewhere(tmp_path: Path, listener: Listener) -> None:
    steps, prepared = Steps(tmp_path / "steps.json", listener), []

    def work() -> None:
        (tmp_path / "unfinished").touch()
        raise KeyboardInterrupt

    for left_by_then in ([], ["unfinished"]):
        assert [path.name for path in tmp_path.glob("unf*")] == left_by_then
        with pytest.raises(KeyboardInterrupt):
            steps.run(
                "a",
                "1",
                tmp_path / "done",
                lambda: prepared.append("once"),
                work,
                unfinished=tmp_path / "unfinished",
            )
    assert prepared == ["once"]


def test_an_interrupted_step_with_other_inputs_is_prepared_again(run: Run) -> None:
    run(interrupted_in="work b")
    assert run(b="2") == ["prepare b", "work b"]


def test_an_interrupted_preparation_is_repeated_and_nothing_of_before_is_believed(run: Run) -> None:
    run()
    assert run(a="2", interrupted_in="prepare a") == ["prepare a", "interrupted"]
    assert run() == ALL


@pytest.mark.parametrize(("lost", "done"), [("b", ["prepare b", "work b"]), ("a", ALL), ("steps.json", ALL)])
def test_what_is_lost_is_done_anew(run: Run, folder: Path, lost: str, done: list[str]) -> None:
    run()
    (folder / lost).unlink()
    assert run() == done


@pytest.mark.parametrize(
    "text", ["", "{", "[1]", '{"a": 1}', '{"steps": {"a": 1}}', '{"steps": {"a": {"inputs": ["1"]}}}']
)
def test_a_damaged_record_is_no_record(run: Run, folder: Path, text: str) -> None:
    run()
    (folder / "steps.json").write_text(text)
    assert run() == ALL


def test_notes_outlive_the_steps(tmp_path: Path, listener: Listener) -> None:
    steps = Steps(tmp_path / "steps.json", listener)
    steps.run("a", "1", tmp_path, lambda: None, lambda: None)
    steps.note("photos", {"a.jpg": [1, 2]})
    steps.forget("a")
    assert Steps(tmp_path / "steps.json", listener).notes == {"photos": {"a.jpg": [1, 2]}}


def test_fingerprints_tell_values_apart_but_not_the_order_of_keys() -> None:
    assert fingerprint({"a": 1, "b": [1.5, None]}) == fingerprint({"b": [1.5, None], "a": 1})
    assert len({fingerprint(x) for x in (1, 1.5, "1", [1], None, {"a": 1}, {"a": 2})}) == 7
