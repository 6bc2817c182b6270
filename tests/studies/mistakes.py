"""How often a mistake in a survey is found and rightly named, and how often a clean survey is doubted.

Run: python -m tests.studies.mistakes [--num_seeds 20] [--num_clean 70] [--seed 0] [--surveys hall] [--kinds anchor]
     [--quick] [--verbose]

Three simulated surveys without photos, whose path is the true one with a smooth bend: a hall with six surveyed
anchors, a yard with four, a drone with one unknown anchor. Errors as of real radios: white, lasting for seconds, of the
direction, of the distance, and ranges without line of sight. First clean surveys; then each kind of mistake that the
survey allows, of twice the size that the clean surveys say would be found. Printed for each survey and each kind: in
how many runs the tests found a mistake, named the right one first (or in the pair that nothing tells apart), gave its
size within three stddevs, and in how many the scale was called good and lay outside its interval.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import dataclass, fields, replace

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation
from tests.simulated.path import loop_path
from tests.studies.scale_coverage import drifting, error_curve

from rangesfm.demo.ranges import CameraPath
from rangesfm.errors import GeometryError
from rangesfm.geometry.trajectory import Trajectory
from rangesfm.options import ScaleOptions
from rangesfm.ranging.anchors.anchor import Anchor
from rangesfm.ranging.association import associate
from rangesfm.ranging.log import RangeLog
from rangesfm.ranging.observations import RangeStatus
from rangesfm.scale.estimate import ScaleEstimate
from rangesfm.scale.initialize import initialize_scale
from rangesfm.trust.ranges_on_map import RangesOnMap, ranges_on_map
from rangesfm.trust.verdict import TrustVerdict, trust_in

Array = npt.NDArray[np.float64]

METRES_PER_UNIT = 2.3
LASTING_STDDEV_M, DIRECTION_STDDEV_M, CURVE_STDDEV_M, BIAS_STDDEV_M, COMMON_BIAS_STDDEV_M = 0.03, 0.03, 0.03, 0.01, 0.05
OBSTRUCTED_SHARE, OBSTRUCTED_MEAN_M = 0.04, 0.7
BEND_SHARE = 0.002
# A camera's x right, y down, z forward by a robot's x forward, y left, z up.
X_FORWARD = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])


@dataclass(frozen=True)
class Site:
    """A kind of survey; the anchor frame as of ``initialize_scale``."""

    name: str
    path: Callable[[int], CameraPath]
    anchors_m: dict[str, tuple[float, float, float]]
    frame: str
    rate_hz: float
    stddev_m: float
    tag_in_cam_m: tuple[float, float, float]


SITES = (
    Site(
        "hall",
        lambda seed: loop_path(
            120.0, center_m=(10, 7, 1.7), semi_axes_m=(7, 4.5), height_amplitude_m=0.4, num_turns=2.2,
            unsteadiness_m=0.4, seed=seed,
        ),
        {"A1": (0.3, 0.2, 3.9), "A2": (19.6, 0.4, 1.2), "A3": (19.4, 13.6, 4.2), "A4": (0.2, 13.4, 0.9),
         "A5": (9.8, 0.1, 2.6), "A6": (10.1, 13.8, 0.4)},
        "site",
        5.0,
        0.06,
        (0.06, -0.15, -0.04),
    ),
    Site(
        "yard",
        lambda seed: loop_path(
            160.0, center_m=(0, 0, 1.6), semi_axes_m=(12, 9), height_amplitude_m=0.6, num_turns=1.7,
            unsteadiness_m=0.6, seed=seed,
        ),
        {"N": (2.0, 17.0, 4.5), "E": (19.0, 1.5, 0.6), "S": (-3.0, -15.5, 3.2), "W": (-18.0, 2.0, 1.4)},
        "site",
        3.0,
        0.1,
        (0.1, -0.25, 0.02),
    ),
    Site(
        "drone",
        lambda seed: loop_path(
            100.0, center_m=(0, 0, 6), semi_axes_m=(10, 7), height_amplitude_m=2.5, num_turns=2.1,
            unsteadiness_m=1.0, seed=seed,
        ),
        {"B": (4.0, -5.0, 1.0)},
        "unknown",
        10.0,
        0.08,
        (0.02, 0.12, -0.06),
    ),
)  # fmt: skip


@dataclass
class Given:
    """What a surveyor hands over, right or wrong; times in seconds of the camera's clock."""

    trajectory: Trajectory
    anchors_m: dict[str, Array]
    frame: str
    tag_in_cam_m: Array
    time_s: Array
    anchor: npt.NDArray[np.int64]
    range_m: Array
    tags_m: Array
    true_anchors_m: dict[str, Array]
    world_from_cam: Array
    path: CameraPath
    time_offset_s: float = 0.0

    @property
    def ids(self) -> list[str]:
        return list(self.true_anchors_m)

    def is_of(self, name: str) -> npt.NDArray[np.bool_]:
        return np.asarray(self.anchor == self.ids.index(name))


