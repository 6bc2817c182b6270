"""Measure how often a mistake in a survey is found and rightly named, and how often a clean survey is doubted.

Run: python -m tests.studies.mistakes [--out FILE] [--num_seeds 20] [--num_clean 67] [--surveys hall] [--kinds anchor]
     [--photos] [--room FOLDER --model FOLDER]
     python -m tests.studies.mistakes --out FILE --report

Three simulated surveys without photos, whose path is the true one with a smooth bend: a hall with six surveyed anchors,
a yard with four, a drone with one unknown anchor; and the real room, mapped before, with a tenth of its ranges. With
``--photos`` the hall and the yard are mapped from noisy features instead, so that their maps bend as maps do (30
features a photo, tracks of eight photos, no loops), and all stages run, refinement included. The
range errors are like those of real radios: white noise, errors that last for seconds, errors that depend on direction
and on distance, and ranges without line of sight. Each seed gives first a clean survey, then one with each kind of
mistake that the survey allows. The mistake's size is one of several multiples of the smallest size that the tests of
the clean survey say would be found. With --out each run is a line of a file, and runs that are there already are not
repeated.

Reported for each survey and each kind: in how many runs a mistake was found, the right one was named at all, or was
named first (or in the pair that nothing tells apart); the map was called good; and the map was called good though its
scale lies outside its interval or its place is more than three stddevs off.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from tests.simulated.runs import Run, run, run_with_photos
from tests.simulated.surveys import SITES, MadeSurvey, surveyed, surveyed_with_photos
from tests.studies.kept_runs import KeptRuns, seeds_parser
from tests.studies.real_room import real_room

Array = npt.NDArray[np.float64]

Mistake = Callable[[MadeSurvey, float, np.random.Generator], None]
Line = dict[str, Any]
Make = Callable[[int], MadeSurvey]
CLEAN = "clean"
RUN_NAMES = ("survey", "kind", "seed")
# A camera's axes (x right, y down, z forward) in terms of a robot's (x forward, y left, z up).
Z_UP = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
X_FORWARD = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
# Sizes in terms of the smallest size that is found; mistakes of twice that size must be found.
FACTORS = (2.0, 1.0, 2.0, 5.0)


@dataclass(frozen=True)
class Kind:
    """A kind of mistake.

    Attributes:
        name: of the kind.
        make: puts a mistake of some size into a survey.
        right: names (with subjects where they count), one of which must be named.
        of: name and subject of the test whose smallest detectable size is the unit; None: there is only one size.
    """

    name: str
    make: Mistake
    right: tuple[str, ...]
    of: tuple[str, str] | None = None


def kinds(ids: list[str]) -> list[Kind]:
    """List all kinds of mistakes that a survey with these anchors allows."""
    made: list[Kind] = []
    for k, name in enumerate(ids[:3]):
        for axis, letter in enumerate("xyz"):
            right: tuple[str, ...] = (f"anchor place {name}", f"anchor coordinate {name} {letter}")
            made.append(
                Kind(f"{name} {letter} typed wrong", partial(_place, name, axis), right, ("anchor place", name))
            )
        right = (f"anchor bias {name}",)
        made.append(Kind(f"{name} reads long", partial(_bias, name, 1), right, ("anchor bias", name)))
        made.append(Kind(f"{name} reads short", partial(_bias, name, -1), right, ("anchor bias", name)))
        right = (f"anchor moved {name}",)
        made.append(Kind(f"{name} moved", partial(_moved, name, (0.3, 0.5, 0.6)[k]), right, ("anchor moved", name)))
        right = (f"anchor step {name}",)
        made.append(Kind(f"{name} steps", partial(_step, name, (0.5, 0.4, 0.6)[k]), right, ("anchor step", name)))
        right = (f"anchor stretch {name}", f"anchor step {name}")
        made.append(
            Kind(f"{name} blocked", partial(_stretch, name, (0.2, 0.5, 0.7)[k]), right, ("anchor stretch", name))
        )
    for name in ids[:2]:
        right = (f"anchor range scale {name}", f"anchor hardly used {name}")
        made.append(Kind(f"{name} reads a constant", partial(_stuck, name), right))
        right = (
            f"anchor's outliers {name}",
            f"anchor hardly used {name}",
            f"anchor bias {name}",
        )
        made.append(Kind(f"{name} mostly blocked", partial(_blocked, name), right))
    for axis, letter in enumerate("xyz"):
        right = ("lever arm", "lever arm's axes")
        made.append(Kind(f"lever arm {letter}", partial(_lever, axis), right, ("lever arm", "")))
    made += [
        Kind("lever arm forgotten", _lever_forgotten, ("lever arm", "lever arm's axes")),
        Kind("lever arm's sign", partial(_lever_turned, -np.eye(3)), ("lever arm's axes", "lever arm")),
        Kind("lever arm as x forward", partial(_lever_turned, X_FORWARD), ("lever arm's axes", "lever arm")),
        Kind("lever arm as z up", partial(_lever_turned, Z_UP), ("lever arm's axes", "lever arm")),
        Kind("lever arm ten times as long", partial(_lever_turned, 10 * np.eye(3)), ("lever arm",)),
        Kind("tag slips", _tag_slips, ("tag slipped",), ("tag slipped", "")),
        Kind("lever arm as y up", partial(_lever_turned, np.diag([1.0, -1, -1])), ("lever arm's axes", "lever arm")),
        Kind("clock off", partial(_clock, 1), ("clock offset",), ("clock offset", "")),
        Kind("clock off, early", partial(_clock, -1), ("clock offset",), ("clock offset", "")),
        Kind("clock drifts", _clock_drift, ("clock drift", "clock jump"), ("clock drift", "")),
        Kind("clock jumps", _clock_jump, ("clock jump", "clock drift"), ("clock jump", "")),
        Kind("times in whole seconds", _whole_seconds, ("clock offset",)),
        Kind("photos' times reversed", _reversed, ("photos reversed",)),
        Kind("map breaks", _map_breaks, ("map break",), ("map break", "")),
        Kind("radio warms up", _warming, ("radio drift",), ("radio drift", "")),
        Kind("surveyor in between", _body, ("behind the camera",), ("behind the camera", "")),
        Kind("all step", partial(_step, None, 0.5), ("step",), ("step", "")),
        Kind("all step early", partial(_step, None, 0.25), ("step", "stretch"), ("step", "")),
        Kind("all blocked for a while", partial(_stretch, None, 0.4), ("stretch", "step"), ("stretch", "")),
        Kind("common bias", _common, ("common bias",), ("common bias", "")),
        Kind("half of the ranges long", partial(_long_share, 0.5), ("range noise", "common bias", "anchor's outliers")),
        Kind("70 % of the ranges long", partial(_long_share, 0.7), ("range noise", "common bias", "anchor's outliers")),
        Kind("noise of half a metre", _noisy, ("range noise",)),
    ]  # fmt: skip
    if ids:
        pair = ("range scale", "anchors' scale")
        places = tuple(f"anchor {what} {name}" for name in (*ids[1:3], ids[-1]) for what in ("place", "coordinate"))
        mixed = (f"anchor mixed up {ids[0]}",)
        made += [
            Kind("ranges long by a share", _range_share, pair, ("range scale", "")),
            Kind("anchors too small by a share", _anchor_share, pair, ("anchors' scale", "")),
            Kind("ranges in feet", partial(_ranges_times, 1 / 0.3048), ("anchors' unit", *pair)),
            Kind("ranges of both ways", partial(_ranges_times, 2.0), ("anchors' unit", *pair)),
            Kind("two anchors typed wrong", partial(_two_places, ids), places, ("anchor place", ids[1])),
            Kind("a decimal point lost", partial(_coordinate, ids[-1], 0, 10.0), places[-2:]),
            Kind("a sign lost", partial(_coordinate, ids[-1], 1, -1.0), places[-2:]),
            Kind("lines of the anchors' file one off", _rotated, ("lines shifted",)),
            Kind(f"a third of {ids[0]} is of {ids[1]}", partial(_taken_for, ids[0], ids[1]), mixed),
            Kind("y and z swapped", partial(_axes, np.eye(3)[[0, 2, 1]]), ("anchors' axes",)),
            Kind("anchors in feet", _feet, ("anchors' unit", *pair)),
            Kind("x and y swapped", partial(_axes, np.eye(3)[[1, 0, 2]]), ("anchors' axes",)),
            Kind("heights as depths", partial(_axes, np.diag([1.0, 1, -1])), ("anchors' axes",)),
            Kind("x mirrored", partial(_axes, np.diag([-1.0, 1, 1])), ("anchors' axes",)),
            Kind("heights never measured", partial(_axes, np.diag([1.0, 1, 0])), ("anchor heights",)),
        ]
        for first, second in ((0, 1), (1, 2), (0, 2)):
            names = ", ".join(sorted((ids[first], ids[second]), key=sorted(ids).index))
            made.append(Kind(f"labels {names}", partial(_swap, ids[first], ids[second]), (f"labels swapped {names}",)))
    return made


def _place(name: str, axis: int, given: MadeSurvey, size: float, rng: np.random.Generator) -> None:
    given.anchors_m[name] = given.anchors_m[name] + rng.choice([-1, 1]) * size * np.eye(3)[axis]


def _bias(name: str, sign: int, given: MadeSurvey, size: float, rng: np.random.Generator) -> None:
    given.range_m = given.range_m + sign * size * given.is_of(name)


def _common(given: MadeSurvey, size: float, rng: np.random.Generator) -> None:
    given.range_m = given.range_m + size


def _moved(name: str, share: float, given: MadeSurvey, size: float, rng: np.random.Generator) -> None:
    direction = rng.normal(size=3) * [1, 1, 0.3]
    at = given.true_anchors_m[name]
    to = at + size * direction / np.linalg.norm(direction)
    after = given.is_of(name) & (given.time_s > np.quantile(given.time_s, share))
    grown = np.linalg.norm(given.tags_m - to, axis=1) - np.linalg.norm(given.tags_m - at, axis=1)
    given.range_m = given.range_m + np.where(after, grown, 0.0)


def _step(name: str | None, share: float, given: MadeSurvey, size: float, rng: np.random.Generator) -> None:
    is_of = np.ones(len(given.time_s), dtype=bool) if name is None else given.is_of(name)
    given.range_m = given.range_m + size * (is_of & (given.time_s > np.quantile(given.time_s, share)))


def _stretch(name: str | None, share: float, given: MadeSurvey, size: float, rng: np.random.Generator) -> None:
    is_of = np.ones(len(given.time_s), dtype=bool) if name is None else given.is_of(name)
    low, high = np.quantile(given.time_s, [share, share + 0.15])
    given.range_m = given.range_m + size * (is_of & (given.time_s > low) & (given.time_s < high))


def _stuck(name: str, given: MadeSurvey, size: float, rng: np.random.Generator) -> None:
    given.range_m = np.where(given.is_of(name), np.median(given.range_m[given.is_of(name)]), given.range_m)


def _blocked(name: str, given: MadeSurvey, size: float, rng: np.random.Generator) -> None:
    is_long = given.is_of(name) & (rng.random(len(given.time_s)) < 0.7)
    given.range_m = given.range_m + is_long * rng.exponential(1.5, len(given.time_s))


def _long_share(share: float, given: MadeSurvey, size: float, rng: np.random.Generator) -> None:
    is_long = rng.random(len(given.time_s)) < share
    given.range_m = given.range_m + is_long * rng.exponential(1.0, len(given.time_s))


def _noisy(given: MadeSurvey, size: float, rng: np.random.Generator) -> None:
    given.range_m = given.range_m + 0.5 * rng.standard_normal(len(given.time_s))


def _lever(axis: int, given: MadeSurvey, size: float, rng: np.random.Generator) -> None:
    given.tag_in_cam_m = given.tag_in_cam_m + rng.choice([-1, 1]) * size * np.eye(3)[axis]


def _lever_forgotten(given: MadeSurvey, size: float, rng: np.random.Generator) -> None:
    given.tag_in_cam_m = np.zeros(3)


def _lever_turned(axes: Array, given: MadeSurvey, size: float, rng: np.random.Generator) -> None:
    given.tag_in_cam_m = axes @ given.tag_in_cam_m


def _clock(sign: int, given: MadeSurvey, size: float, rng: np.random.Generator) -> None:
    given.time_offset_s = given.time_offset_s + sign * size


def _clock_drift(given: MadeSurvey, size: float, rng: np.random.Generator) -> None:
    middle = given.time_s.mean()
    given.time_s = middle + (1 + size) * (given.time_s - middle)


def _clock_jump(given: MadeSurvey, size: float, rng: np.random.Generator) -> None:
    given.time_s = given.time_s + size * (given.time_s > np.quantile(given.time_s, 0.5))


def _tag_slips(given: MadeSurvey, size: float, rng: np.random.Generator) -> None:
    """Let the tag slip along the camera's z at half time, so that its measured position is wrong from then on."""
    after = given.time_s > np.quantile(given.time_s, 0.5)
    slipped_m = given.tags_m + after[:, None] * (
        given.world_from_cam @ np.array([0.0, 0.0, rng.choice([-1, 1]) * size])
    )
    given.range_m = given.range_m + _grown(given, slipped_m)


