"""Guess of the quantity in each column of a table, from names and values, with the doubts that remain.

A guess is sure if the names of the columns say it, or if the values allow one interpretation only. In all other cases
the user is asked.
"""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import count, pairwise, product, takewhile

import numpy as np

from rangesfm.arrays import Array
from rangesfm.measurements.ranges.readers import vocabulary as terms
from rangesfm.measurements.ranges.readers.counters import continued
from rangesfm.measurements.ranges.readers.layout import ColumnSample, Layout
from rangesfm.measurements.ranges.readers.reader import EndpointRoles
from rangesfm.measurements.ranges.readers.times import SECONDS_PER_UNIT, unit_by_digits
from rangesfm.util.files.clock_times import are_seconds_since_1970

MAX_NUM_IDS = 64
"""Largest number of tags and anchors of a survey, where a table does not say what it holds."""
_POSITION = re.compile(r"(?:^|[^0-9A-Za-z])POS(?:\[|$)", re.ASCII)
_SAME_SPOT_M = 1.5  # largest distance between tags on one rig, and so largest difference of their ranges to an anchor


@dataclass
class Guess:
    """Guess of what a table holds.

    Attributes:
        columns: by quantity, the name of its column in the file, as the user would give them: ``range:A1`` or
            ``range:A1:T0`` for a column with the ranges of one anchor, ``range:@id`` where the column id names it.
        roles: what the log says about the two ends of a range.
        notes: lines for the user about what was found.
        doubts: why the guess is not sure; empty if it is.
        missing: quantities for which no column was found.
    """

    columns: dict[str, str] = field(default_factory=dict)
    roles: EndpointRoles = EndpointRoles.TAG_AND_ANCHOR
    notes: list[str] = field(default_factory=list)
    doubts: list[str] = field(default_factory=list)
    missing: list[str] = field(default_factory=list)

    @property
    def told(self) -> dict[str, str]:
        """The columns in the order in which a user would give them: the time first, those of single anchors last."""
        return dict(
            sorted(self.columns.items(), key=lambda item: (item[0].startswith("range:"), item[0] != "timestamp"))
        )

    @property
    def is_wide(self) -> bool:
        """Whether there are columns with the ranges of one anchor each."""
        return any(quantity.startswith("range:") for quantity in self.columns)


def guess_columns(layout: Layout) -> Guess:
    """Guess the quantities in the columns of a table."""
    guess = Guess()
    free = [column for column in layout.columns if column.kind != "nothing"]
    for find in (find_time, _find_pairs, _find_range, _find_nodes) if layout.has_names else ():
        free = find(free, guess)
    _find_by_values(free, guess, layout.has_names)
    return guess


def find_time(free: list[ColumnSample], guess: Guess) -> list[ColumnSample]:
    """Find the time by the names of columns, or else names of photos, and return the other columns."""
    ranked = sorted((rank, k) for k, column in enumerate(free) if (rank := _time_rank(column)) is not None)
    fractions = [column for column in free if terms.NANOSECONDS & {*column.words} and column.is_whole]
    # The column for the finest times; those of whole seconds may have their fractions in another column.
    finest = max((free[k].num_distinct for _, k in ranked if not fractions), default=0)
    if any(_is_since_1970(free[k]) and 2 * free[k].num_distinct > finest for _, k in ranked):
        ranked.sort(key=lambda one: free[one[1]].is_without_zone)  # civil times without a zone leave hours open
    if not ranked:
        photos = [column for column in free if column.names_photos]
        guess.columns |= {"image_name": photos[0].name} if photos else {}
        return [column for column in free if column not in photos]
    time, *others = (free[k] for _, k in ranked)
    guess.columns["timestamp"] = time.name
    dates = [column for column in free if column.kind == "dates"]
    if time.kind == "times" and dates and ":" in time.cells[0][:3]:
        guess.columns["date"] = dates[0].name
    elif time.is_whole and fractions and float(np.median(time.numbers)) < 1e11:
        guess.columns["nanoseconds"] = fractions[0].name
    if also := [column for column in others if column not in fractions]:
        guess.notes.append(f"the times are taken from {time.name}; there are also {names_of(also)}")
    return [column for column in free if column not in (time, *others, *dates, *fractions)]


