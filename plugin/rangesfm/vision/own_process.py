"""What COLMAP does in a process of its own: features, a share of the matching, and the mappers that take all photos.

A library that writes to a full disk from a thread of its own ends the whole process: here it ends one that is watched.

Run as a module by ``rangesfm.processes.supervision`` it does one such piece of work.
"""

from __future__ import annotations

import signal
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import pycolmap

from rangesfm.colmap.log import colmap_log
from rangesfm.processes.supervision import MessagesToParent, work_for_parent
from rangesfm.progress import Progress
from rangesfm.vision.background import run_in_background
from rangesfm.vision.database import copy_matches, copy_photos
from rangesfm.vision.device import device_of

MODULE = "rangesfm.vision.own_process"
WholePipelineOptions = pycolmap.GlobalPipelineOptions | pycolmap.HierarchicalPipelineOptions
# Features that COLMAP keeps in memory, each of some 700 bytes with its index; what it forgets it indexes anew.
_MAX_NUM_FEATURES = 400_000


@dataclass(frozen=True)
class FeatureExtraction:
    """Photos of a database that are to have features, where their masks, if there are any, are not black."""

    database: Path
    image_path: Path
    image_names: Sequence[str]
    mask_path: Path | None
    options: pycolmap.FeatureExtractionOptions
    log: Path

    def run(self, _: Progress) -> int:
        """Returns how many photos there were; whoever looks into the database sees how many are done."""
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
    """Pairs of photos by their ids, smaller first, and all that it takes to match them in a folder of their own."""

    folder: Path
    pairs: Sequence[tuple[int, int]]
    matcher: pycolmap.FeatureMatchingOptions
    verification: pycolmap.TwoViewGeometryOptions

    @property
    def database(self) -> Path:
        return self.folder / "database.db"

    @property
    def log(self) -> Path:
        """What COLMAP said."""
        return self.folder / "mapper.log"

    def prepare(self, source: Path) -> None:
        """Take over the features of its photos; there each photo is called by its id."""
        copy_photos(source, self.database, sorted({id_ for pair in self.pairs for id_ in pair}))
        (self.folder / "pairs.txt").write_text("".join(f"{first} {second}\n" for first, second in self.pairs))

    def run(self, progress: Progress) -> int:
        """Returns how many pairs have been compared."""
        pairing = pycolmap.ImportedPairingOptions()
        pairing.match_list_path = self.folder / "pairs.txt"
        with colmap_log(self.log), pycolmap.Database.open(self.database) as database:
            # Pairs after which COLMAP writes down what it has found; it keeps as many photos in memory.
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
        """What it has found, also of pairs that do not match."""
        copy_matches(self.database, target, ((pair, pair) for pair in self.pairs))


@dataclass(frozen=True)
class WholeMapping:
    """A mapping that neither says how far it is nor hears of a Ctrl-C; it writes the models beside the database."""

    database: Path
    image_path: Path
    options: WholePipelineOptions

    @property
    def log(self) -> Path:
        """What COLMAP said."""
        return self.database.with_name("mapper.log")

    def run(self, _: Progress) -> int:
        """Returns how many models there are."""
        where = self.database, self.image_path, self.database.parent
        with colmap_log(self.log):
            if isinstance(self.options, pycolmap.GlobalPipelineOptions):
                return len(pycolmap.global_mapping(*where, self.options))
            return len(pycolmap.hierarchical_mapping(*where, self.options))


def _run(work: FeatureExtraction | MatchingShare | WholeMapping, parent: MessagesToParent) -> int:
    signal.signal(signal.SIGINT, signal.SIG_DFL)  # at once: what is written down is whole
    return work.run(parent)


if __name__ == "__main__":
    work_for_parent(_run)
