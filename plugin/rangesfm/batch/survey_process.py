"""One survey in a process of its own: what ``python -m rangesfm.batch.survey_process PARENT`` does.

A worker starts it, so that a crash of the survey leaves the worker whole, what the survey needs of memory is known, and
it can be interrupted. It is given a (survey, restart, whether only to prepare it), and ends with the survey's figures
or with the submaps that are to be mapped.
"""

from __future__ import annotations

import base64
import pickle
import sys
from dataclasses import asdict
from typing import Any

from rangesfm.processes.supervision import MessagesToParent, work_for_parent
from rangesfm.survey.settings import Survey


def _run(given: tuple[Survey, bool, bool], worker: MessagesToParent) -> dict[str, Any]:
    survey, restart, only_prepare = given
    sys.argv = ["rangesfm", "batch", str(survey.source.path)]  # by which others know who writes to its folder
    from rangesfm.batch.course import figures_of
    from rangesfm.workflows.run import prepare_survey, run_survey

    if only_prepare:
        submaps = prepare_survey(survey, progress=worker, restart=restart)
        return {"submaps": base64.b64encode(pickle.dumps(submaps)).decode()}
    summary = run_survey(survey, progress=worker, restart=restart).summary
    reasons = summary.scale.reasons if summary.scale.verdict != "good" else ()
    return {"figures": asdict(figures_of(summary)), "reason": "; ".join(reasons)}


if __name__ == "__main__":
    work_for_parent(_run)