def surveyed(site: Site, seed: int) -> Given:
    """A clean survey."""
    rng = np.random.default_rng([seed, len(site.name)])
    path = site.path(seed)
    duration = path.end_s - path.start_s
    ids = list(site.anchors_m)
    turn = np.arange(int(duration * site.rate_hz) * len(ids))
    times, anchor = path.start_s + turn / (site.rate_hz * len(ids)), turn % len(ids)
    world_from_cam = path.world_from_cam(times)
    tags = path.centers(times) + world_from_cam @ np.array(site.tag_in_cam_m)
    anchors = {name: np.array(at) for name, at in site.anchors_m.items()}
    given = Given(
        mapped(path, rng), dict(anchors), site.frame, np.array(site.tag_in_cam_m), times, anchor, np.zeros(len(times)),
        tags, anchors, world_from_cam, path,
    )  # fmt: skip
    given.range_m = distances(given) + radio_errors(given, site.stddev_m, rng)
    return given


def distances(given: Given) -> Array:
    anchors_m = np.array(list(given.true_anchors_m.values()))
    return np.asarray(np.linalg.norm(given.tags_m - anchors_m[given.anchor], axis=1))


def mapped(path: CameraPath, rng: np.random.Generator) -> Trajectory:
    """The path as a mapper leaves it: bent a little, in a unit and a world of its own."""
    times = np.arange(path.start_s, path.end_s, 0.5)
    centers, rotations = path.centers(times), path.world_from_cam(times)
    knots = np.linspace(times[0], times[-1], 7)
    extent = float(np.linalg.norm(np.std(centers, axis=0)))
    bend = BEND_SHARE * extent * rng.standard_normal((len(knots), 3))
    bent = centers + np.column_stack([np.interp(times, knots, bend[:, k]) for k in range(3)])
    true = Trajectory(
        np.arange(1, len(times) + 1), tuple(f"{k:04d}.jpg" for k in range(len(times))), times, bent, rotations
    )
    turn = Rotation.from_quat(rng.normal(size=4)).as_matrix()
    return true.transformed(1 / METRES_PER_UNIT, turn, rng.normal(size=3))


def radio_errors(given: Given, stddev_m: float, rng: np.random.Generator) -> Array:
    distance = distances(given)
    errors = stddev_m * rng.standard_normal(len(distance)) + COMMON_BIAS_STDDEV_M * rng.standard_normal()
    errors += CURVE_STDDEV_M * error_curve(distance, rng)
    for k, at in enumerate(given.true_anchors_m.values()):
        rows = np.flatnonzero(given.anchor == k)
        direction = (given.tags_m[rows] - at) / distance[rows, None]
        form = rng.normal(0, DIRECTION_STDDEV_M, (3, 3))
        errors[rows] += np.einsum("ni,ij,nj->n", direction, form, direction) + BIAS_STDDEV_M * rng.standard_normal()
        errors[rows] += LASTING_STDDEV_M * drifting(given.time_s[rows], rng)
    errors += (rng.random(len(errors)) < OBSTRUCTED_SHARE) * rng.exponential(OBSTRUCTED_MEAN_M, len(errors))
    return np.asarray(errors)


