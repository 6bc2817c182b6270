"""A reconstruction in progress; the earlier one stays in the output folder until the new one is complete."""

from __future__ import annotations

import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path

from rangesfm.progress import Progress
from rangesfm.sfm.database import files_of_database
from rangesfm.sfm.loop_database import has_closed_loops
from rangesfm.sfm.steps import DATABASE_NAME, LOG_NAME, RECONSTRUCTION_NAMES, RECORD_NAME, SNAPSHOTS_NAME, Workspace
from rangesfm.util.files.output_folder import OutputFolder, remove


class UnpublishedReconstruction:
    """The workspace of a new reconstruction in an output folder's private folder.

    Attributes:
        log_path: place of COLMAP's log in the output folder.
    """

    def __init__(self, output: OutputFolder, progress: Progress, *, restart: bool):
        """Read the records of earlier runs; the complete reconstruction in the output folder is not changed.

        Raises:
            InputError: files that this tool did not write are in the places of the new ones.
        """
        self._output = output
        self.folder = output.private / "reconstruction"
        self.progress = progress
        self.log_path = output.path / LOG_NAME
        if restart:
            remove(self.folder)
        self._has_begun = False
        self._has_published = not restart and output.is_own(output.path / RECORD_NAME)
        if not self._has_published:
            self._require_own()

    def known(self, name: str) -> dict[str, object]:
        """Return a note of earlier runs, from the records of complete and interrupted ones."""
        folders = [*([self._output.path] if self._has_published else []), self.folder]
        return {key: value for of in folders for key, value in Workspace(of, self.progress).notes.get(name, {}).items()}

    def begin(self, plan: Mapping[str, str], *, with_loops_closed: bool) -> Workspace:
        """Return the folder for the steps: that of the complete reconstruction if it needs none of them.

        Else it is the private one, with what an interrupted run has left there, if that is as much of the plan as the
        complete reconstruction has, or with a copy of the complete one.

        Args:
            plan: for each step, the fingerprint of all that it depends on.
            with_loops_closed: whether the models may be those in which loops have been closed since.
        """
        here = Workspace(self.folder, self.progress)
        num_published = 0
        if self._has_published:
            published = Workspace(self._output.path, self.progress)
            if has_closed_loops(published) and not with_loops_closed:
                published.forget("mapping")
            num_published = published.num_done(plan)
            if num_published == len(plan):
                return published
            self._require_own()
        self._has_begun = True
        if (self.folder / RECORD_NAME).is_file() and here.num_done(plan) >= num_published:
            return here
        for path in (*_places(self.folder), self.folder / SNAPSHOTS_NAME):
            remove(path)
        # The record is copied last, because without it the other files are not used.
        for name in (DATABASE_NAME, LOG_NAME, RECORD_NAME) if self._has_published else ():
            if (self._output.path / name).is_file():
                shutil.copyfile(self._output.path / name, self.folder / name)
        return Workspace(self.folder, self.progress)

    def publish(self, superseded: Sequence[Path] = ()) -> None:
        """Move the new files to their places in the output folder, and remove the workspace.

        Args:
            superseded: files made from the earlier models, which are removed with these.
        """
        if files := self._files():
            self._output.publish(files, superseded)
        self.discard()

    def defer(self) -> None:
        """Leave the earlier reconstruction in its place until a result is published; see ``OutputFolder.defer``."""
        if files := self._files():
            self._output.defer(files)
        else:
            self.discard()

    def _files(self) -> dict[Path, Path]:
        """Return the files and folders to publish: for each path in the output folder, the one that goes there."""
        found = {self._output.path / name: self.folder / name for name in RECONSTRUCTION_NAMES}
        return {target: source for target, source in found.items() if self._has_begun and source.exists()}

    def __enter__(self) -> UnpublishedReconstruction:
        self.folder.mkdir(exist_ok=True)
        return self

    def __exit__(self, *_: object) -> None:
        if not (self.folder / RECORD_NAME).is_file():  # nothing to go on from
            self.discard()

    def discard(self) -> None:
        """Remove the workspace, when all of it is published or none of it was needed."""
        remove(self.folder)

    def _require_own(self) -> None:
        self._output.require_own(_places(self._output.path))


def _places(folder: Path) -> list[Path]:
    """Return what a reconstruction has in a folder, also while a program has its database open."""
    return [*(folder / name for name in RECONSTRUCTION_NAMES), *files_of_database(folder / DATABASE_NAME)[1:]]
