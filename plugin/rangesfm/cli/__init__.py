"""The command line: the only place that prints, and the one place where errors end."""

from __future__ import annotations

import io
import os
import sys
import traceback
from collections.abc import Sequence

from rangesfm.cli.arguments import Outcome, normalize, parse
from rangesfm.cli.terminal import terminal_progress
from rangesfm.errors import INTERNAL_ERROR, failure_of, one_line

_BROKEN_PIPE = 141  # as shells have it


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command; return its exit status. Only this function turns errors into messages."""
    # numpy's and scipy's matrices are small here: threads make them slower, and many times so beside other work.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    # COLMAP's log would go to the terminal and to files in the system's temporary folder. Where it is wanted, it is
    # turned on for so long (rangesfm.colmap.log); what fails is told by whoever called COLMAP.
    os.environ.setdefault("GLOG_minloglevel", "3")
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):  # whatever the locale, a name that it cannot spell is no failure
            stream.reconfigure(errors="backslashreplace")
    try:
        args = parse(normalize(sys.argv[1:] if argv is None else argv))
        if args.command != "doctor":  # which says more
            from rangesfm.installed_versions import check_versions

            check_versions()
        # There is no sys.stderr where the shell closed it.
        with terminal_progress(sys.stderr or io.StringIO(), quiet=args.quiet) as progress:
            outcome: Outcome = args.execute(args, progress)
        # A table is one text of several lines.
        print("\n".join(one_line(line) for text in outcome.lines for line in text.split("\n")), flush=True)
        return outcome.status
    except SystemExit as ended:  # --help and --version
        return int(ended.code or 0)
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # or Python complains when it exits
        return _BROKEN_PIPE
    except (Exception, KeyboardInterrupt) as error:
        failure = failure_of(error)
        if failure.exit_status == INTERNAL_ERROR and os.environ.get("RANGESFM_DEBUG"):
            traceback.print_exc()
        print("rangesfm: error:", "\n  ".join([failure.message, *failure.advice]), file=sys.stderr)
        return failure.exit_status