def _grown(given: MadeSurvey, tags_m: Array) -> Array:
    """(n,) increase of the distances if the tags were at ``tags_m``."""
    return replace(given, tags_m=tags_m).distances_m - given.distances_m


def _map_breaks(given: MadeSurvey, size: float, rng: np.random.Generator) -> None:
    """Displace the second half of the map, as a false match would; its true place is then that of the first half."""
    path = given.trajectory
    times = path.times_s
    direction = rng.normal(size=3)
    after = (times > np.quantile(times, 0.45))[:, None]
    by = size / given.metres_per_unit * direction / np.linalg.norm(direction)
    given.trajectory = replace(path, centers=path.centers + after * by)


def _warming(given: MadeSurvey, size: float, rng: np.random.Generator) -> None:
    """Let all ranges grow over time."""
    given.range_m = given.range_m + size * (given.time_s - given.time_s.min()) / np.ptp(given.time_s)


def _body(given: MadeSurvey, size: float, rng: np.random.Generator) -> None:
    """Lengthen the ranges to anchors behind the person who carries the camera."""
    ahead = given.world_from_cam[:, :, 2]
    given.range_m = given.range_m + size * (np.sum(given.from_anchor_m * ahead, axis=1) > 0)


def _whole_seconds(given: MadeSurvey, size: float, rng: np.random.Generator) -> None:
    given.time_s = np.floor(given.time_s)


