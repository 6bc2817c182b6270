"""Pairs of photos that look alike, by a vocabulary of the survey's own features: nothing is downloaded."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence, Set
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pycolmap

from rangesfm.colmap.colmap_log import colmap_log
from rangesfm.sfm.loop_database import Pair
from rangesfm.util.files.atomic import scratch_folder

# Words of a vocabulary, fewer where there are few features, and features for each word.
_MAX_NUM_WORDS, _NUM_OF_WORD, _LEAST_OF_WORD = 256, 40, 4
_NUM_ITERATIONS = 5  # of k-means, whose words need not be the best ones
_EMBEDDING_SIZE = 64  # bits by which COLMAP tells features of one word apart, as in its own vocabulary trees
# Features of a photo by which others are found; those of the largest scale come first in a database. With ten times as
# many, and four times the words, it takes 16 times as long, and as many of the photos that are found share points.
_NUM_OF_PHOTO = 100


def pairs_alike(
    database_path: Path, known: Mapping[int, Set[int]], log: Path, *, max_num: int, seed: int
) -> list[Pair]:
    """Return pairs of photos that look alike, as ids, smaller first.

    Args:
        known: ids of the photos, with those of the photos that each one is not to be paired with.
        log: the messages of COLMAP and of its parts are appended to this file.
        max_num: largest number of pairs that one photo proposes.
    """
    with scratch_folder(database_path.with_name("vocabulary")) as folder, colmap_log(log):
        path = folder / "words.bin"
        with pycolmap.Database.open(database_path) as database:
            _write_vocabulary(database, sorted(known), path, log, seed)
            options = pycolmap.VocabTreePairingOptions(
                vocab_tree_path=path, num_images=len(known), max_num_features=_NUM_OF_PHOTO, num_threads=1
            )
            ranked = pycolmap.VocabTreePairGenerator(options, database).all_pairs()
    num_of: Counter[int] = Counter()
    chosen: set[Pair] = set()
    for photo, other in ranked:  # for each photo, the most similar one first
        if photo == other or not {photo, other} <= known.keys():
            continue
        if num_of[photo] < max_num and other not in known[photo]:
            num_of[photo] += 1
            chosen.add((min(photo, other), max(photo, other)))
    return sorted(chosen)


def _write_vocabulary(database: pycolmap.Database, image_ids: Sequence[int], path: Path, log: Path, seed: int) -> None:
    each = -(-_MAX_NUM_WORDS * _NUM_OF_WORD // len(image_ids))
    found = [database.read_descriptors(image_id) for image_id in image_ids]
    words = pycolmap.FeatureDescriptorsFloat()
    words.type = found[0].type
    words.data = np.concatenate([of_photo.data[:each] for of_photo in found]).astype(np.float32)
    index = pycolmap.VisualIndex.create(words.data.shape[1], _EMBEDDING_SIZE)
    options = pycolmap.VisualIndex.BuildOptions()
    options.num_visual_words, options.num_threads = min(len(words.data) // _LEAST_OF_WORD, _MAX_NUM_WORDS), 1
    options.num_iterations, options.num_rounds = _NUM_ITERATIONS, 1
    pycolmap.set_random_seed(seed)
    with _errors_into(log):  # where faiss warns that it would rather have more features
        index.build(options, words)
    index.write(path)


@contextmanager
def _errors_into(log: Path) -> Iterator[None]:
    """Append what is printed to the standard error stream inside the block, by any library, to ``log``."""
    with log.open("ab") as file:
        before = os.dup(2)
        os.dup2(file.fileno(), 2)
        try:
            yield
        finally:
            os.dup2(before, 2)
            os.close(before)
