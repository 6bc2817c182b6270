"""Choice of the pairs of photos to match: by COLMAP's pair generators, or from a list."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import pycolmap

from rangesfm.colmap.passthrough import apply_options
from rangesfm.errors import InputError, ReconstructionError
from rangesfm.mapper_options import MapperOptions
from rangesfm.sfm.database import named_by_place
from rangesfm.sfm.photo_files import Photos
from rangesfm.util.files.text_tables import read_text

_MAX_NUM_EXHAUSTIVE = 60  # photos, which make 1770 pairs; with more photos the number of pairs grows too large

PairingOptions = (
    pycolmap.ExhaustivePairingOptions
    | pycolmap.SequentialPairingOptions
    | pycolmap.SpatialPairingOptions
    | pycolmap.VocabTreePairingOptions
)
NamedPairs = tuple[tuple[str, str], ...]


def pairing_options(mapper: MapperOptions, num_photos: int) -> PairingOptions | NamedPairs:
    """Return COLMAP's options for pairing, whose type is the way of pairing, or the pairs of a list by name.

    Raises:
        InputError: a key or value that COLMAP does not have, or a file that is not a list of pairs.
    """
    if mapper.pairs is not None:
        return read_pairs(mapper.pairs)
    way = mapper.matching
    if way == "auto":
        way = "exhaustive" if num_photos <= _MAX_NUM_EXHAUSTIVE else "sequential"
    ways: dict[str, PairingOptions] = {
        "exhaustive": pycolmap.ExhaustivePairingOptions(),
        "sequential": pycolmap.SequentialPairingOptions(),
        "spatial": pycolmap.SpatialPairingOptions(),
        "vocabtree": pycolmap.VocabTreePairingOptions(),
    }
    options = ways[way]
    if mapper.vocab_tree_path is not None and way in ("sequential", "vocabtree"):
        options.vocab_tree_path = mapper.vocab_tree_path  # type: ignore[union-attr]
    apply_options(options, mapper.pairing, "mapper.pairing")
    return options


def read_pairs(path: Path) -> NamedPairs:
    """Read a list of pairs: two photo names a line, separated by a tab or by blanks; ``#`` begins a comment.

    Raises:
        InputError: a line does not hold two different names (the error gives the line), or the file cannot be read.
    """
    lines = read_text(path).split("\n")
    pairs = []
    for number, line in enumerate(lines, 1):
        if not line.strip() or line.startswith("#"):
            continue
        names = [name.strip() for name in line.split("\t")] if "\t" in line else line.split()
        if len(names) != 2 or names[0] == names[1]:
            raise InputError(f"'{line}', expected the names of two photos separated by a tab", path, number)
        pairs.append((names[0], names[1]))
    return tuple(pairs)


def pairs_to_match(database_path: Path, photos: Photos, pairing: PairingOptions | NamedPairs) -> list[tuple[int, int]]:
    """Return the ids of all pairs to be matched, sorted, smaller id first.

    Pairing by similarity needs the features in the database, and pairing by position the photos' positions.

    Raises:
        ReconstructionError: the list of pairs contains no pair of these photos.
    """
    pairs = _named(photos.names, pairing) if isinstance(pairing, tuple) else _generated(database_path, photos, pairing)
    # Pairing by similarity also pairs each photo with itself, its most similar photo. These pairs are left out.
    return sorted({(min(pair), max(pair)) for pair in pairs if pair[0] != pair[1]})


def _generated(database_path: Path, photos: Photos, pairing: PairingOptions) -> Sequence[tuple[int, int]]:
    generators: dict[type[PairingOptions], Callable[..., Any]] = {
        pycolmap.ExhaustivePairingOptions: pycolmap.ExhaustivePairGenerator,
        pycolmap.SequentialPairingOptions: pycolmap.SequentialPairGenerator,
        pycolmap.SpatialPairingOptions: pycolmap.SpatialPairGenerator,
        pycolmap.VocabTreePairingOptions: pycolmap.VocabTreePairGenerator,
    }
    # COLMAP's sequential matching takes the order of names for the order in time.
    is_sequential = isinstance(pairing, pycolmap.SequentialPairingOptions)
    naming = named_by_place(database_path, photos.names) if is_sequential else nullcontext()
    with naming, pycolmap.Database.open(database_path) as database:
        try:
            pairs: Sequence[tuple[int, int]] = generators[type(pairing)](pairing, database).all_pairs()
            return pairs
        except (RuntimeError, ValueError) as error:
            if not isinstance(pairing, pycolmap.VocabTreePairingOptions):
                raise
            reason = " ".join(str(error).split())
            raise InputError(
                f"is not a vocabulary tree for these features ({reason})", pairing.vocab_tree_path
            ) from None


def _named(names: Sequence[str], pairs: NamedPairs) -> list[tuple[int, int]]:
    ids = {name: id_ for id_, name in enumerate(names, 1)}
    known = [(ids[first], ids[second]) for first, second in pairs if first in ids and second in ids]
    if not known:
        raise ReconstructionError(
            f"none of {len(pairs)} pairs names two keyframes, expected names relative to the folder, such as {names[0]}"
        )
    return known
