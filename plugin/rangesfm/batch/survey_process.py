"""One survey of a batch, in a process of its own."""

from __future__ import annotations

import sys
from typing import Any

from rangesfm.progress import Progress
from rangesfm.survey.settings import Survey


def run_in_batch(survey: Survey, restart: bool, progress: Progress) -> dict[str, Any]:
    """Run a survey and return its figures as plain values: ``{"figures": ..., "reason": ...}``."""
    # The lock of the output folder names this command to other processes.
    sys.argv = ["rangesfm", "batch", str(survey.source.path)]
    from rangesfm.batch.batch_state import figures_of
    from rangesfm.pipeline.run import run_survey

    summary = run_survey(survey, progress=progress, restart=restart).summary
    reasons = summary.scale.reasons if summary.scale.verdict != "good" else ()
    return {"figures": figures_of(summary), "reason": "; ".join(reasons)}
