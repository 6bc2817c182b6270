"""The command line. It alone prints, and it turns all errors into messages and exit statuses."""

from __future__ import annotations

import _thread
import io
import mmap
import os
import signal
import sys
import threading
import traceback
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

from rangesfm.cli.arguments import Outcome, normalize, parse
from rangesfm.cli.terminal import discard_output, terminal_progress
from rangesfm.errors import INTERNAL_ERROR, InputError, failure_of, one_line
from rangesfm.util.processes.threads import settle_num_threads

_BROKEN_PIPE = 141  # exit status after a broken pipe, the one that shells use
# Address space that the libraries take when they are loaded, in bytes: 600 MB with one BLAS thread (ulimit -v).
_NEEDED_ADDRESS_SPACE = 600 * 1000**2


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command and return its exit status. Only this function turns errors into messages."""
    # The matrices that numpy and scipy get here are small. Threads make them slower, much slower beside other work.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    # COLMAP's log would go to the terminal and to files in the temporary folder of the system. Where it is wanted, it
    # is turned on for a while (rangesfm.colmap.colmap_log). Code that calls COLMAP reports its failures itself.
    os.environ.setdefault("GLOG_minloglevel", "3")
    _open_closed_streams()
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):  # a name that the locale cannot encode must not be an error
            stream.reconfigure(errors="backslashreplace")
    try:
        try:
            os.getcwd()
        except FileNotFoundError:
            raise InputError("the working folder has been deleted: change to one that exists") from None
        mmap.mmap(-1, _NEEDED_ADDRESS_SPACE).close()  # an OSError here, not a crash or a library that waits for ever
        settle_num_threads()
        try:
            args = parse(normalize(sys.argv[1:] if argv is None else argv))
        except SystemExit as ended:  # by -h, --help or --version, with the text to print
            _print([str(ended.code)])
            return 0
        if args.command != "doctor":  # doctor reports on the versions in more detail
            from rangesfm.installed_versions import check_versions

            check_versions()
        with _sigterm_as_ctrl_c(), terminal_progress(sys.stderr, quiet=args.quiet) as progress:
            outcome: Outcome = args.execute(args, progress)
        _print(outcome.lines)
        return outcome.status
    except BrokenPipeError:
        discard_output(sys.stdout)
        return _BROKEN_PIPE
    except (Exception, KeyboardInterrupt) as error:
        failure = failure_of(error)
        if failure.exit_status == INTERNAL_ERROR and os.environ.get("RANGESFM_DEBUG"):
            traceback.print_exc()
        try:
            text = "\n  ".join([failure.message, *failure.advice])
            print("rangesfm: error:", text, file=sys.stderr, flush=True)
        except OSError:  # the exit status says enough
            discard_output(sys.stderr)
        return failure.exit_status


def _open_closed_streams() -> None:
    """Let standard streams that the shell has closed lead nowhere.

    Otherwise the first file that is opened gets the number of such a stream, and with it what libraries print there.
    Python has None for such a stream; numpy 2.0 and others expect a file.
    """
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # gets the smallest free number
        if getattr(sys, name) is None:
            setattr(sys, name, os.fdopen(number, "w" if number else "r", encoding="utf-8", closefd=False))


def _print(texts: Sequence[str]) -> None:
    """Print texts, each of one line or several, on standard output."""
    try:
        print("".join(f"{one_line(line)}\n" for text in texts for line in text.split("\n")), end="", flush=True)
    except BrokenPipeError:
        raise
    except OSError as error:
        error.filename = "standard output"
        discard_output(sys.stdout)
        raise


@contextmanager
def _sigterm_as_ctrl_c() -> Iterator[None]:
    """Make SIGTERM end the work inside the block as Ctrl-C does.

    Once pycolmap and pyceres are imported, they treat SIGTERM as a crash and print a stack trace. So the signal is
    blocked, which keeps it from all handlers. A thread waits for it and calls Python's own handler.
    """
    if sys.platform == "win32" or threading.current_thread() is not threading.main_thread():
        yield
        return
    has_ended = threading.Event()

    def wait() -> None:
        while signal.sigwait({signal.SIGTERM}) and not has_ended.is_set():
            _thread.interrupt_main(signal.SIGTERM)

    handler = signal.signal(signal.SIGTERM, signal.default_int_handler)
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGTERM})
    waiting = threading.Thread(target=wait, daemon=True)
    waiting.start()
    try:
        yield
    finally:
        has_ended.set()
        signal.pthread_kill(waiting.ident or 0, signal.SIGTERM)
        waiting.join()
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        signal.signal(signal.SIGTERM, handler)
