"""Step 2: matching of features between photos."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import pycolmap

from rangesfm.errors import ReconstructionError
from rangesfm.mapper_options import MapperOptions
from rangesfm.progress import Progress
from rangesfm.sfm.background import match_share, run_in_background
from rangesfm.sfm.database import copy_matches, copy_photos, num_matching_pairs, remove_database
from rangesfm.sfm.device import apply_options_of_device, uses_gpu
from rangesfm.sfm.pairs import NamedPairs, PairingOptions, pairing_options, pairs_to_match
from rangesfm.sfm.photo_files import Photos
from rangesfm.sfm.steps import Workspace
from rangesfm.util.files.atomic import scratch_folder
from rangesfm.util.processes.supervision import run_children

_MIN_NUM_PAIRS = 100  # with fewer pairs, a second process is not worth its start
_MAX_NUM_PAIRS = 2000  # pairs of one share; its database then holds some hundred photos at most
# Pairs are sorted by tiles of the matrix of all pairs, in photos a side. Tiles keep the photos of one share few; the
# small tiles inside them keep the photos in COLMAP's memory few.
_TILE_SIZE, _SMALL_TILE_SIZE = 64, 8
# pycolmap's wheels carry an OpenBLAS without locks. When two threads match at once, one sometimes computes in the
# other's memory: some pair then keeps 50 of its 1100 matches, a different pair in every run. Processes do not share
# memory, so each matches in one thread. [mapper.matcher] num_threads overrides this. A GPU uses no BLAS.
_NUM_CPU_THREADS = 1


@dataclass(frozen=True)
class MatchingOptions:
    """COLMAP's options for the chosen way of matching.

    Attributes:
        pairing: which pairs are matched.
        verification: options of the geometric verification of matches.
        verifier: options of the verification where the matches are given.
    """

    pairing: PairingOptions | NamedPairs
    matcher: pycolmap.FeatureMatchingOptions
    verification: pycolmap.TwoViewGeometryOptions
    verifier: pycolmap.GeometricVerifierOptions
    num_processes: int

    @property
    def seed(self) -> int:
        return self.verification.ransac.random_seed

    @property
    def is_by_place(self) -> bool:
        """Return whether the pairs depend only on the order and names of the photos, not on their content."""
        if isinstance(self.pairing, (pycolmap.SpatialPairingOptions, pycolmap.VocabTreePairingOptions)):
            return False
        return not (isinstance(self.pairing, pycolmap.SequentialPairingOptions) and self.pairing.loop_detection)

    @property
    def is_in_time_only(self) -> bool:
        """Return whether only neighbours in time are matched."""
        return isinstance(self.pairing, pycolmap.SequentialPairingOptions) and not self.pairing.loop_detection

    @property
    def pairing_inputs(self) -> list[Any]:
        """Plain values that differ whenever other pairs of the same photos would be matched."""
        if isinstance(self.pairing, tuple):
            return list(self.pairing)
        return [type(self.pairing).__name__, str(self.pairing.todict())]


def matching_options(mapper: MapperOptions, num_photos: int, seed: int) -> MatchingOptions:
    """Return the options for matching.

    Raises:
        InputError: a key or value that COLMAP does not have, or no GPU where one is asked for.
    """
    on_gpu = uses_gpu(mapper)
    num_threads = mapper.num_threads if on_gpu else _NUM_CPU_THREADS
    options = MatchingOptions(
        pairing=pairing_options(mapper, num_photos),
        matcher=pycolmap.FeatureMatchingOptions(num_threads=num_threads, use_gpu=on_gpu),
        verification=pycolmap.TwoViewGeometryOptions(),
        verifier=pycolmap.GeometricVerifierOptions(num_threads=mapper.num_threads),
        num_processes=1 if on_gpu else mapper.num_cores,
    )
    # Set in COLMAP's own options, because their RANSAC defaults differ from those of a fresh RANSACOptions.
    options.verification.ransac.random_seed = seed
    apply_options_of_device(options.matcher, mapper.matcher, "mapper.matcher")
    return options


def match_features(space: Workspace, photos: Photos, options: MatchingOptions) -> None:
    """Match the pairs of photos that have not been matched yet; the number of processes does not change the result.

    Raises:
        ReconstructionError: no two photos match.
    """
    match_pairs(space, pairs_to_match(space.database, photos, options.pairing), options)
    _require_matches(space.database, photos)


def match_pairs(space: Workspace, pairs: Sequence[tuple[int, int]], options: MatchingOptions) -> None:
    """Match those of the pairs (ids of photos, smaller first) that have not been matched yet."""
    database_path, progress = space.database, space.progress
    with pycolmap.Database.open(database_path) as database:
        missing = [pair for pair in pairs if not database.exists_two_view_geometry(*pair)]
    num_there = len(pairs) - len(missing)
    progress.update(num_there, len(pairs))
    begun: deque[tuple[Path, list[tuple[int, int]]]] = deque()

    def prepared(folder: Path) -> Iterator[Callable[[Progress], int]]:
        for number, share in enumerate(_shared_out(missing, options.num_processes)):
            path = folder / f"{number}.db"
            copy_photos(database_path, path, sorted({image_id for pair in share for image_id in pair}))
            begun.append((path, share))
            yield partial(match_share, path, share, options.matcher, options.verification, space.log_folder)

    def take_first() -> None:
        path, share = begun.popleft()
        copy_matches(path, database_path, ((pair, pair) for pair in share))
        remove_database(path)

    with scratch_folder(database_path.with_name("matching")) as folder:
        works = prepared(folder)
        try:
            with closing(
                run_children(works, options.num_processes, lambda num: progress.update(num_there + num, len(pairs)))
            ) as ended:
                for _ in ended:
                    take_first()
        finally:  # after an interruption, keep the matches found so far for the next run
            while begun:
                with suppress(RuntimeError):  # the database of a share was not complete yet
                    take_first()


def verify_matches(space: Workspace, photos: Photos, options: MatchingOptions) -> None:
    """Verify the matches by two-view geometry, unless that is done.

    Raises:
        ReconstructionError: no two photos match.
    """
    with pycolmap.Database.open(space.database) as database:
        num_pairs = database.num_matched_image_pairs()
        if database.num_verified_image_pairs() < num_pairs:
            run_in_background(
                lambda token: pycolmap.geometric_verification(
                    space.database,
                    options.verifier,
                    two_view_geometry_options=options.verification,
                    cancellation_token=token,
                ),
                space.progress,
                database.num_verified_image_pairs,
                num_pairs,
            )
    _require_matches(space.database, photos)


def _require_matches(database_path: Path, photos: Photos) -> None:
    with pycolmap.Database.open(database_path) as database:
        num_matching = num_matching_pairs(database)
    if num_matching == 0:
        raise ReconstructionError(
            f"no two of {len(photos.names)} photos match: neighbouring photos should overlap by at least half;"
            " more photos or more keyframes may help"
        )


def _shared_out(pairs: Sequence[tuple[int, int]], num_processes: int) -> Iterator[list[tuple[int, int]]]:
    """Split the pairs into shares of equal size and of few photos each, for processes that work at the same time."""
    tiles = sorted(pairs, key=lambda pair: [id_ // size for size in (_TILE_SIZE, _SMALL_TILE_SIZE, 1) for id_ in pair])
    num_at_once = max(1, min(num_processes, len(pairs) // _MIN_NUM_PAIRS))
    for start in range(0, len(tiles), num_at_once * _MAX_NUM_PAIRS):
        together = tiles[start : start + num_at_once * _MAX_NUM_PAIRS]
        cuts = [len(together) * k // num_at_once for k in range(num_at_once + 1)]
        yield from (together[begin:end] for begin, end in pairwise(cuts))
