"""Names of photos in the files of users, and the photo that each of them means."""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from functools import partial
from itertools import product

import numpy as np
import numpy.typing as npt

from rangesfm.errors import printable

_ENDING = re.compile(r"(?<=[^/])\.[A-Za-z][A-Za-z0-9]{1,4}$", re.ASCII)


def photos_meant(listed: Sequence[str], photos: Collection[str]) -> list[str]:
    """Return the photo that each name in a file means; the name itself if there is none.

    A name may have further folders in front, separated by either slash, or fewer; another ending or none; and other
    capitals, unless photos differ by these alone. The closest form of a name counts. A form in which some name could be
    several photos, or some photo has several names, tells nothing: two cameras may name their photos alike.
    """
    are_apart = len({photo.casefold() for photo in photos}) == len({*photos})
    same = {name: (name.casefold() if are_apart else name).replace("\\", "/") for name in {*listed, *photos}}
    photo_of, names = {same[photo]: photo for photo in photos}, {same[name] for name in listed}
    found = {name: name for name in names & photo_of.keys()}
    forms: tuple[Callable[[str], str], ...] = (str, partial(_ENDING.sub, ""))
    for form, by_photo in product(forms, (False, True)):
        left = photo_of.keys() - {*found.values()}
        more = _in_form(form, names - found.keys(), left, by_photo=by_photo)
        only = {name: photo for name, photo in more.items() if photo is not None}
        found |= only if len({*only.values()}) == len(more) else {}
    return [photo_of[found[same[name]]] if same[name] in found else name for name in listed]


def rows_of_photos(listed: Sequence[str], photos: Sequence[str]) -> npt.NDArray[np.int64]:
    """Return the index of the photo that each name means (n,), by ``photos_meant``; -1 if there is none."""
    row_of = {photo: row for row, photo in enumerate(photos)}
    return np.array([row_of.get(name, -1) for name in photos_meant(listed, row_of)], dtype=np.int64)


def told_unknown(what: str, listed: Sequence[str], photos: Collection[str], where: str) -> Iterator[str]:
    """Yield a line for the user if names in a file mean none of the photos.

    Args:
        what: what the file lists by photo, with the file's name. where: what has the photos.
    """
    unknown = [name for name, photo in zip(listed, photos_meant(listed, photos)) if photo not in photos]
    if unknown:
        such, other = printable(unknown[0]), printable(min(photos))
        num = f"{len(unknown)} of {len(listed)} {what} are of photos"
        yield f"{num} that are not in {where}, such as {such}; {where} has {other}"


def told_none(file: str, listed: Sequence[str], photos: Sequence[str]) -> str:
    """Return what an error says where none of the names in a file means a photo of the map."""
    first, other = printable(listed[0]), printable(photos[0])
    return f"none of the photos that {file} names, such as {first}, is in the map, which has {other}"


def _tails(name: str) -> Iterator[str]:
    """Yield a name with ever fewer folders in front."""
    parts = name.split("/")
    return ("/".join(parts[k:]) for k in range(len(parts)))


def _in_form(
    form: Callable[[str], str], names: Collection[str], photos: Collection[str], *, by_photo: bool
) -> dict[str, str | None]:
    """Return the photo that each name means in a form, None if it could be several; names that mean none are left out.

    Args:
        by_photo: whether photos may have more folders in front than the names; otherwise names than the photos.
    """
    if by_photo:
        index = _index((tail, photo) for photo in photos for tail in _tails(form(photo)))
        return {name: index[form(name)] for name in names if form(name) in index}
    index = _index((form(photo), photo) for photo in photos)
    tails = {name: next(filter(index.__contains__, _tails(form(name))), "") for name in names}
    return {name: index[tail] for name, tail in tails.items() if tail}


def _index(keyed: Iterable[tuple[str, str]]) -> dict[str, str | None]:
    """Return the photo of each key, None for a key of several."""
    index: dict[str, str | None] = {}
    for key, photo in keyed:
        index[key] = None if key in index else photo
    return index
