"""One survey of a batch in a process of its own, run as a module by ``rangesfm.processes.supervision``.

A worker starts it. A crash of the survey then does not affect the worker, the survey's memory is known, and the survey
can be interrupted. The process is given a tuple (survey, restart), and its result is the survey's figures.
"""

from __future__ import annotations

import sys
from typing import Any

from rangesfm.processes.supervision import work_for_parent
from rangesfm.progress import Progress
from rangesfm.survey.settings import Survey


def _run(given: tuple[Survey, bool], progress: Progress) -> dict[str, Any]:
    survey, restart = given
    # The lock of the output folder names this command to other processes.
    sys.argv = ["rangesfm", "batch", str(survey.source.path)]
    from rangesfm.batch.batch_state import figures_of
    from rangesfm.workflows.run import run_survey

    summary = run_survey(survey, progress=progress, restart=restart).summary
    reasons = summary.scale.reasons if summary.scale.verdict != "good" else ()
    return {"figures": figures_of(summary), "reason": "; ".join(reasons)}


if __name__ == "__main__":
    work_for_parent(_run)
