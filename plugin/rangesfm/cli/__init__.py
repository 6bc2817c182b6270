"""The command line: the only place that prints, and the one place where errors end."""

from __future__ import annotations

import errno
import io
import os
import sys
import traceback
from collections.abc import Sequence

from rangesfm.cli.arguments import Outcome, normalize, parse
from rangesfm.cli.terminal import terminal_progress
from rangesfm.errors import RangesfmError, one_line

_BAD_INPUT, _FAILED = 2, 4
_INTERNAL_ERROR, _INTERRUPTED, _BROKEN_PIPE = 1, 130, 141  # as shells have it
_UNUSABLE_PATH = (errno.EACCES, errno.EPERM, errno.EROFS, errno.ENOENT, errno.ENOTDIR, errno.EISDIR, errno.ENAMETOOLONG)


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command; return its exit status. Only this function turns errors into messages."""
    # numpy's and scipy's matrices are small here: threads make them slower, and many times so beside other work.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):  # whatever the locale, a name that it cannot spell is no failure
            stream.reconfigure(errors="backslashreplace")
    try:
        args = parse(normalize(sys.argv[1:] if argv is None else argv))
        # There is no sys.stderr where the shell closed it.
        with terminal_progress(sys.stderr or io.StringIO(), quiet=args.quiet) as progress:
            outcome: Outcome = args.execute(args, progress)
        print("\n".join(map(one_line, outcome.lines)), flush=True)
        return outcome.status
    except SystemExit as ended:  # --help and --version
        return int(ended.code or 0)
    except RangesfmError as error:
        return _fail(str(error), error.exit_status)
    except KeyboardInterrupt:
        return _fail("interrupted; stages that were done are kept", _INTERRUPTED)
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # or Python complains when it exits
        return _BROKEN_PIPE
    except OSError as error:
        where = f"{error.filename}: " if error.filename is not None else ""
        return _fail(f"{where}{error.strerror or error}", _BAD_INPUT if error.errno in _UNUSABLE_PATH else _FAILED)
    except MemoryError:
        return _fail("out of memory", _FAILED)
    except Exception as error:
        if os.environ.get("RANGESFM_DEBUG"):
            traceback.print_exc()
        message = f"internal error, please report it (RANGESFM_DEBUG=1 shows where): {type(error).__name__}: {error}"
        return _fail(message, _INTERNAL_ERROR)


def _fail(message: str, status: int) -> int:
    print("rangesfm: error:", " ".join(one_line(message).split()), file=sys.stderr)
    return status