def _reversed(given: MadeSurvey, size: float, rng: np.random.Generator) -> None:
    given.time_s = given.time_s.min() + given.time_s.max() - given.time_s


def _ranges_times(factor: float, given: MadeSurvey, size: float, rng: np.random.Generator) -> None:
    given.range_m = given.range_m * factor


def _two_places(ids: Sequence[str], given: MadeSurvey, size: float, rng: np.random.Generator) -> None:
    for name, axis in ((ids[1], 0), (ids[2], 1)):
        _place(name, axis, given, size, rng)


def _coordinate(name: str, axis: int, factor: float, given: MadeSurvey, size: float, rng: np.random.Generator) -> None:
    at = given.anchors_m[name].copy()
    at[axis] *= factor
    given.anchors_m[name] = at


def _rotated(given: MadeSurvey, size: float, rng: np.random.Generator) -> None:
    at = list(given.anchors_m.values())
    given.anchors_m = dict(zip(given.anchors_m, [*at[1:], at[0]], strict=True))


def _taken_for(name: str, other: str, given: MadeSurvey, size: float, rng: np.random.Generator) -> None:
    rows = np.flatnonzero(given.is_of(name) & (rng.random(len(given.time_s)) < 1 / 3))
    true = given.true_anchors_m
    longer = [np.linalg.norm(given.tags_m[rows] - true[each], axis=1) for each in (other, name)]
    given.range_m[rows] += longer[0] - longer[1]


