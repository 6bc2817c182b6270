"""Step 2: which features of two photos show the same thing."""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path

import pycolmap

from rangesfm.colmap.passthrough import apply_options
from rangesfm.errors import ReconstructionError
from rangesfm.options import MapperOptions
from rangesfm.progress import Progress
from rangesfm.vision.background import run_in_background
from rangesfm.vision.database import named_by_place, num_compared_pairs, num_matching_pairs
from rangesfm.vision.photos import Photos

_MAX_NUM_EXHAUSTIVE = 60  # 1770 pairs; beyond, the pairs outgrow the photos
# COLMAP hears of a Ctrl-C between two blocks: 36 pairs of 8 by 8 photos instead of its default's 1225.
_EXHAUSTIVE_BLOCK_SIZE = 8
# pycolmap's wheels carry an OpenBLAS without locks. Of two threads that match at once, one now and then
# computes in the other's memory: some pair keeps 50 of its 1100 matches, in every run another one.
# [mapper.matcher] num_threads overrides this. On a GPU no BLAS is used.
_NUM_CPU_THREADS = 1


@dataclass(frozen=True)
class MatchingOptions:
    """COLMAP's options for the chosen way of matching; its type of pairing says which."""

    pairing: pycolmap.ExhaustivePairingOptions | pycolmap.SequentialPairingOptions
    matcher: pycolmap.FeatureMatchingOptions
    verification: pycolmap.TwoViewGeometryOptions

    @property
    def is_sequential(self) -> bool:
        return isinstance(self.pairing, pycolmap.SequentialPairingOptions)

    @property
    def is_by_place(self) -> bool:
        """Whether it is the places of photos in the order that make a pair, and not what they look like."""
        return not (isinstance(self.pairing, pycolmap.SequentialPairingOptions) and self.pairing.loop_detection)


def matching_options(mapper: MapperOptions, num_photos: int, seed: int) -> MatchingOptions:
    """Raises InputError for keys or values that are not COLMAP's."""
    is_sequential = mapper.matching == "sequential" or (mapper.matching == "auto" and num_photos > _MAX_NUM_EXHAUSTIVE)
    num_threads = mapper.num_threads if pycolmap.has_cuda else _NUM_CPU_THREADS
    sequential, exhaustive = pycolmap.SequentialPairingOptions(), pycolmap.ExhaustivePairingOptions()
    exhaustive.block_size = _EXHAUSTIVE_BLOCK_SIZE
    options = MatchingOptions(
        pairing=sequential if is_sequential else exhaustive,
        matcher=pycolmap.FeatureMatchingOptions(num_threads=num_threads),
        verification=pycolmap.TwoViewGeometryOptions(),
    )
    # Within COLMAP's own: what it asks of two views is not what its RANSAC asks by itself.
    options.verification.ransac.random_seed = seed
    apply_options(options.pairing, mapper.pairing, "mapper.pairing")
    apply_options(options.matcher, mapper.matcher, "mapper.matcher")
    return options


def pairs_to_match(database_path: Path, photos: Photos, options: MatchingOptions) -> list[tuple[int, int]]:
    """Ids of all pairs that will be compared, smaller first; none where only the photos' looks decide."""
    pairing = options.pairing
    if isinstance(pairing, pycolmap.SequentialPairingOptions):
        if pairing.loop_detection:
            return []
        with named_by_place(database_path, photos.names), pycolmap.Database.open(database_path) as database:
            pairs = pycolmap.SequentialPairGenerator(pairing, database).all_pairs()
    else:
        with pycolmap.Database.open(database_path) as database:
            pairs = pycolmap.ExhaustivePairGenerator(pairing, database).all_pairs()
    return sorted({(min(pair), max(pair)) for pair in pairs})


def match_features(database_path: Path, photos: Photos, options: MatchingOptions, progress: Progress) -> None:
    """Match the pairs of photos that have not been matched yet.

    Raises:
        ReconstructionError: no two photos match.
    """
    naming = named_by_place(database_path, photos.names) if options.is_sequential else nullcontext()
    with naming, pycolmap.Database.open(database_path) as database:
        run_in_background(
            lambda token: _call_colmap(database_path, options, token),
            progress,
            lambda: num_compared_pairs(database),
            _num_expected_pairs(len(photos.names), options.pairing),
        )
        num_matching = num_matching_pairs(database)
    if num_matching == 0:
        raise ReconstructionError(
            f"no two of {len(photos.names)} photos match: neighbours should share at least half of what they show;"
            " more photos, or more of them as keyframes, may help"
        )


def _call_colmap(database_path: Path, options: MatchingOptions, token: pycolmap.CancellationToken) -> None:
    if isinstance(options.pairing, pycolmap.SequentialPairingOptions):
        pycolmap.match_sequential(
            database_path, options.matcher, options.pairing, options.verification, cancellation_token=token
        )
    else:
        pycolmap.match_exhaustive(
            database_path, options.matcher, options.pairing, options.verification, cancellation_token=token
        )


def _num_expected_pairs(
    num_photos: int, pairing: pycolmap.ExhaustivePairingOptions | pycolmap.SequentialPairingOptions
) -> int | None:
    if not isinstance(pairing, pycolmap.SequentialPairingOptions):
        return num_photos * (num_photos - 1) // 2
    if pairing.loop_detection:
        return None
    steps = [2**step if pairing.quadratic_overlap else step + 1 for step in range(min(pairing.overlap, num_photos))]
    return sum(max(num_photos - step, 0) for step in steps)
