"""``python -m rangesfm``."""

import sys

from rangesfm.cli import main

sys.exit(main())