def _range_share(given: MadeSurvey, size: float, rng: np.random.Generator) -> None:
    given.range_m = given.range_m * (1 + size)


def _anchor_share(given: MadeSurvey, size: float, rng: np.random.Generator) -> None:
    given.anchors_m = {name: at * (1 - size) for name, at in given.anchors_m.items()}


def _feet(given: MadeSurvey, size: float, rng: np.random.Generator) -> None:
    given.anchors_m = {name: at / 0.3048 for name, at in given.anchors_m.items()}


def _axes(axes: Array, given: MadeSurvey, size: float, rng: np.random.Generator) -> None:
    given.anchors_m = {name: axes @ at for name, at in given.anchors_m.items()}


def _swap(first: str, second: str, given: MadeSurvey, size: float, rng: np.random.Generator) -> None:
    anchors = given.anchors_m
    given.anchors_m = {**anchors, first: anchors[second], second: anchors[first]}


def main() -> None:
    parser = seeds_parser(__doc__, None, 20)
    parser.set_defaults(kinds=[""])
    parser.add_argument("--report", action="store_true", help="tell what the file holds, and run nothing")
    parser.add_argument("--num_clean", type=int, default=67, help="of each simulated survey")
    parser.add_argument("--surveys", default="", help="only those whose name begins so")
    parser.add_argument("--photos", action="store_true", help="map the hall and the yard from noisy features")
    parser.add_argument("--room", type=Path, help="folder of the real room's data")
    parser.add_argument("--model", type=Path, help="folder of the model of its photos")
    args = parser.parse_args()
    kept = KeptRuns(args.out, *RUN_NAMES)
    sites = [(site.name, site.anchor_frame, list(site.anchors_m), partial(surveyed, site)) for site in SITES]
    if args.photos:
        sites = [
            (f"{site.name}, photos", "site", list(site.anchors_m), partial(surveyed_with_photos, site))
            for site in SITES
            if site.anchor_frame == "site"
        ]
    if args.room:
        read = partial(real_room, args.room, args.model)
        sites = [("room", "site", list(read(0).anchors_m), read)]
    num = 0 if args.report else max(args.num_seeds, args.num_clean)
    for seed in range(args.seed, args.seed + num):
        is_wanted = seed < args.seed + args.num_seeds
        for name, frame, ids, make in (site for site in sites if site[0].startswith(args.surveys)):
            every = enumerate(kinds(ids if frame != "unknown" else []))
            wanted = [
                (number, kind) for number, kind in every if is_wanted and any(part in kind.name for part in args.kinds)
            ]
            run_seed(kept, name, wanted, make, seed)
    report(kept.rows)


