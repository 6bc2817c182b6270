"""A reconstruction in progress; the earlier one stays in the output folder until the new one is complete."""

from __future__ import annotations

import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path

from rangesfm.files.output_folder import OutputFolder, remove
from rangesfm.progress import Progress
from rangesfm.vision.steps import (
    DATABASE_NAME,
    LOG_NAME,
    RECONSTRUCTION_NAMES,
    RECORD_NAME,
    SNAPSHOTS_NAME,
    Steps,
    Workspace,
)

_NAME = "reconstruction"
# Files that SQLite keeps beside a database that a program has open.
_OF_OPEN_DATABASE = (f"{DATABASE_NAME}-wal", f"{DATABASE_NAME}-shm")


class UnpublishedReconstruction:
    """The workspace of a new reconstruction in an output folder's private folder.

    Attributes:
        space: the workspace. Steps that the complete reconstruction in the output folder has done with the same inputs
            are not done again.
    """

    def __init__(self, output: OutputFolder, progress: Progress, *, restart: bool):
        """Open the workspace; the complete reconstruction in the output folder is not changed.

        Raises:
            InputError: files that this tool did not write are in the places of the new ones.
        """
        self._output = output
        self._folder = output.private / _NAME
        published = output.path / RECORD_NAME
        if restart:
            remove(self._folder)
        earlier = None
        if not restart and output.is_own(published):
            earlier = Steps(published, progress)
        self._progress = progress
        self.space = Workspace(self._folder, progress, earlier=earlier, begin=self._begin)
        if earlier is None:
            self._require_own()

    @property
    def models_path(self) -> Path:
        """Folder of the models, once they exist."""
        return (self._folder if self.space.steps.has_begun else self._output.path) / self.space.models.name

    @property
    def log_path(self) -> Path:
        """Place of COLMAP's log in the output folder."""
        return self._output.path / LOG_NAME

    def publish(self, superseded: Sequence[Path] = ()) -> None:
        """Move the new files to their places in the output folder, and remove the workspace.

        Args:
            superseded: files made from the earlier models, which are removed with these.
        """
        files = self._files()
        if files:
            self._output.publish(files, superseded)
        self.discard()

    def defer(self) -> None:
        """Leave the earlier reconstruction in its place until a result is published; see ``OutputFolder.defer``."""
        files = self._files()
        if files:
            self._output.defer(files)
        else:
            self.discard()

    def _files(self) -> dict[Path, Path]:
        """Return the files and folders to publish: for each path in the output folder, the one that goes there."""
        if not self.space.steps.has_begun:
            return {}
        found = {self._output.path / name: self._folder / name for name in RECONSTRUCTION_NAMES}
        return {target: source for target, source in found.items() if source.exists()}

    def __enter__(self) -> UnpublishedReconstruction:
        self._folder.mkdir(exist_ok=True)
        return self

    def __exit__(self, *_: object) -> None:
        if not (self._folder / RECORD_NAME).is_file():  # nothing to go on from
            self.discard()

    def discard(self) -> None:
        """Remove the workspace, when all of it is published or none of it was needed."""
        remove(self._folder)

    def _begin(self, passed: Mapping[str, str]) -> None:
        """Continue from what an interrupted run has left here if it fits, else copy the complete reconstruction."""
        self._require_own()
        if (self._folder / RECORD_NAME).is_file() and Steps(self._folder / RECORD_NAME, self._progress).has_done(
            passed
        ):
            return
        for name in (*RECONSTRUCTION_NAMES, *_OF_OPEN_DATABASE, SNAPSHOTS_NAME):
            remove(self._folder / name)
        # The record is copied last, because without it the other files are not used.
        for name in (DATABASE_NAME, LOG_NAME, RECORD_NAME):
            if (self._output.path / name).is_file():
                shutil.copyfile(self._output.path / name, self._folder / name)

    def _require_own(self) -> None:
        self._output.require_own(self._output.path / name for name in (*RECONSTRUCTION_NAMES, *_OF_OPEN_DATABASE))
