"""Matching of pairs that may be loops, by the options of a survey."""

from __future__ import annotations

import pycolmap

from rangesfm.progress import Progress
from rangesfm.sfm.loop_database import LoopMatching
from rangesfm.sfm.matching import matching_options
from rangesfm.sfm.steps import DATABASE_NAME
from rangesfm.survey.settings import Survey
from rangesfm.util.files.output_folder import OutputFolder


def loop_matching(survey: Survey, progress: Progress, output: OutputFolder) -> LoopMatching | None:
    """Return the matching of a survey; None where loops are not to be closed."""
    is_given = survey.images.model is not None
    source = survey.mapper.database_path if is_given else output.newest(output.path / DATABASE_NAME)
    if not survey.mapper.close_loops or source is None or not source.is_file():
        return None
    with pycolmap.Database.open(source) as database:
        num_photos = database.num_images()
    options = matching_options(survey.mapper, num_photos, survey.output.seed)
    return LoopMatching(source, options, progress, output) if is_given or options.is_in_time_only else None
