"""COLMAP's mappers that take all photos at once: global and hierarchical mapping, in a process of its own.

They neither say how far they are nor hear of a Ctrl-C, which ends the process. ``python -m
rangesfm.vision.whole_mapping PARENT`` runs one.
"""

from __future__ import annotations

import shutil
import signal
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import pycolmap

from rangesfm.colmap.log import append_log, colmap_log
from rangesfm.colmap.model_files import read_model
from rangesfm.files.atomic import scratch_folder
from rangesfm.processes.supervision import MessagesToParent, run_children, work_for_parent
from rangesfm.progress import Progress

WholePipelineOptions = pycolmap.GlobalPipelineOptions | pycolmap.HierarchicalPipelineOptions


def map_at_once(
    database_path: Path, image_path: Path, options: WholePipelineOptions, log: Path, progress: Progress
) -> list[pycolmap.Reconstruction]:
    """All models that such a mapper makes of the photos of a database; there may be none.

    Args:
        log: what COLMAP says is appended to it.

    Raises:
        ReconstructionError: COLMAP failed.
    """
    progress.message("mapping: this mapper does not say how far it is, and an interrupted one begins anew")
    with scratch_folder(database_path.with_name("mapping")) as folder:
        # A copy: they note there what they find of pairs of photos.
        work = _WholeMapping(Path(shutil.copyfile(database_path, folder / "database.db")), image_path, options)
        try:
            with closing(run_children("rangesfm.vision.whole_mapping", [work], 1, lambda _: None)) as ended:
                list(ended)
        finally:
            append_log(work.log, log)
        return [read_model(path) for path in sorted(folder.iterdir()) if path.is_dir()]


@dataclass(frozen=True)
class _WholeMapping:
    """What the process is given; it writes the models beside the database."""

    database: Path
    image_path: Path
    options: WholePipelineOptions

    @property
    def log(self) -> Path:
        return self.database.with_name("mapper.log")

    def run(self) -> int:
        where = self.database, self.image_path, self.database.parent
        with colmap_log(self.log):
            if isinstance(self.options, pycolmap.GlobalPipelineOptions):
                return len(pycolmap.global_mapping(*where, self.options))
            return len(pycolmap.hierarchical_mapping(*where, self.options))


def _run(work: _WholeMapping, _: MessagesToParent) -> int:
    signal.signal(signal.SIGINT, signal.SIG_DFL)  # nobody would hear of it before the end
    return work.run()


if __name__ == "__main__":
    work_for_parent(_run)
