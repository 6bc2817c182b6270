"""The plan file: type, bounds and meaning of each key; it is read like a survey file."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import AfterValidator, Field

from rangesfm.arrays import Array
from rangesfm.errors import InputError, OptionError
from rangesfm.measurements.lengths.tape import CONTROL
from rangesfm.measurements.planned_kind import PlannedKind
from rangesfm.measurements.positions.control_point_file import read_control_points
from rangesfm.measurements.positions.control_points import ControlPoint
from rangesfm.measurements.ranges.anchors.anchor import Anchor
from rangesfm.measurements.ranges.anchors.anchor_file import read_anchors
from rangesfm.measurements.ranges.errors.components import COMPONENTS, LOGS, stddevs_in
from rangesfm.option_model import Key, Options
from rangesfm.options import LENGTH_M, PointOptions, RangeModelOptions, TagOptions, Uncertainty
from rangesfm.planning.paths import loop_inside, path_from_file, path_from_model, path_through
from rangesfm.planning.placement import places_in_box, places_on_walls, spread_anchors
from rangesfm.planning.plan_checks import oddities, require_possible
from rangesfm.planning.planned import Coordinate, Place, PlannedAntenna, PlannedSurvey
from rangesfm.planning.planned_photos import MAX_NUM_PHOTOS, PlannedPhotos, ascending
from rangesfm.survey.kinds_in_map import KINDS
from rangesfm.survey.survey_reader import parse_toml, refuse_unknown_tables, with_absolute_paths
from rangesfm.util.files.contents import AnyPath
from rangesfm.util.geometry.trajectory import Trajectory

_Spot = Annotated[tuple[Coordinate, Coordinate], Field(strict=False)]
# A plan with more anchors, or of a longer survey (seconds), would take minutes.
_MAX_NUM_ANCHORS, _MAX_DURATION_S = 64, 1e5
# Keys in [path] that give a path, each instead of the others.
_PATHS = ("waypoints", "loop_inside_m", "file", "model")


def _going_somewhere(corners: tuple[tuple[float, float], ...]) -> tuple[tuple[float, float], ...]:
    if max(np.ptp(corners, axis=0), default=0.0) < LENGTH_M.least:
        raise ValueError("are one place")
    return corners


def _corners(corners: tuple[tuple[float, ...], tuple[float, ...]]) -> tuple[tuple[float, ...], tuple[float, ...]]:
    if any(low > high for low, high in zip(*corners, strict=True)) or corners[0][:2] == corners[1][:2]:
        raise ValueError("are no box")
    return corners


_Heights = Annotated[tuple[Coordinate, Coordinate], Field(strict=False), AfterValidator(ascending)]
_HEIGHTS = Key(expected="a list of 2 numbers, the larger one last")
_Corners = Annotated[tuple[_Spot, ...], Field(strict=False), AfterValidator(_going_somewhere)]


class PlannedAnchorOptions(Options, table="anchors"):
    """Planned anchors: their places in the site, in metres, z up."""

    path: Annotated[Path | None, Key(role="file")] = None
    """CSV file anchor_id,x_m,y_m,z_m[,position_stddev_m,range_bias_m,range_bias_stddev_m], each with a position."""
    places: Annotated[dict[str, Place], Key(expected="a table in which each value is a list of 3 numbers")] = Field(
        default_factory=dict
    )
    """Positions x, y, z by anchor id, instead of path."""
    frame: Literal["site", "first_camera", "unknown"] = "site"
    """Knowledge of the positions in a run: surveyed in the site, in the first camera's frame, or not at all."""
    position_stddev_m: Uncertainty = 0.0
    """Standard deviation to which each coordinate in places will be known."""
    num_to_place: Annotated[int, Field(ge=1, le=_MAX_NUM_ANCHORS)] | None = None
    """Number of anchors to place where they help most, in the region or on the walls, instead of places and path."""
    region_m: Annotated[
        Annotated[tuple[Place, Place], Field(strict=False), AfterValidator(_corners)] | None,
        Key(expected="two places, the second one in no coordinate smaller"),
    ] = None
    """Two opposite corners x, y, z of the box in which anchors may be placed."""
    walls_m: Annotated[
        tuple[_Corners, ...],
        Field(strict=False),
        Key(expected="a list of walls, each a list of 2 corners x, y or more"),
    ] = ()
    """Walls on which anchors may be placed instead, at heights_m: each a list of corners x, y as seen from above."""
    heights_m: Annotated[_Heights | None, _HEIGHTS] = None
    """Lowest and highest height of anchors (default: not below the ground)."""