@dataclass(frozen=True)
class Run:
    """One survey as it went; None where the scale was refused."""

    estimate: ScaleEstimate | None
    trust: TrustVerdict | None
    on_map: RangesOnMap | None = None
    refusal: str = ""

    @property
    def is_wrong(self) -> bool:
        """Whether the scale lies outside its interval."""
        if self.estimate is None:
            return False
        low, high = self.estimate.interval_95
        return not low <= METRES_PER_UNIT <= high


def run(given: Given, seed: int) -> Run:
    """The scale stage and the tests after it."""
    log = RangeLog.from_arrays(
        np.array(given.ids)[given.anchor], np.maximum(given.range_m, 0.02), timestamp_s=given.time_s
    )
    observations = associate(log, given.trajectory, given.tag_in_cam_m, time_offset_s=given.time_offset_s)
    anchors = [Anchor(name, None if given.frame == "unknown" else at) for name, at in given.anchors_m.items()]
    options = ScaleOptions(max_relative_stddev=0.5, num_bootstrap=50)
    try:
        estimate = initialize_scale(
            observations, given.trajectory, anchors, anchor_frame=given.frame, options=options, seed=seed
        )
    except GeometryError as error:
        return Run(None, None, refusal=str(error))
    on_map = ranges_on_map(
        estimate.observations, given.trajectory, estimate.metric_from_sfm, estimate.anchors, estimate.errors,
        by_status(estimate), frame_is_free=estimate.frame == "site",
    )  # fmt: skip
    return Run(estimate, trust_in(on_map, seed=seed), on_map)


def by_status(estimate: ScaleEstimate) -> Array:
    """(n,) robust weights, as far as the statuses tell them."""
    return np.where(estimate.observations.status <= RangeStatus.DOWN_WEIGHTED, 1.0, 0.0)


Mistake = Callable[[Given, float, np.random.Generator], None]


@dataclass(frozen=True)
class Kind:
    """A kind of mistake.

    Attributes:
        name: of the kind. make: puts it into a survey, of a size.
        size: fixed; None: twice the smallest that the clean surveys say is found, of the test ``of``.
        of: name and subject of the test that tells the size.
        right: names (with subjects where they count) of which one must be named.
    """

    name: str
    make: Mistake
    right: tuple[str, ...]
    of: tuple[str, str] | None = None
    size: float = 1.0


