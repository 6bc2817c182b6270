"""What a user reads is one line, whatever names the files hold."""

from __future__ import annotations

from pathlib import Path

from rangesfm.errors import InputError


def test_message_has_nothing_that_a_terminal_obeys() -> None:
    error = InputError("anchor 'A\x1b[2J\r\nB\u202e\x00' stands twice", Path("a\nb.csv"), 3)
    assert str(error) == "a b.csv:3: anchor 'A?[2J  B??' stands twice"
    assert error.path == Path("a\nb.csv")