def named_photos(layout: Layout) -> list[ColumnSample]:
    """Return the columns that name photos without an ending by the names of the columns."""
    named = columns_by_name(layout.columns if layout.has_names else (), {"photo": terms.NAMING_PHOTOS})["photo"]
    return [column for column in named if column.kind == "text" or column.is_whole]


def is_named_time(column: ColumnSample) -> bool:
    """Return whether a column holds times by its name."""
    return bool(terms.TIME & {*column.words}) and _time_rank(column) is not None


def _time_rank(column: ColumnSample) -> tuple[float, int] | None:
    """Return a rank of a column as the time, smaller for a better one, or None if it is not one."""
    words = [word for word in column.words if word not in terms.PLAIN]
    if column.kind not in ("numbers", "times") or terms.NO_TIME & {*words} or terms.NANOSECONDS & {*words}:
        return None
    is_in_short = bool(words) and {*words} <= terms.TIME_IN_SHORT
    is_named = bool(terms.TIME & {*words}) or is_in_short or column.kind == "times"
    stands_still = len(column.numbers) > 2 and bool(np.all(column.numbers == column.numbers[0]))
    if not is_named or stands_still:
        return None
    # Columns like rostopic's %time hold the time of arrival of a message. Its stamp holds the time of measurement.
    is_arrival = column.name.startswith(("%", "__")) or bool(terms.SECOND_TIME & {*words})
    return is_arrival + 0.5 * (not terms.TIME & {*words}), len({*words} - terms.TIME - terms.TIME_IN_SHORT)


def columns_by_name(
    columns: Iterable[ColumnSample], kinds: Mapping[str, tuple[terms.Words, terms.Words]]
) -> dict[str, list[ColumnSample]]:
    """Return the columns of each kind by the words in their names, and under "" those of none.

    Args:
        kinds: words of which the name of such a column has at least one, and those that it may have besides; of several
            kinds that fit, the first one counts.
    """
    found: dict[str, list[ColumnSample]] = {kind: [] for kind in (*kinds, "")}
    for column in columns:
        words = {*column.words}
        kind = next((kind for kind, (own, besides) in kinds.items() if words & own and words <= own | besides), "")
        found[kind].append(column)
    return found


def _is_since_1970(column: ColumnSample) -> bool:
    """Return whether a column holds present times since 1970, in any unit, by their size."""
    middle = float(np.median(column.numbers)) if column.kind == "numbers" and len(column.numbers) else 0.0
    return are_seconds_since_1970(middle * SECONDS_PER_UNIT[unit_by_digits(middle) or "s"])


def _find_pairs(free: list[ColumnSample], guess: Guess) -> list[ColumnSample]:
    """Find several pairs of columns with an anchor and its range, of the same number or next to each other."""
    nodes = {_numbers(column): column for column in free if _names_anchor(column)}
    values = [column for column in free if is_range(column)]
    pairs = [(nodes[number], value) for value in values if (number := _numbers(value)) in nodes]
    if len(pairs) < len(values) or len({node.name for node, _ in pairs}) < len(pairs):
        pairs = [(node, value) for node, value in pairwise(free) if _names_anchor(node) and is_range(value)]
    if len(pairs) < 2 or len({tuple(_without_numbers(column) for column in pair) for pair in pairs}) > 1:
        return free
    _take_pairs(pairs, guess)
    return [column for column in free if all(column not in pair for pair in pairs)]


def _take_pairs(pairs: Sequence[tuple[ColumnSample, ColumnSample]], guess: Guess) -> None:
    guess.columns |= {f"range:@{node.name}": value.name for node, value in pairs}
    guess.notes.append(f"an anchor and its range in {len(pairs)} pairs of columns, such as {pairs[0][0].name}")


def _of_link(anchor: str, tag: str) -> str:
    """Return the quantity of the ranges between an anchor and a tag; without a tag, of those to the anchor."""
    return f"range:{anchor}" + f":{tag}" * bool(tag)


def _names_anchor(column: ColumnSample) -> bool:
    words = {*_without_numbers(column)}
    return bool(words) and words <= terms.ANCHOR | terms.ASKED | terms.ID and (column.kind == "text" or column.is_whole)


def names_of(columns: Iterable[ColumnSample]) -> str:
    return ", ".join(column.name for column in columns)


def _numbers(column: ColumnSample) -> tuple[str, ...]:
    return tuple(word for word in column.words if word.isdigit())


