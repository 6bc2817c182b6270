"""``python -m rangesfm``."""

import os
import sys


def _leave_out_working_folder() -> None:
    """Import nothing from the working folder from here on, where ``python -m`` has put it first on the path.

    A survey that somebody sent may hold a numpy.py, which would be imported and so run.
    """
    is_safe = getattr(sys.flags, "safe_path", sys.flags.isolated)  # the first is known from Python 3.11 on
    try:
        if not is_safe and sys.path[:1] == [os.getcwd()]:
            del sys.path[0]
    except FileNotFoundError:  # the working folder has been deleted, and so is not on the path
        pass


def _main() -> int:
    _leave_out_working_folder()
    from rangesfm.cli import main

    return main()


sys.exit(_main())