def kinds(site: Site) -> list[Kind]:
    """All that this survey allows."""
    made: list[Kind] = []
    ids = list(site.anchors_m) if site.frame != "unknown" else []
    for k, name in enumerate(ids[:3]):
        for axis, letter in enumerate("xyz"):
            right: tuple[str, ...] = (f"anchor place {name}", f"anchor coordinate {name} {letter}")
            made.append(Kind(f"{name} {letter} typed wrong", _place(name, axis), right, ("anchor place", name)))
        right = (f"anchor bias {name}",)
        made.append(Kind(f"{name} reads long", _bias(name), right, ("anchor bias", name)))
        made.append(Kind(f"{name} reads short", _bias(name, -1), right, ("anchor bias", name)))
        right = (f"anchor moved {name}",)
        made.append(Kind(f"{name} moved", _moved(name, (0.3, 0.5, 0.6)[k]), right, ("anchor moved", name)))
        right = (f"anchor step {name}",)
        made.append(Kind(f"{name} steps", _step(name, (0.5, 0.4, 0.6)[k]), right, ("anchor step", name)))
        right = (f"anchor stretch {name}", f"anchor step {name}")
        made.append(Kind(f"{name} blocked", _stretch(name, (0.2, 0.5, 0.7)[k]), right, ("anchor stretch", name)))
    for name in ids[:2]:
        right = (f"anchor share {name}", f"anchor hardly used {name}", f"anchor place {name}")
        made.append(Kind(f"{name} reads a constant", _stuck(name), right))
        right = (
            f"anchor's outliers {name}",
            f"anchor hardly used {name}",
            f"anchor bias {name}",
            f"anchor place {name}",
        )
        made.append(Kind(f"{name} mostly blocked", _blocked(name), right))
    for axis, letter in enumerate("xyz"):
        right = ("lever arm", "lever arm's axes")
        made.append(Kind(f"lever arm {letter}", _lever(axis), right, ("lever arm", "")))
    made += [
        Kind("lever arm forgotten", _lever_forgotten, ("lever arm", "lever arm's axes")),
        Kind("lever arm's sign", _lever_turned(-np.eye(3)), ("lever arm's axes", "lever arm")),
        Kind("lever arm as x forward", _lever_turned(X_FORWARD), ("lever arm's axes", "lever arm")),
        Kind("lever arm as y up", _lever_turned(np.diag([1.0, -1, -1])), ("lever arm's axes", "lever arm")),
        Kind("clock off", _clock(1), ("clock offset",), ("clock offset", "")),
        Kind("clock off, early", _clock(-1), ("clock offset",), ("clock offset", "")),
        Kind("clock drifts", _clock_drift, ("clock drift", "clock jump"), ("clock drift", "")),
        Kind("clock jumps", _clock_jump, ("clock jump", "clock drift"), ("clock jump", "")),
        Kind("all step", _step(None, 0.5), ("step",), ("step", "")),
        Kind("all step early", _step(None, 0.25), ("step", "stretch"), ("step", "")),
        Kind("all blocked for a while", _stretch(None, 0.4), ("stretch", "step"), ("stretch", "")),
        Kind("common bias", _common, ("common bias",), ("common bias", "")),
        Kind("half of the ranges long", _long_share(0.5), ("range noise", "common bias", "anchor's outliers")),
        Kind("70 % of the ranges long", _long_share(0.7), ("range noise", "common bias", "anchor's outliers")),
        Kind("noise of half a metre", _noisy, ("range noise",)),
    ]  # fmt: skip
    if ids:
        pair = ("range share", "anchors' scale")
        made += [
            Kind("ranges long by a share", _range_share, pair, ("range share", "")),
            Kind("anchors too small by a share", _anchor_share, pair, ("anchors' scale", "")),
            Kind("anchors in feet", _feet, ("anchors' unit", *pair)),
            Kind("x and y swapped", _axes(np.eye(3)[[1, 0, 2]]), ("anchors' axes",)),
            Kind("heights as depths", _axes(np.diag([1.0, 1, -1])), ("anchors' axes",)),
            Kind("x mirrored", _axes(np.diag([-1.0, 1, 1])), ("anchors' axes",)),
            Kind("heights never measured", _axes(np.diag([1.0, 1, 0])), ("anchor heights",)),
        ]
        for first, second in ((0, 1), (1, 2), (0, 2)):
            names = ", ".join(sorted((ids[first], ids[second]), key=sorted(ids).index))
            made.append(Kind(f"labels {names}", _swap(ids[first], ids[second]), (f"labels swapped {names}",)))
    return made


def _place(name: str, axis: int) -> Mistake:
    def make(given: Given, size: float, rng: np.random.Generator) -> None:
        given.anchors_m[name] = given.anchors_m[name] + rng.choice([-1, 1]) * size * np.eye(3)[axis]

    return make


def _bias(name: str, sign: int = 1) -> Mistake:
    def make(given: Given, size: float, rng: np.random.Generator) -> None:
        given.range_m = given.range_m + sign * size * given.is_of(name)

    return make


def _common(given: Given, size: float, rng: np.random.Generator) -> None:
    given.range_m = given.range_m + size


def _moved(name: str, share: float) -> Mistake:
    def make(given: Given, size: float, rng: np.random.Generator) -> None:
        direction = rng.normal(size=3) * [1, 1, 0.3]
        at = given.true_anchors_m[name]
        to = at + size * direction / np.linalg.norm(direction)
        after = given.is_of(name) & (given.time_s > np.quantile(given.time_s, share))
        grown = np.linalg.norm(given.tags_m - to, axis=1) - np.linalg.norm(given.tags_m - at, axis=1)
        given.range_m = given.range_m + np.where(after, grown, 0.0)

    return make


