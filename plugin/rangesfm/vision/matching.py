"""Step 2: which features of two photos show the same thing."""

from __future__ import annotations

import shutil
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import pycolmap

from rangesfm.colmap.log import append_log
from rangesfm.colmap.passthrough import apply_options
from rangesfm.errors import ReconstructionError
from rangesfm.files.atomic import scratch_folder
from rangesfm.options import MapperOptions
from rangesfm.processes.supervision import run_children
from rangesfm.progress import Progress
from rangesfm.vision.background import run_in_background
from rangesfm.vision.database import num_matching_pairs
from rangesfm.vision.device import refuse_missing_gpu, uses_gpu
from rangesfm.vision.features import refuse_learned
from rangesfm.vision.own_process import MODULE, MatchingShare
from rangesfm.vision.pairs import NamedPairs, Pairing, pairing_options, pairs_to_match
from rangesfm.vision.photos import Photos

_MIN_NUM_PAIRS = 100  # for less, a second process does not pay
_MAX_NUM_PAIRS = 2000  # of one share, whose database is one of at most some hundred photos
# A tile's pairs are of few photos for one share, a small one's for COLMAP's memory.
_TILE_SIZE, _SMALL_TILE_SIZE = 64, 8
# pycolmap's wheels carry an OpenBLAS without locks. Of two threads that match at once, one now and then
# computes in the other's memory: some pair keeps 50 of its 1100 matches, in every run another one.
# Processes have memories of their own. [mapper.matcher] num_threads overrides this. On a GPU no BLAS is used.
_NUM_CPU_THREADS = 1


@dataclass(frozen=True)
class MatchingOptions:
    """COLMAP's options for the chosen way of matching.

    Attributes:
        pairing: says which pairs.
        verifier: of matches that are given.
        num_processes: that match at once.
    """

    pairing: Pairing | NamedPairs
    matcher: pycolmap.FeatureMatchingOptions
    verification: pycolmap.TwoViewGeometryOptions
    verifier: pycolmap.GeometricVerifierOptions
    num_processes: int

    @property
    def seed(self) -> int:
        return self.verification.ransac.random_seed

    @property
    def is_by_place(self) -> bool:
        """Whether a pair is one before anything is known of the photos but their order and their names."""
        if isinstance(self.pairing, (pycolmap.SpatialPairingOptions, pycolmap.VocabTreePairingOptions)):
            return False
        return not (isinstance(self.pairing, pycolmap.SequentialPairingOptions) and self.pairing.loop_detection)

    @property
    def pairing_inputs(self) -> list[Any]:
        """Plain values that tell these pairs from others of the same photos."""
        if isinstance(self.pairing, tuple):
            return list(self.pairing)
        return [type(self.pairing).__name__, str(self.pairing.todict())]


def matching_options(mapper: MapperOptions, num_photos: int, seed: int) -> MatchingOptions:
    """Raises InputError for keys or values that are not COLMAP's, or for a GPU that is not there."""
    on_gpu = uses_gpu(mapper)
    num_threads = mapper.num_threads if on_gpu else _NUM_CPU_THREADS
    options = MatchingOptions(
        pairing=pairing_options(mapper, num_photos),
        matcher=pycolmap.FeatureMatchingOptions(num_threads=num_threads, use_gpu=on_gpu),
        verification=pycolmap.TwoViewGeometryOptions(),
        verifier=pycolmap.GeometricVerifierOptions(num_threads=mapper.num_threads),
        num_processes=1 if on_gpu else mapper.num_cores,
    )
    # Within COLMAP's own: what it asks of two views is not what its RANSAC asks by itself.
    options.verification.ransac.random_seed = seed
    apply_options(options.matcher, mapper.matcher, "mapper.matcher")
    refuse_learned(options.matcher.type.name, "mapper.matcher")
    refuse_missing_gpu(options.matcher.use_gpu, "mapper.matcher")
    return options


def match_features(
    database_path: Path, photos: Photos, options: MatchingOptions, log: Path, progress: Progress
) -> None:
    """Match the pairs of photos that have not been matched yet; with the same result whatever the number of processes.

    Args:
        log: what COLMAP says is appended to it.

    Raises:
        ReconstructionError: no two photos match.
    """
    pairs = pairs_to_match(database_path, photos, options.pairing)
    with pycolmap.Database.open(database_path) as database:
        missing = [pair for pair in pairs if not database.exists_two_view_geometry(*pair)]
    num_there, num_all = len(pairs) - len(missing), len(pairs)
    progress.update(num_there, num_all)
    with scratch_folder(database_path.with_name("matching")) as folder:
        shares = [
            MatchingShare(folder / str(k), share, options.matcher, options.verification)
            for k, share in enumerate(_shared_out(missing, options.num_processes))
        ]
        _match_shares(
            shares, database_path, options.num_processes, log, lambda num: progress.update(num_there + num, num_all)
        )
    _require_matches(database_path, photos)


def verify_matches(database_path: Path, photos: Photos, options: MatchingOptions, progress: Progress) -> None:
    """Look which matches fit one geometry of two views, unless that is done; ReconstructionError if none do."""
    with pycolmap.Database.open(database_path) as database:
        num_pairs = database.num_matched_image_pairs()
        if database.num_verified_image_pairs() < num_pairs:
            run_in_background(
                lambda token: pycolmap.geometric_verification(
                    database_path,
                    options.verifier,
                    two_view_geometry_options=options.verification,
                    cancellation_token=token,
                ),
                progress,
                database.num_verified_image_pairs,
                num_pairs,
            )
    _require_matches(database_path, photos)


def _require_matches(database_path: Path, photos: Photos) -> None:
    with pycolmap.Database.open(database_path) as database:
        num_matching = num_matching_pairs(database)
    if num_matching == 0:
        raise ReconstructionError(
            f"no two of {len(photos.names)} photos match: neighbours should share at least half of what they show;"
            " more photos, or more of them as keyframes, may help"
        )


def _match_shares(
    shares: Sequence[MatchingShare], database_path: Path, num_at_once: int, log: Path, update: Callable[[int], None]
) -> None:
    begun: deque[MatchingShare] = deque()

    def prepared() -> Iterator[MatchingShare]:
        for share in shares:
            share.folder.mkdir()
            share.prepare(database_path)
            begun.append(share)
            yield share

    def take_first() -> None:
        share = begun.popleft()
        append_log(share.log, log)
        share.hand_over(database_path)
        shutil.rmtree(share.folder)

    try:
        with closing(run_children(MODULE, prepared(), num_at_once, update)) as ended:
            for _ in ended:
                take_first()
    finally:  # interrupted: what there is saves the next run doing it
        while begun:
            with suppress(RuntimeError):  # a database that was only being made
                take_first()


def _shared_out(pairs: Sequence[tuple[int, int]], num_processes: int) -> Iterator[list[tuple[int, int]]]:
    """Shares for processes that work at the same time: of the same size, and of few photos."""
    tiles = sorted(pairs, key=lambda pair: [id_ // size for size in (_TILE_SIZE, _SMALL_TILE_SIZE, 1) for id_ in pair])
    num_at_once = max(1, min(num_processes, len(pairs) // _MIN_NUM_PAIRS))
    for start in range(0, len(tiles), num_at_once * _MAX_NUM_PAIRS):
        together = tiles[start : start + num_at_once * _MAX_NUM_PAIRS]
        cuts = [len(together) * k // num_at_once for k in range(num_at_once + 1)]
        yield from (together[begin:end] for begin, end in pairwise(cuts))
