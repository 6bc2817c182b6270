"""The place of a result: the names that it takes in the output folder, and the refusal to overwrite an input."""

from __future__ import annotations

from rangesfm.errors import InputError
from rangesfm.export import EXPORTED_NAMES, OFFSET_NAME
from rangesfm.result.result_folder import PHOTOS_NAMES, RESULT_NAMES
from rangesfm.sfm.steps import RECONSTRUCTION_NAMES
from rangesfm.survey.settings import Survey
from rangesfm.survey.survey_reader import input_paths
from rangesfm.util.files.folders import real_path


def result_names(survey: Survey) -> set[str]:
    """Return the names that a result of this survey takes in the output folder, export formats included."""
    return {*RESULT_NAMES, OFFSET_NAME}.union(*(EXPORTED_NAMES[name] for name in survey.export.formats))


def refuse_to_overwrite(survey: Survey) -> None:
    """Check that the results will overwrite no input, and will not be written among the files of an input folder.

    Raises:
        InputError: they would; it names the input.
    """
    folder = real_path(survey.output.path)
    maps = survey.images.model is None
    places = {folder / name for name in result_names(survey)}
    places.update(folder / name for name in (*RECONSTRUCTION_NAMES, *PHOTOS_NAMES) if maps)
    for _, _, given in input_paths(survey):
        path = real_path(given)
        if not places.isdisjoint((path, *path.parents)):
            raise InputError("the results would overwrite this input, expected another output path", given)
        if path.is_dir() and path == folder:
            raise InputError("the results would be written into this input, expected another output path", given)