def _step(name: str | None, share: float) -> Mistake:
    def make(given: Given, size: float, rng: np.random.Generator) -> None:
        is_of = np.ones(len(given.time_s), dtype=bool) if name is None else given.is_of(name)
        given.range_m = given.range_m + size * (is_of & (given.time_s > np.quantile(given.time_s, share)))

    return make


def _stretch(name: str | None, share: float) -> Mistake:
    def make(given: Given, size: float, rng: np.random.Generator) -> None:
        is_of = np.ones(len(given.time_s), dtype=bool) if name is None else given.is_of(name)
        low, high = np.quantile(given.time_s, [share, share + 0.15])
        given.range_m = given.range_m + size * (is_of & (given.time_s > low) & (given.time_s < high))

    return make


def _stuck(name: str) -> Mistake:
    def make(given: Given, size: float, rng: np.random.Generator) -> None:
        given.range_m = np.where(given.is_of(name), np.median(given.range_m[given.is_of(name)]), given.range_m)

    return make


def _blocked(name: str) -> Mistake:
    def make(given: Given, size: float, rng: np.random.Generator) -> None:
        is_long = given.is_of(name) & (rng.random(len(given.time_s)) < 0.7)
        given.range_m = given.range_m + is_long * rng.exponential(1.5, len(given.time_s))

    return make


def _long_share(share: float) -> Mistake:
    def make(given: Given, size: float, rng: np.random.Generator) -> None:
        is_long = rng.random(len(given.time_s)) < share
        given.range_m = given.range_m + is_long * rng.exponential(1.0, len(given.time_s))

    return make


def _noisy(given: Given, size: float, rng: np.random.Generator) -> None:
    given.range_m = given.range_m + 0.5 * rng.standard_normal(len(given.time_s))


def _lever(axis: int) -> Mistake:
    def make(given: Given, size: float, rng: np.random.Generator) -> None:
        given.tag_in_cam_m = given.tag_in_cam_m + rng.choice([-1, 1]) * size * np.eye(3)[axis]

    return make


def _lever_forgotten(given: Given, size: float, rng: np.random.Generator) -> None:
    given.tag_in_cam_m = np.zeros(3)


def _lever_turned(axes: Array) -> Mistake:
    def make(given: Given, size: float, rng: np.random.Generator) -> None:
        given.tag_in_cam_m = axes @ given.tag_in_cam_m

    return make


def _clock(sign: int) -> Mistake:
    def make(given: Given, size: float, rng: np.random.Generator) -> None:
        given.time_offset_s = given.time_offset_s + sign * size

    return make


def _clock_drift(given: Given, size: float, rng: np.random.Generator) -> None:
    middle = given.time_s.mean()
    given.time_s = middle + (1 + size) * (given.time_s - middle)


def _clock_jump(given: Given, size: float, rng: np.random.Generator) -> None:
    given.time_s = given.time_s + size * (given.time_s > np.quantile(given.time_s, 0.5))


def _range_share(given: Given, size: float, rng: np.random.Generator) -> None:
    given.range_m = given.range_m * (1 + size)


def _anchor_share(given: Given, size: float, rng: np.random.Generator) -> None:
    given.anchors_m = {name: at * (1 - size) for name, at in given.anchors_m.items()}


def _feet(given: Given, size: float, rng: np.random.Generator) -> None:
    given.anchors_m = {name: at / 0.3048 for name, at in given.anchors_m.items()}


def _axes(axes: Array) -> Mistake:
    def make(given: Given, size: float, rng: np.random.Generator) -> None:
        given.anchors_m = {name: axes @ at for name, at in given.anchors_m.items()}

    return make