def _without_numbers(column: ColumnSample) -> tuple[str, ...]:
    return tuple(word for word in column.words if not word.isdigit() and word not in terms.PLAIN)


def _find_range(free: list[ColumnSample], guess: Guess) -> list[ColumnSample]:
    if guess.is_wide:
        return free
    numbers = [column for column in free if column.kind == "numbers" and not terms.NO_RANGE & {*column.words}]
    numbers = [column for column in numbers if not _is_angle(column)]
    named = [column for column in numbers if is_range(column)]
    stamps = {name: column.name for column in free if (name := column.name.lower()) in ("tx1", "rx1", "tx2", "rx2")}
    groups = [group for group in _groups(numbers) if all(map(_may_be_wide, group))]
    in_groups = {column.name for group in groups for column, _ in group}
    groups = [group for group in groups if not terms.SECOND_RANGE & {*group[0][0].words}] or groups
    single = [column for column in named if column.name not in in_groups]
    first = [column for column in single if not terms.SECOND_RANGE & {*column.words}] or single
    if first:
        guess.columns["range"] = first[0].name
        if len(first) > 1:
            guess.doubts.append(f"any of {names_of(first)} may be the ranges")
        elif others := [column for column in single if column not in first]:
            guess.notes.append(f"the ranges are taken from {first[0].name}; there are also {names_of(others)}")
    elif groups:
        _take_wide(groups[0], guess)
        guess.doubts += ["there are several groups of columns that may be ranges"] * (len(groups) > 1)
    elif len(stamps) == 4:
        guess.notes.append("there are no ranges, and the time stamps of two-way ranging are used")
        guess.columns |= stamps
    return [column for column in free if column not in named and column.name not in in_groups]


def is_range(column: ColumnSample) -> bool:
    """Return whether a column holds ranges by its name; ``d`` and ``r`` count only alone or with a unit."""
    words = {*_without_numbers(column)}
    if column.kind != "numbers" or terms.NO_RANGE & words or _is_angle(column):
        return False
    return bool(words & terms.RANGE) or (bool(words) and words <= terms.RANGE_IN_SHORT | terms.LENGTH_UNIT)


def _is_angle(column: ColumnSample) -> bool:
    """Return whether a column is the azimuth or the zenith angle in a list of range, azimuth and zenith (raz)."""
    return "raz" in column.words and "0" not in column.words and bool(_numbers(column))


def _groups(columns: Sequence[ColumnSample]) -> list[list[tuple[ColumnSample, list[int]]]]:
    """Return groups of columns whose names differ in ids and units only, with the indices of the ids in each name."""
    groups: dict[tuple[str, ...], list[tuple[ColumnSample, list[int]]]] = defaultdict(list)
    for column in columns:
        ids = [
            k
            for k, word in enumerate(column.words)
            if word[0].isdigit()
            or _is_letter(word, k, column.words)
            or (len(word) == 4 and word.upper() in column.name)
        ]
        if ids:
            named = [*enumerate(column.words)]
            alike = tuple("#" if k in ids else word for k, word in named if word not in terms.LENGTH_UNIT)
            groups[alike].append((column, ids))
    return [group for group in groups.values() if len(group) > 1]


def _is_letter(word: str, k: int, words: list[str]) -> bool:
    """Return whether a word is a single letter at the end of a name and an id, as in dist_A."""
    return len(word) == 1 and k == len(words) - 1 > 0 and bool(terms.RANGE & {*words}) and word not in terms.LENGTH_UNIT


def _may_be_wide(member: tuple[ColumnSample, list[int]]) -> bool:
    column, ids = member
    others = {word for k, word in enumerate(column.words) if k not in ids} - terms.PLAIN
    return others <= terms.IN_WIDE and bool(others & (terms.RANGE | terms.RANGE_IN_SHORT | terms.ANCHOR | {"a", "b"}))


