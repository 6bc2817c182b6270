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
from tests.studies.erring_surveys import SITES, X_FORWARD, Array, Given, Site, run, surveyed

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