def run_seed(kept: KeptRuns, survey: str, numbered_kinds: Sequence[tuple[int, Kind]], make: Make, seed: int) -> None:
    """Run a seed without and with mistakes; a kind's number and the seed decide on the mistake's size."""
    clean = kept.run(lambda: told(outcome(make(seed), seed)), survey=survey, kind=CLEAN, seed=seed)
    for number, kind in numbered_kinds:
        factor, size = FACTORS[(seed + number) % len(FACTORS)], 1.0
        if kind.of is not None:
            smallest = (clean["smallest"] or {}).get(" ".join(kind.of).strip())
            if smallest is None:
                continue
            size = factor * smallest
        given = make(seed)
        if not (kind.make is _map_breaks and given.sfm is not None):  # its photos would have to break, too
            run_kind = partial(run_with_mistake, kind, given, seed, factor, size)
            kept.run(run_kind, survey=survey, kind=kind.name, seed=seed)


def run_with_mistake(kind: Kind, given: MadeSurvey, seed: int, factor: float, size: float) -> Line:
    kind.make(given, size, np.random.default_rng([seed, 7]))
    given.needs_search = kind.of is None
    return told(outcome(given, seed), kind.right, factor if kind.of else None, size)


def outcome(given: MadeSurvey, seed: int) -> Run:
    return run(given, seed) if given.sfm is None else run_with_photos(given, seed)