class PlannedPathOptions(Options, table="path"):
    """Planned path of the camera: waypoints, a loop, a trajectory, or a model."""

    waypoints: Annotated[tuple[Place, ...], Field(strict=False), Key(expected="a list of lists of 3 numbers")] = ()
    """Points x, y, z in the site that the camera passes; it looks ahead, and its path is rounded off at corners."""
    loop_inside_m: Annotated[
        tuple[_Spot, ...],
        Field(strict=False, min_length=3),
        Key(expected="a list of 3 corners x, y or more"),
    ] = ()
    """Corners of a floor instead; a loop two thirds as wide is walked in it, up and down between heights_m."""
    heights_m: Annotated[_Heights, _HEIGHTS] = (1.2, 2.0)
    """Lowest and highest height of the camera on that loop."""
    speed_m_per_s: Annotated[float, Field(ge=0.01, le=100)] = 0.8
    """Speed along the waypoints or the loop."""
    turn_deg_per_s: Annotated[float, Field(ge=1, le=360)] = 30.0
    """Angular velocity with which the camera turns in the sharpest corner."""
    num_rounds: Annotated[int, Field(ge=1, le=1000)] = 1
    """Number of times that they are walked; each further round starts by going back to the first waypoint."""
    file: Annotated[Path | None, Key(role="file")] = None
    """A recorded trajectory instead, TUM or CSV, with rotations."""
    model: Annotated[Path | None, Key(role="model")] = None
    """A metric COLMAP model in the site's frame instead, its photos in the order of their names."""
    photo_rate_hz: Annotated[float, Field(ge=0.5, le=100)] = 2.0
    """Keyframes per second."""
    is_level: bool = False
    """True if the camera cannot go up and down, as on a rover."""


class PlannedPointOptions(Options, table="points"):
    """Planned control points: marks whose coordinates in the site will be known, beside anchors or without any."""

    path: Annotated[Path | None, Key(role="file")] = None
    """CSV file marker,x_m,y_m,z_m[,stddev_m,kind]."""
    places: Annotated[dict[str, Place], Key(expected="a table in which each value is a list of 3 numbers")] = Field(
        default_factory=dict
    )
    """Coordinates x, y, z of control points by name, instead of path. Photos must show them ([photos], its defaults
    without that table)."""
    stddev_m: Annotated[float, Field(ge=1e-4, le=1e3)] = 0.01
    """Standard deviation of each coordinate of a point for which the file has none."""


class PlannedRadioOptions(RangeModelOptions, table="radio"):
    """Planned radio."""

    rate_hz: Annotated[float, Field(ge=1e-3, le=1e4)] = 5.0
    """Ranges to each anchor per second."""
    like: Literal[LOGS] | None = None  # type: ignore[valid-type]
    """Public log whose radio has the same errors as this one (default: usual errors of radios)."""
    curve_stddev_m: Annotated[float, Field(ge=1e-4, le=1)] | None = None
    """Standard deviation of the radio's error curve after a calibration (default: not calibrated)."""
    stddevs: dict[str, Annotated[float, Field(ge=1e-9, le=10)]] = Field(default_factory=dict)
    """Standard deviations of components of the range errors, named as in result.json (default: those of like)."""


