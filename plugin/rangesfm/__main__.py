"""Entry point of ``python -m rangesfm``."""

import os
import sys


def _leave_out_working_folder() -> None:
    """Take the working folder off the import path, where ``python -m`` puts it first.

    A survey folder from somebody else may hold a file numpy.py, which Python would otherwise import and run.
    """
    is_safe = getattr(sys.flags, "safe_path", sys.flags.isolated)  # safe_path exists from Python 3.11 on
    try:
        if not is_safe and sys.path[:1] == [os.getcwd()]:
            del sys.path[0]
    except FileNotFoundError:  # the working folder has been deleted, so it cannot be on the path
        pass


def _main() -> int:
    _leave_out_working_folder()
    from rangesfm.cli import main

    return main()


sys.exit(_main())