def _swap(first: str, second: str) -> Mistake:
    def make(given: Given, size: float, rng: np.random.Generator) -> None:
        anchors = given.anchors_m
        given.anchors_m = {**anchors, first: anchors[second], second: anchors[first]}

    return make


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--num_seeds", type=int, default=20)
    parser.add_argument("--num_clean", type=int, default=70, help="of each survey")
    parser.add_argument("--seed", type=int, default=0, help="of the first survey")
    parser.add_argument("--surveys", default="", help="only those whose name begins so")
    parser.add_argument("--kinds", default="", help="only those whose name has this in it")
    parser.add_argument("--quick", action="store_true", help="one seed of each kind, five clean surveys")
    parser.add_argument("--verbose", action="store_true", help="tell of each run that went wrong")
    args = parser.parse_args()
    if args.quick:
        args.num_seeds, args.num_clean = 1, 5
    total = Tally("all kinds")
    for site in SITES:
        if site.name.startswith(args.surveys):
            smallest = clean_runs(site, args)
            for kind in kinds(site):
                if args.kinds in kind.name:
                    total = total.plus(runs_of(site, kind, smallest, args))
    print(total)


def clean_runs(site: Site, args: argparse.Namespace) -> dict[tuple[str, str], float]:
    """The median smallest size of each test that is found."""
    sizes: dict[tuple[str, str], list[float]] = {}
    doubted = doubtful = wrong = refused = 0
    for seed in range(args.seed, args.seed + args.num_clean):
        done = run(surveyed(site, seed), seed)
        if done.trust is None or done.estimate is None:
            refused += 1
            continue
        doubted += bool(done.trust.reasons)
        doubtful += done.estimate.verdict != "good"
        wrong += done.is_wrong
        if args.verbose and done.trust.reasons:
            print(f"   clean {site.name} {seed}: {'; '.join(done.trust.reasons)}")
        for test in done.trust.tests:
            sizes.setdefault((test.name, test.subject), []).append(test.smallest_detectable or np.inf)
    print(
        f"{site.name}: {args.num_clean} clean: {doubted} doubted by the tests, {doubtful} for another reason, "
        f"{wrong} outside the interval, {refused} refused",
        flush=True,
    )
    return {key: float(np.median(values)) for key, values in sizes.items()}


@dataclass(frozen=True)
class Tally:
    """Counts of runs."""

    name: str
    num: int = 0
    refused: int = 0
    found: int = 0
    named: int = 0
    good: int = 0
    wrong_and_good: int = 0

    def plus(self, other: Tally) -> Tally:
        sums = {f.name: getattr(self, f.name) + getattr(other, f.name) for f in fields(self) if f.name != "name"}
        return replace(self, **sums)

    def __str__(self) -> str:
        return (
            f"{self.name:40}{self.num:5} runs, {self.refused:4} refused, {self.found:4} found, {self.named:4} named, "
            f"{self.good:4} good, {self.wrong_and_good:3} of these outside the interval"
        )


def runs_of(site: Site, kind: Kind, smallest: dict[tuple[str, str], float], args: argparse.Namespace) -> Tally:
    size = kind.size if kind.of is None else 2 * smallest.get(kind.of, np.inf)
    tally = Tally(f"{site.name}: {kind.name} ({size:.2g})")
    if not np.isfinite(size):
        print(f"{tally.name}: nothing can find it", flush=True)
        return tally
    for seed in range(args.seed, args.seed + args.num_seeds):
        given = surveyed(site, seed)
        kind.make(given, size, np.random.default_rng([seed, 7]))
        done = run(given, seed)
        if done.trust is None or done.estimate is None:
            tally = tally.plus(Tally("", num=1, refused=1))
            if args.verbose:
                print(f"   {tally.name} {seed}: refused: {done.refusal}")
            continue
        named = {f"{c.name} {c.subject}".strip() for c in done.trust.causes}
        named |= {f"{t.name} {t.subject}".strip() for t in done.trust.tests if t.rejected and not t.stddev}
        is_named = any(name == right or name.startswith(f"{right} ") for name in named for right in kind.right)
        is_good = not done.trust.reasons and done.estimate.verdict == "good"
        if args.verbose and not is_named:
            print(f"   {tally.name} {seed}: {'; '.join(done.trust.reasons) or 'nothing found'}")
        found = bool(done.trust.reasons)
        tally = tally.plus(Tally("", 1, 0, int(found), int(is_named), int(is_good), int(is_good and done.is_wrong)))
    print(tally, flush=True)
    return tally


if __name__ == "__main__":
    main()
