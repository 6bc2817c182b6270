"""One survey in a process of its own: what this module does, run by ``rangesfm.processes.supervision``.

A worker starts it, so that a crash of the survey leaves the worker whole, what the survey needs of memory is known, and
it can be interrupted. It is given a (survey, restart), and ends with the survey's figures.
"""

from __future__ import annotations

import sys
from typing import Any

from rangesfm.processes.supervision import MessagesToParent, work_for_parent
from rangesfm.survey.settings import Survey


def _run(given: tuple[Survey, bool], worker: MessagesToParent) -> dict[str, Any]:
    survey, restart = given
    sys.argv = ["rangesfm", "batch", str(survey.source.path)]  # by which others know who writes to its folder
    from rangesfm.batch.course import figures_of
    from rangesfm.workflows.run import metric_map_of

    summary = metric_map_of(survey, progress=worker, restart=restart).summary
    reasons = summary.scale.reasons if summary.scale.verdict != "good" else ()
    return {"figures": figures_of(summary), "reason": "; ".join(reasons)}


if __name__ == "__main__":
    work_for_parent(_run)