def _take_wide(group: list[tuple[ColumnSample, list[int]]], guess: Guess) -> None:
    wide, nums_of_ids, have_tags = dict[str, str](), set[int](), False
    for column, ids in group:
        tags = [k for k in ids if k and column.words[k - 1] in terms.TAG | {"t"} and len(ids) > 1]
        anchors = [k for k in ids if k not in tags]
        anchor, tag = ("_".join(_id_at(column.words, k, column.name) for k in each) for each in (anchors, tags))
        wide[_of_link(anchor, tag)] = column.name
        nums_of_ids.add(len(ids) - bool(tags))
        have_tags |= bool(tags)
    guess.columns |= wide
    words = {word for column, _ in group for word in column.words}
    first = names_of(column for column, _ in group[:4])
    guess.notes.append(f"one column per anchor: {first}{', ..' * (len(group) > 4)}")
    if len(wide) < len(group):
        guess.doubts.append("the names of several columns hold the same id")
    elif max(nums_of_ids) > 1:
        guess.doubts.append("the names of the columns hold two ids, and do not say which is the anchor's")
    elif not have_tags and not words & (
        terms.RANGE | terms.RANGE_IN_SHORT | (terms.ANCHOR - {"an", "bs", "node", "base"})
    ):
        guess.doubts.append("the names of the columns do not say that they are ranges")


def _id_at(words: list[str], k: int, name: str) -> str:
    """Return the id at word ``k`` as the file spells it, with one or two letters before it (A0)."""
    before = words[k - 1] if k and len(words[k - 1]) <= 2 and words[k - 1] not in terms.RANGE_IN_SHORT else ""
    text = before + words[k]
    at = name.lower().find(text)
    return name[at : at + len(text)] if at >= 0 else words[k]


def _find_nodes(free: list[ColumnSample], guess: Guess) -> list[ColumnSample]:
    """Find the columns of ids by name; if the names give no role, the last is the anchor's and the first the tag's."""
    ids: dict[str, list[ColumnSample]] = defaultdict(list)
    # An id in the same nested record as the range is the anchor's, and an id outside of it is the tag's.
    within = guess.columns.get("range", "").rpartition(".")[0] + "."
    for column in free:
        words = {word for word in terms.words_of(column.name.removeprefix(within)) if not word.isdigit()} - terms.PLAIN
        words -= terms.RANGE if column.kind == "text" else set()
        besides = terms.ID | terms.ANTENNA | {"node"}
        role = next((role for role, own in terms.ROLES.items() if words & own and words <= own | besides), None)
        if role is not None and (column.kind == "text" or column.is_whole):
            ids[role].append(column)
    anchor, tag = ids["anchor"] or ids["asked"], ids["tag"] or ids["asking"]
    nameless = ids["any"]
    varying = [column for column in free if _is_id(column) and column.num_distinct > 1]
    if guess.is_wide:
        tag = tag or nameless[:1]
    elif not anchor and nameless:
        others = [column for column in varying if column not in nameless and _ends_in_id(column)]
        if others and not any(column in varying for column in nameless):  # one id in all rows is not the anchor's
            anchor = others[:1]
            guess.doubts.append(f"{others[0].name} may be the anchor")
        else:
            anchor = [column for column in nameless if column.name.startswith(within)] or nameless[-1:]
        tag = tag or [column for column in nameless if column not in anchor][:1]
    elif anchor and anchor[0] in ids["asked"]:
        tag = tag or [column for column in nameless if _is_id(column)][:1]
    guess.roles = (
        EndpointRoles.ASKER_AND_ASKED
        if anchor and anchor[0] not in ids["anchor"] and tag
        else EndpointRoles.TAG_AND_ANCHOR
    )
    anchor, tag = by_id_rather_than_index(anchor), by_id_rather_than_index(tag)
    if guess.is_wide and max(len([column for column in anchor if column in varying]), len(nameless)) > 1:
        guess.doubts.append("the anchor of a column of ranges seems to be given in another column")
    for role, columns in (("anchor_id", anchor), ("tag_id", tag), ("antenna", ids["antenna"][: bool(tag)])):
        if columns and not (guess.is_wide and role == "anchor_id"):
            guess.columns[role] = columns[0].name
            if len(columns) > 1:
                guess.doubts.append(f"any of {names_of(columns)} may be the {role}")
    unlike = terms.NO_RANGE - terms.ANY_ID
    others = [column for column in varying if not unlike & {*column.words}]
    if others and not (guess.is_wide or anchor):
        guess.columns["anchor_id"] = others[0].name
        guess.doubts.append(f"{others[0].name} may be the anchor")
    if "antenna" in guess.columns and ids["antenna"][0].num_distinct > 1:
        guess.notes.append(
            f"each antenna of a tag ({guess.columns['antenna']}) counts as a tag of its own, such as 3/1"
        )
    for column in free:
        name = column.name.lower()
        if name in ("los", "nlos") and {*column.cells} <= {"0", "1", "0.0", "1.0", ""}:
            guess.columns[name] = column.name
    return [column for column in free if not any(column in columns for columns in ids.values())]