_TABLES: tuple[type[Options], ...] = (PlannedAnchorOptions, PlannedPathOptions, PlannedRadioOptions, TagOptions)
# Tables that say nothing where they are missing.
_OPTIONAL_TABLES: tuple[type[Options], ...] = (PlannedPhotos, PlannedPointOptions, PlannedAntenna)


def plan_tables() -> dict[str, type[Options]]:
    """Return the tables of a plan file, by name."""
    of_kinds = (kind.planned for kind in KINDS if kind.planned is not None)
    return {table.table: table for table in (*_TABLES, *_OPTIONAL_TABLES, *of_kinds)}


def read_plan(path: AnyPath) -> PlannedSurvey:
    """Read a plan file; paths in it are relative to the file's folder.

    Raises:
        InputError: a table or key is unknown, a value has the wrong type or is out of bounds, anchors or path are
            missing, or a file does not exist. The error gives the line where possible.
    """
    tables, source = parse_toml(Path(path))
    folder = Path(path).absolute().parent
    with source.naming_lines():
        known = plan_tables()
        refuse_unknown_tables(tables, known)
        options: dict[str, Any] = {
            name: model(**with_absolute_paths(tables.get(name, {}), model, folder))
            for name, model in known.items()
            if model in _TABLES or name in tables
        }
        planned = _planned(**options)
        odd = _checked(planned, options["anchors"], options["path"], options.get("points"))
    return replace(planned, warnings=tuple(str(source.located(error)) for error in odd))


def _checked(
    planned: PlannedSurvey,
    anchors: PlannedAnchorOptions,
    path: PlannedPathOptions,
    points: PlannedPointOptions | None,
) -> list[OptionError]:
    """Return what is odd about a plan.

    Raises:
        OptionError: it cannot be.
    """

    def anchor_key(anchor_id: str) -> str:
        return f"places.{anchor_id}" if anchors.places else "path" if anchors.path else "num_to_place"

    def point_key(name: str) -> str:
        return "path" if points is None or points.path else f"places.{name}"

    path_key = next(name for name in _PATHS if getattr(path, name))
    floors_m = [planned.walls_m[-1]] if path.loop_inside_m else []
    require_possible(planned, floors_m, path_key, anchor_key, point_key)
    return list(oddities(planned, [np.array(wall) for wall in anchors.walls_m], path_key, anchor_key))


def _planned(
    anchors: PlannedAnchorOptions,
    path: PlannedPathOptions,
    radio: PlannedRadioOptions,
    tag: TagOptions,
    photos: PlannedPhotos | None = None,
    points: PlannedPointOptions | None = None,
    positions: PlannedAntenna | None = None,
    **others: PlannedKind,
) -> PlannedSurvey:
    if tag.lever_arms_m:
        raise tag.refused("lever_arms_m", "is given, expected tag_in_cam_m: a plan has one tag")
    known = [component.name for component in COMPONENTS]
    if unknown := [name for name in radio.stddevs if name not in known]:
        message = f"[radio] stddevs: there is no component {unknown[0]!r}, expected some of {', '.join(known)}"
        raise OptionError(message, "radio", f"stddevs.{unknown[0]}")
    has_positions = points is not None or positions is not None
    has_others = has_positions or bool(others)
    if has_positions and anchors.frame == "first_camera":
        raise anchors.refused("frame", "is 'first_camera', expected site or unknown beside [points] and [positions]")
    allowed_m = _allowed(anchors)
    planned = PlannedSurvey(
        trajectory=_path(path),
        anchors=() if has_others and not anchors.model_fields_set else _anchors(anchors, allowed_m),
        anchor_frame=anchors.frame,
        rate_hz=radio.rate_hz,
        tag_in_cam_m=tag.tag_in_cam_m,
        range_model=radio,
        curve_stddev_m=radio.curve_stddev_m,
        component_stddevs=({} if radio.like is None else stddevs_in(radio.like)) | radio.stddevs,
        photos=photos,
        points=() if points is None else _points(points),
        antenna=positions,
        others=others,
        heights_m=anchors.heights_m,
        path_is_level=path.is_level,
        allowed_m=allowed_m,
        walls_m=_walls(anchors, path),
        is_placed=anchors.num_to_place is None,
    )
    if planned.duration_s > _MAX_DURATION_S:
        message = f"[path] takes {planned.duration_s:.3g} s, expected at most {_MAX_DURATION_S:g}"
        raise OptionError(message, "path")
    if planned.photos is not None and len(planned.trajectory) > MAX_NUM_PHOTOS:
        message = f"[photos] are {len(planned.trajectory)}, expected at most {MAX_NUM_PHOTOS}: lower photo_rate_hz"
        raise OptionError(message, "path", "photo_rate_hz")
    return planned


