"""What a planned survey measures on its true map: kinds as a run locates them, measured without errors."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np

from rangesfm.errors import GeometryError
from rangesfm.measurements.joint_map import KindOnMap
from rangesfm.measurements.kind_words import KindWords
from rangesfm.measurements.kinds_in_words import KINDS_IN_WORDS
from rangesfm.measurements.lengths.length_scale import LengthScale, lengths_between_points
from rangesfm.measurements.lengths.lengths_on_map import BENDING
from rangesfm.measurements.lengths.locate_lengths import LocatedDistances
from rangesfm.measurements.lengths.words import LENGTH_WORDS
from rangesfm.measurements.positions.known_positions import LASTING_S, KnownPositions
from rangesfm.measurements.positions.position_scale import PositionScale, scale_by_positions
from rangesfm.measurements.positions.surveyed_positions import SurveyedPositions
from rangesfm.measurements.positions.words import POSITION_WORDS
from rangesfm.planning.planned import PlannedSurvey
from rangesfm.planning.planned_photos import PlannedPhotos
from rangesfm.planning.planned_ranges import ranges_at_truth
from rangesfm.solver.bending import MapBending


def kinds_at_truth(planned: PlannedSurvey, bending: MapBending) -> tuple[tuple[KindOnMap, ...], tuple[str, ...]]:
    """Return all that is measured on the true map, in the order of the run's table, and what the run will leave out.

    Raises:
        GeometryError: the run will find too few ranges on the path, or nothing that determines the scale.
    """
    found, notes = list[KindOnMap](), list[str]()
    known = known_positions(planned)
    if unseen := [point.name for point in planned.points if point.name not in known.names]:
        notes.append(
            f"{len(unseen)} of {len(planned.points)} points are left out, as no two photos of the path show them "
            f"from different directions ([photos] field_of_view_deg, seen_m): {', '.join(unseen)}"
        )

    def positions() -> PositionScale | None:
        given = planned.antenna and planned.antenna.lasting_s
        surveyed = SurveyedPositions(lasting_s=(given,) if given else LASTING_S)
        begun = PositionScale.begun(known, bending, surveyed, is_at_rest=True)
        return scale_by_positions(begun) if len(known) else None

    others = [
        (words, partial(planned.others[words.kind].on_map, bending))
        for words in KINDS_IN_WORDS
        if words.kind in planned.others
    ]
    locate: list[tuple[KindWords, Callable[[], KindOnMap | None]]] = [
        (POSITION_WORDS, positions),
        (LENGTH_WORDS, partial(_lengths, planned, bending)),
        *others,
    ]
    for words, located in locate:
        try:
            found += [each for each in (located(),) if each is not None]
        except GeometryError as error:
            notes.append(words.not_used(error))
    if planned.anchors:
        found.insert(0, ranges_at_truth(planned, bending, found))
    if not found:
        raise GeometryError(f"the scale is not determined: {'; '.join(notes) or 'nothing is measured'}")
    return tuple(found), tuple(notes)


def known_positions(planned: PlannedSurvey) -> KnownPositions:
    """Return the known positions of a plan without errors, as a run finds them in its map."""
    marks = (planned.photos or PlannedPhotos()).marks_of(planned.trajectory, planned.points)
    return marks if planned.antenna is None else marks.joined(planned.antenna.located(planned.trajectory))


def _lengths(planned: PlannedSurvey, bending: MapBending) -> LengthScale | None:
    """Return the lengths that will be taped, between places that are not known yet."""
    lengths, stddevs = np.array(planned.taped, dtype=np.float64).reshape(-1, 2).T
    # Between its ends the scale of the map varies.
    located = LocatedDistances.between_points(lengths, np.hypot(stddevs, BENDING * lengths), lengths)
    return lengths_between_points(located, bending)