def _ends_in_id(column: ColumnSample) -> bool:
    """Return whether the name of a column ends as those of ids do, such as peerid or remote_addr."""
    return bool(column.words) and (column.words[-1] in terms.ANY_ID or column.words[-1].endswith(("id", "addr")))


def by_id_rather_than_index(columns: list[ColumnSample]) -> list[ColumnSample]:
    """Return the columns of ids without those that only number the rows, unless there are no others."""
    return [column for column in columns if not {"idx", "index", "no", "num", "nr"} & {*column.words}] or columns


def _find_by_values(free: list[ColumnSample], guess: Guess, has_names: bool) -> None:
    """Find by their values the columns that were not found by name.

    If the table has names, the names should have told, so that such a finding is not sure.
    """
    if not {"timestamp", "image_name"} & {*guess.columns}:
        rising = [column for column in free if column.kind == "times" or is_rising(column)]
        counters = [column for column in rising if column.is_whole and np.all(np.diff(column.numbers) == 1)]
        rising = [column for column in rising if column not in counters] or rising
        fractions = [after for time, after in pairwise(free) if time in rising[:1] and _is_nanoseconds(after)]
        free = [column for column in free if column not in (*rising, *counters, *fractions)]
        if rising:
            guess.columns["timestamp"] = rising[0].name
            guess.doubts += [f"{rising[0].name} may be the time"] * has_names
        else:
            guess.missing.append("timestamp")
        if rising and rising[0].is_whole and fractions:
            guess.columns["nanoseconds"] = fractions[0].name
    if guess.is_wide or {"range", "tx1"} & {*guess.columns}:
        return
    free = [column for column in _before_position(free) if not terms.POSE & {*column.words}]
    pairs = _pairs_by_values(free)
    if len(pairs) > 1:
        _take_pairs(pairs, guess)
        if 2 * len(pairs) < len(free) or len({node.cells[0] for node, _ in pairs}) < len(pairs):
            guess.doubts.append(f"{names_of(node for node, _ in pairs)} may be the anchors")
        return
    ids = [column for column in free if _is_id(column)]
    reals = [column for column in free if column.kind == "numbers" and column not in ids and _is_positive(column)]
    reals = [column for column in reals if not terms.NO_RANGE & {*column.words}]
    reals = [column for column in reals if column.num_distinct > 1] or reals
    if alike := sorted(_groups(reals), key=len):
        reals = [column for column, _ in alike[-1]] if has_names else reals
    # If there are columns of decimals, a column of whole numbers is no range but for example a count or a power.
    reals = [column for column in reals if not column.is_whole] or reals
    if len(reals) == 1:
        guess.columns["range"] = reals[0].name
        guess.doubts += [f"{reals[0].name} may be the range"] * has_names
        if "anchor_id" not in guess.columns and ids:
            _ids_by_values(ids, guess)
    elif reals:
        _wide_by_values(reals, guess)
    else:
        guess.missing.append("range")


def _before_position(free: list[ColumnSample]) -> list[ColumnSample]:
    """Return the columns in front of the word POS, after which radios print the position that they computed."""
    words = (k for k, column in enumerate(free) if column.cells and all(map(_POSITION.search, column.cells)))
    return free[: next(words, len(free))]


def _pairs_by_values(free: Sequence[ColumnSample]) -> list[tuple[ColumnSample, ColumnSample]]:
    """Return the longest series of equally spaced pairs of a column of ids and a column of decimals after it."""
    are_real = [one.kind == "numbers" and not one.is_whole and _is_positive(one) for one in free]
    at = [k for k, node in enumerate(free[:-1]) if _is_id(node) and are_real[k + 1]]
    run: list[int] = []
    for first, step in product(at, {*np.diff(at).tolist()}):
        run = max(run, list(takewhile(at.__contains__, count(first, step))), key=len)
    return [(free[k], free[k + 1]) for k in run]


def _is_nanoseconds(column: ColumnSample) -> bool:
    """Return whether a column holds the nanoseconds within a second."""
    return column.is_whole and column.num_distinct > 9 and 1e8 < float(np.max(column.numbers)) < 1e9


