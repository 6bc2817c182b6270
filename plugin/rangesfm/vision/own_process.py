"""Work in a process of its own: features, a share of the matching, mappers that take all photos, and external ones.

When the disk is full, a library that writes from its own thread ends the whole process. Here that is a child process,
whose end is noticed.

``rangesfm.processes.supervision`` runs this file as a module to do one piece of work.
"""

from __future__ import annotations

import signal
import subprocess
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import pycolmap

from rangesfm.colmap.colmap_log import colmap_log
from rangesfm.processes.supervision import end_group_with_parent, work_for_parent
from rangesfm.progress import Progress
from rangesfm.vision.background import run_in_background
from rangesfm.vision.database import copy_matches, copy_photos
from rangesfm.vision.device import device_of

MODULE = "rangesfm.vision.own_process"
WholePipelineOptions = pycolmap.GlobalPipelineOptions | pycolmap.HierarchicalPipelineOptions
# Largest number of features that COLMAP keeps in memory, each with its index some 700 bytes. Features that it drops are
# read and indexed again when needed.
_MAX_NUM_FEATURES = 400_000


@dataclass(frozen=True)
class FeatureExtraction:
    """Feature extraction for photos of a database, except where their masks, if there are any, are black."""

    database: Path
    image_path: Path
    image_names: Sequence[str]
    mask_path: Path | None
    options: pycolmap.FeatureExtractionOptions
    log: Path

    def run(self, _: Progress) -> int:
        """Extract the features and return the number of photos; progress is read from the database instead."""
        reader = pycolmap.ImageReaderOptions()
        if self.mask_path is not None:
            reader.mask_path = self.mask_path
        with colmap_log(self.log):
            pycolmap.extract_features(
                self.database,
                self.image_path,
                image_names=list(self.image_names),
                reader_options=reader,
                extraction_options=self.options,
                device=device_of(self.options),
            )
        return len(self.image_names)


@dataclass(frozen=True)
class MatchingShare:
    """A share of the matching: pairs of photo ids, smaller first, matched in a folder of their own."""

    folder: Path
    pairs: Sequence[tuple[int, int]]
    matcher: pycolmap.FeatureMatchingOptions
    verification: pycolmap.TwoViewGeometryOptions

    @property
    def database(self) -> Path:
        return self.folder / "database.db"

    @property
    def log(self) -> Path:
        """File with COLMAP's messages."""
        return self.folder / "mapper.log"

    def prepare(self, source: Path) -> None:
        """Copy the features of its photos into a database of its own, where each photo is named by its id."""
        copy_photos(source, self.database, sorted({id_ for pair in self.pairs for id_ in pair}))
        (self.folder / "pairs.txt").write_text("".join(f"{first} {second}\n" for first, second in self.pairs))

    def run(self, progress: Progress) -> int:
        """Match the pairs and return their number."""
        pairing = pycolmap.ImportedPairingOptions()
        pairing.match_list_path = self.folder / "pairs.txt"
        with colmap_log(self.log), pycolmap.Database.open(self.database) as database:
            # Number of pairs after which COLMAP writes its matches; it also keeps this many photos in memory.
            pairing.block_size = max(1, _MAX_NUM_FEATURES * database.num_images() // (1 + database.num_descriptors()))
            run_in_background(
                lambda token: pycolmap.match_image_pairs(
                    self.database,
                    self.matcher,
                    pairing,
                    self.verification,
                    device=device_of(self.matcher),
                    cancellation_token=token,
                ),
                progress,
                database.num_verified_image_pairs,
                len(self.pairs),
            )
        return len(self.pairs)

    def hand_over(self, target: Path) -> None:
        """Copy the results into the target database, also of pairs that do not match."""
        copy_matches(self.database, target, ((pair, pair) for pair in self.pairs))


@dataclass(frozen=True)
class WholeMapping:
    """A mapping that takes all photos at once; it reports no progress and writes the models beside the database.

    It does not notice a cancellation, so that Ctrl-C ends its process.
    """

    database: Path
    image_path: Path
    options: WholePipelineOptions

    @property
    def log(self) -> Path:
        """File with COLMAP's messages."""
        return self.database.with_name("mapper.log")

    def run(self, _: Progress) -> int:
        """Run the mapping and return the number of models."""
        where = self.database, self.image_path, self.database.parent
        with colmap_log(self.log):
            if isinstance(self.options, pycolmap.GlobalPipelineOptions):
                return len(pycolmap.global_mapping(*where, self.options))
            return len(pycolmap.hierarchical_mapping(*where, self.options))


@dataclass(frozen=True)
class ExternalMapping:
    """A mapping by a program that reads ``database.db`` in a folder, and writes ``sparse/0`` there.

    Attributes:
        folder: with the database. words: the program and its arguments. environment: its environment variables.
    """

    folder: Path
    words: Sequence[str]
    environment: Mapping[str, str]

    @property
    def log(self) -> Path:
        """File with all that the program prints."""
        return self.folder / "mapper.log"

    def run(self, _: Progress) -> int:
        """Run the program until it ends, and return its exit status."""
        end_group_with_parent()
        with self.log.open("wb") as log:
            done = subprocess.run(
                self.words,
                cwd=self.folder,
                env=self.environment,
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=subprocess.STDOUT,
                check=False,
            )
        return done.returncode


def _run(work: FeatureExtraction | MatchingShare | WholeMapping | ExternalMapping, parent: Progress) -> int:
    signal.signal(signal.SIGINT, signal.SIG_DFL)  # Ctrl-C may end the process at once: files written so far are intact
    return work.run(parent)


if __name__ == "__main__":
    work_for_parent(_run)
