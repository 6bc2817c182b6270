"""Matching of pairs that may be loops, by the options of a survey."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import pycolmap

from rangesfm.arrays import Indices
from rangesfm.files.output_folder import OutputFolder
from rangesfm.progress import Progress
from rangesfm.survey.settings import Survey
from rangesfm.vision.loop_database import LoopDatabase, Pair
from rangesfm.vision.matching import MatchingOptions, matching_options
from rangesfm.vision.steps import DATABASE_NAME


@dataclass(frozen=True)
class LoopMatching:
    """A copy of a survey's database to which pairs are added, with what matches them."""

    database: LoopDatabase
    options: MatchingOptions
    progress: Progress

    @classmethod
    def for_survey(cls, survey: Survey, progress: Progress, output: OutputFolder) -> LoopMatching | None:
        """Return the matching of a survey; None where loops are not to be closed."""
        is_given = survey.images.model is not None
        source = survey.mapper.database_path if is_given else output.newest(output.path / DATABASE_NAME)
        if not survey.mapper.close_loops or source is None or not source.is_file():
            return None
        with pycolmap.Database.open(source) as database:
            num_photos = database.num_images()
        options = matching_options(survey.mapper, num_photos, survey.output.seed)
        if not (is_given or options.is_in_time_only):
            return None
        return cls(LoopDatabase.copied(source, output), options, progress)

    def match(self, pairs: list[Pair]) -> Mapping[Pair, Indices]:
        """Return the matches (m, 2) of those of the pairs that are verified by a two-view geometry."""
        return self.database.match(pairs, self.options, self.progress)
