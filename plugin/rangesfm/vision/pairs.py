"""Which pairs of photos are matched: by COLMAP's generators of pairs, or as a list says."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import pycolmap

from rangesfm.colmap.passthrough import apply_options
from rangesfm.errors import InputError, ReconstructionError
from rangesfm.options import MapperOptions
from rangesfm.vision.database import named_by_place
from rangesfm.vision.photos import Photos

_MAX_NUM_EXHAUSTIVE = 60  # 1770 pairs; beyond, the pairs outgrow the photos

Pairing = (
    pycolmap.ExhaustivePairingOptions
    | pycolmap.SequentialPairingOptions
    | pycolmap.SpatialPairingOptions
    | pycolmap.VocabTreePairingOptions
)
NamedPairs = tuple[tuple[str, str], ...]


def pairing_options(mapper: MapperOptions, num_photos: int) -> Pairing | NamedPairs:
    """COLMAP's options, whose type says which way it is, or the pairs by name.

    Raises:
        InputError: keys or values that are not COLMAP's, or a list that is none.
    """
    if mapper.pairs is not None:
        return read_pairs(mapper.pairs)
    way = mapper.matching
    if way == "auto":
        way = "exhaustive" if num_photos <= _MAX_NUM_EXHAUSTIVE else "sequential"
    ways: dict[str, Pairing] = {
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
    """Two names of photos a line, with a tab between them, or a blank where neither has one; ``#`` begins a comment.

    Raises:
        InputError: with the line that does not hold two names, or a file that cannot be read.
    """
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise InputError("cannot be read, expected a text file of pairs of photos", path) from error
    pairs = []
    for number, line in enumerate(lines, 1):
        if not line.strip() or line.startswith("#"):
            continue
        names = [name.strip() for name in line.split("\t")] if "\t" in line else line.split()
        if len(names) != 2 or names[0] == names[1]:
            raise InputError(f"'{line}', expected the names of two photos with a tab between them", path, number)
        pairs.append((names[0], names[1]))
    return tuple(pairs)


def pairs_to_match(database_path: Path, photos: Photos, pairing: Pairing | NamedPairs) -> list[tuple[int, int]]:
    """Ids of all pairs to be compared, smaller first; where the photos' looks or places decide, features are needed.

    Raises:
        ReconstructionError: a list of pairs that names no two of the photos.
    """
    if isinstance(pairing, tuple):
        return _pairs_of_names(photos.names, pairing)
    generators: dict[type[Pairing], Callable[..., Any]] = {
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
            pairs = generators[type(pairing)](pairing, database).all_pairs()
        except (RuntimeError, ValueError) as error:
            if not isinstance(pairing, pycolmap.VocabTreePairingOptions):
                raise
            reason = " ".join(str(error).split())
            raise InputError(f"is no vocabulary tree for these features ({reason})", pairing.vocab_tree_path) from None
    # The most alike to a photo is itself.
    return sorted({(min(pair), max(pair)) for pair in pairs if pair[0] != pair[1]})


def _pairs_of_names(names: Sequence[str], pairs: NamedPairs) -> list[tuple[int, int]]:
    ids = {name: id_ for id_, name in enumerate(names, 1)}
    known = [(ids[first], ids[second]) for first, second in pairs if first in ids and second in ids]
    if not known:
        raise ReconstructionError(
            f"none of {len(pairs)} pairs is of two keyframes, expected names relative to the folder as {names[0]}"
        )
    return sorted({(min(pair), max(pair)) for pair in known})