def _require_one(options: Options, *names: str) -> None:
    given = [name for name in names if getattr(options, name)]
    if len(given) != 1:
        found, known = " and ".join(given) or "none", f"{', '.join(names[:-1])} and {names[-1]}"
        raise OptionError(f"[{options.table}] has {found} of {known}, expected one", options.table)


def _points(points: PlannedPointOptions) -> tuple[ControlPoint, ...]:
    _require_one(points, "path", "places")
    if points.path is None:
        places = enumerate(points.places.items())
        return tuple(ControlPoint(name, np.array(at), points.stddev_m, CONTROL, k) for k, (name, at) in places)
    return read_control_points(PointOptions(path=points.path, stddev_m=points.stddev_m)).points


def _path(path: PlannedPathOptions) -> Trajectory:
    _require_one(path, *_PATHS)
    if path.file is not None:
        return path_from_file(path.file, path.photo_rate_hz)
    if path.model is not None:
        return path_from_model(path.model, path.photo_rate_hz)
    waypoints = path.waypoints or loop_inside(path.loop_inside_m, path.heights_m)
    return path_through(waypoints, path.speed_m_per_s, path.photo_rate_hz, path.num_rounds, path.turn_deg_per_s)


def _allowed(options: PlannedAnchorOptions) -> Array:
    """Return the places where anchors may be put (k, 3); empty if the plan gives none."""
    if not options.walls_m:
        return np.zeros((0, 3)) if options.region_m is None else places_in_box(*options.region_m)
    if options.region_m is not None or options.heights_m is None:
        raise options.refused("walls_m", "goes with heights_m and without region_m")
    return places_on_walls(options.walls_m, options.heights_m)


def _walls(anchors: PlannedAnchorOptions, path: PlannedPathOptions) -> tuple[Array, ...]:
    """Return the walls, and the outline of the floor, as corners (k, 2)."""
    floor = [(*path.loop_inside_m, path.loop_inside_m[0])] if path.loop_inside_m else []
    return tuple(np.array(corners, dtype=np.float64) for corners in (*anchors.walls_m, *floor))


def _anchors(options: PlannedAnchorOptions, allowed_m: Array) -> tuple[Anchor, ...]:
    _require_one(options, "path", "places", "num_to_place")
    if options.num_to_place is not None:
        if len(allowed_m) < options.num_to_place:
            found = f"is {options.num_to_place} and there are {len(allowed_m)} places to choose from"
            raise options.refused("num_to_place", f"{found}, expected a larger region_m or walls_m")
        return spread_anchors(options.num_to_place, allowed_m, options.position_stddev_m)
    if options.path is None:
        anchors = tuple(
            Anchor(anchor_id, np.array(place), options.position_stddev_m) for anchor_id, place in options.places.items()
        )
    else:
        anchors = read_anchors(options.path)
    for anchor in anchors:
        if anchor.position_m is None:
            expected = "its planned position ([anchors] frame says whether a run knows it)"
            raise InputError(f"anchor {anchor.anchor_id} has no position, expected {expected}", options.path)
    if len(anchors) > _MAX_NUM_ANCHORS:
        raise OptionError(f"[anchors] are {len(anchors)}, expected at most {_MAX_NUM_ANCHORS}", "anchors")
    return anchors