def told(run_: Run, right: tuple[str, ...] = (), factor: float | None = None, size: float | None = None) -> Line:
    """Return the figures of a run that the report needs; nothing is right to name where no mistake was made."""
    line: Line = {"factor": factor, "size": size}
    if run_.diagnosis is None or run_.estimate is None:
        return {**line, "refused": run_.refusal, "smallest": None}
    tests = run_.diagnosis.tests
    causes = [f"{c.name} {c.subject}".strip() for c in run_.diagnosis.causes]
    rejected = [f"{t.name} {t.subject}".strip() for t in tests if t.rejected]
    of_evidence = [f"{t.name} {t.subject}".strip() for t in tests if t.rejected and not np.isfinite(t.stddev)]
    named = [name for name in dict.fromkeys([*rejected, *causes]) if name in causes or name in of_evidence]
    # A test named before the causes is what the survey's first sentence says.
    first = named[:1] if named and f"{tests[0].name} {tests[0].subject}".strip() not in causes else causes
    effects = [(t.effect_on_scale, f"{t.name} {t.subject}".strip()) for t in tests if np.isfinite(t.effect_on_scale)]
    return {
        **line,
        "refused": "",
        "named": named,
        "is_named": any(_is(name, right) for name in named),
        "is_first": any(_is(name, right) for name in first),
        "found": bool(named),
        "doubts": run_.doubts,
        "wrong": run_.is_wrong,
        "place": run_.place_in_stddevs,
        "half_width": run_.estimate.uncertainty.half_width_95,
        "log_error": float(np.log(run_.estimate.value / run_.survey.metres_per_unit)),
        "hidden": max(effects, default=None),
        "smallest": {
            f"{t.name} {t.subject}".strip(): t.smallest_detectable
            for t in tests
            if not right and np.isfinite(t.smallest_detectable)
        },
    }


def _is(name: str, right: tuple[str, ...]) -> bool:
    return any(name == r or name.startswith(f"{r} ") for r in right)


def counted(lines: Sequence[Line]) -> str:
    """Return the counts of runs in words."""
    judged = [line for line in lines if not line["refused"]]
    good = [line for line in judged if not line["doubts"]]
    found, named, first = (sum(line[key] for line in judged) for key in ("found", "is_named", "is_first"))
    return (
        f"{len(lines):5} runs,{len(lines) - len(judged):4} refused,{found:5} found,{named:5} named,"
        f"{first:5} first,{len(good):5} good, of these{sum(line['wrong'] for line in good):3} outside the interval,"
        f"{sum(line['place'] > 3 for line in good):3} out of place"
    )


def report(lines: list[Line]) -> None:
    """Print the counts by kind and survey, by size, and in total."""
    made = [line for line in lines if line["kind"] != CLEAN]
    for survey in dict.fromkeys(line["survey"] for line in lines):
        clean = [line for line in lines if line["kind"] == CLEAN and line["survey"] == survey]
        widths = [line["half_width"] for line in clean if not line["refused"]]
        print(f"{survey}: {'clean':34}{counted(clean)}; median half width {100 * np.median(widths):.2f} %")
        for name in dict.fromkeys(line["kind"] for line in made if line["survey"] == survey):
            own = [line for line in made if (line["survey"], line["kind"]) == (survey, name)]
            print(f"{survey}: {name:34}{counted(own)}")
    for factor in [None, *sorted(set(FACTORS))]:
        which = "of one size" if factor is None else f"of {factor} times the smallest detectable size"
        print(f"{which:40}{counted([line for line in made if line['factor'] == factor])}")
    print(f"{'all mistakes':40}{counted(made)}")
    print(f"{'all clean':40}{counted([line for line in lines if line['kind'] == CLEAN])}")


if __name__ == "__main__":
    main()