def _ids_by_values(ids: list[ColumnSample], guess: Guess) -> None:
    """Choose the column of anchors and that of tags among columns of ids, by the rule that there are more anchors."""
    *others, anchor = sorted(ids, key=lambda column: column.num_distinct)
    tag = others[-1] if others else None
    if len(others) > 1:
        guess.doubts.append(f"any of {names_of(ids)} may be the anchor or the tag")
    guess.columns["anchor_id"] = anchor.name
    if tag is not None:
        guess.columns["tag_id"] = tag.name
        guess.roles = EndpointRoles.ASKER_AND_ASKED
        if tag.num_distinct > 1:
            guess.doubts.append(f"columns {tag.name} and {anchor.name} may be the tag and the anchor")


def is_rising(column: ColumnSample) -> bool:
    """Return whether the numbers of a column rise from row to row, with few exceptions, or count around."""
    numbers, _ = continued(column.numbers if column.kind == "numbers" else np.zeros(0))
    return len(numbers) > 1 and bool(numbers[-1] > numbers[0] and np.mean(np.diff(numbers) >= 0) > 0.95)


def _is_positive(column: ColumnSample) -> bool:
    """Return whether the numbers of a column are positive; a few other ones, or one such as -1, are no measurements."""
    negative = column.numbers[column.numbers < 0]
    is_code = len(np.unique(negative)) < 2
    num_positive, num = np.count_nonzero(column.numbers > 0), len(column.numbers)
    return bool(2 * num_positive > num and (is_code or len(negative) < 0.05 * num))


def _is_id(column: ColumnSample) -> bool:
    # A word without digits that is the same in each row, such as "range:" or "m", is not an id.
    is_word = column.num_distinct == 1 and not any(map(str.isdigit, column.cells[0]))
    few = column.num_distinct <= min(MAX_NUM_IDS, max(2, len(column.cells) // 4))
    return few and not is_word and (column.kind == "text" or (column.is_whole and bool(np.all(column.numbers >= 0))))


def _wide_by_values(columns: list[ColumnSample], guess: Guess) -> None:
    """Take similar columns for ranges, one per anchor, or one per tag and anchor; this is never sure."""
    num_tags = _num_tags(columns)
    num = len(columns) // num_tags
    names = [column.name for column in columns]
    are_numbered = all(name.isdigit() for name in names)
    ids = [(str(k // num_tags), f"T{k % num_tags}" if num_tags > 1 else "") for k in range(len(columns))]
    ids = ids if are_numbered or num_tags > 1 else [(name, "") for name in names]
    if are_numbered and int(names[-1]) - int(names[0]) == len(names) - 1:
        of_tags = f"T0-T{num_tags - 1}" * (num_tags > 1)
        guess.columns[_of_link(f"0-{num - 1}", of_tags)] = f"{names[0]}-{names[-1]}"
    else:
        guess.columns |= {_of_link(*link): name for link, name in zip(ids, names)}
    tags = f", each for {num_tags} tags, whose ranges are nearly the same" if num_tags > 1 else ""
    guess.doubts.append(f"columns {names[0]} to {names[-1]} may be ranges to {num} anchors{tags}")


def _num_tags(columns: Sequence[ColumnSample]) -> int:
    """Return the number of tags: the largest size of groups of neighbouring columns with nearly equal values.

    Ranges of tags on one rig to one anchor are nearly equal.
    """
    num_rows = min(len(column.numbers) for column in columns)
    ranges = np.column_stack([column.numbers[:num_rows] for column in columns])
    for num in range(min(6, len(columns) // 2), 1, -1):
        if len(columns) % num == 0 and _are_alike(ranges.reshape(num_rows, -1, num)):
            return num
    return 1


def _are_alike(ranges: Array) -> bool:
    """Return whether ranges (n, anchors, tags) differ little between tags, and clearly less than between anchors."""
    spread = np.percentile(np.ptp(ranges, axis=2), 95, axis=0)
    apart = np.median(np.ptp(ranges[:, :, 0], axis=1))
    return bool(np.max(spread) < min(_SAME_SPOT_M, apart / 3))


def described(columns: Collection[ColumnSample]) -> Iterator[str]:
    """Yield a description of each column for the user; of many columns, only the first eight."""
    for k, column in enumerate(columns):
        if k == 8 and len(columns) > 9:
            yield f"and {len(columns) - k} more"
            return
        yield str(column)
