"""Error messages are one line, whatever names the files hold."""

from __future__ import annotations

from pathlib import Path

from rangesfm.errors import Failure, InputError, failure_of


def test_want_of_memory_is_told_by_whatever_came_of_it() -> None:
    later = RuntimeError("cannot import the backend")
    later.__cause__ = ImportError("numpy.so: failed to map segment from shared object")
    assert failure_of(later) == Failure("out of memory", 4)
    assert failure_of(RuntimeError("can't start new thread")) == Failure("out of memory", 4)
    assert failure_of(RuntimeError("something else")).exit_status == 1


def test_ctrl_c_in_the_midst_of_an_import_is_no_error_of_the_library() -> None:
    later = RuntimeError("cannot import the backend")
    later.__context__ = ImportError("initialization failed")
    later.__context__.__cause__ = KeyboardInterrupt()
    assert failure_of(later).exit_status == 130


def test_message_has_nothing_that_a_terminal_obeys() -> None:
    error = InputError("anchor 'A\x1b[2J\r\nB\u202e\x00' stands twice", Path("a\nb.csv"), 3)
    assert str(error) == "a b.csv:3: anchor 'A?[2J  B??' stands twice"
    assert error.path == Path("a\nb.csv")
