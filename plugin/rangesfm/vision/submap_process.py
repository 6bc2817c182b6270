"""One submap mapped in a process of its own: what ``python -m rangesfm.vision.submap_process PARENT`` does."""

from __future__ import annotations

import sys

from rangesfm.processes.supervision import MessagesToParent, work_for_parent
from rangesfm.vision.submaps import Submap


def _run(submap: Submap, parent: MessagesToParent) -> None:
    sys.argv = ["rangesfm", "submap", str(submap.folder)]  # by which others know who writes to its folder
    submap.map(parent)


if __name__ == "__main__":
    work_for_parent(_run)
