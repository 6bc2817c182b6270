"""Check whether advice gains what it promises: in ten weak surveys it is followed, and both are simulated.

Run: python -m tests.studies.advice_followed [--out FILE] [--num_seeds 100] [--kinds NAME ...]

For each survey, three pieces of advice are followed: the first for the scale, the first for the scale that is no taped
distance, and the first for the place. Prints what each promises and what it achieves, as the stddev afterwards relative
to that before: predicted, and by the spread of simulated runs. Where nothing is known before (open), the stddevs
afterwards are compared. Left out are control points, as these surveys have no photos, and other kinds of measurement,
such as an inertial sensor, which ``planned_surveys`` does not simulate. FILE keeps the runs that are done.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
from tests.studies.kept_runs import seeds_parser, spread
from tests.studies.planned_surveys import ROOM, runs_of, straight, survey, up_and_down, walk

from rangesfm.planning.advice import Advice
from rangesfm.planning.planned import PlannedSurvey
from rangesfm.planning.survey_plan import SurveyPlan, plan_survey

CEILING = ((6.0, 6.0, 2.8), (-6.0, 6.0, 2.8), (6.0, -6.0, 2.8), (-6.0, -6.0, 2.8))
ONE_SIDE = ((9.0, -3.0, 2.5), (10.0, 0.5, 0.5), (9.0, 4.0, 1.5))
NEAR = ((4.5, 0.5, 1.5), (-4.6, 0.5, 1.8), (0.5, 3.8, 1.2), (0.3, -3.7, 2.0))

SURVEYS: dict[str, Callable[[], PlannedSurvey]] = {
    "coplanar anchors, flat path": lambda: survey(walk(height_amplitude_m=0.05), CEILING, "site", "usual", 3.0),
    "coplanar anchors": lambda: survey(walk(), CEILING, "site", "room", 3.0),
    "one known anchor": lambda: survey(walk(semi_axes_m=(2, 1.5)), ROOM[:1], "first_camera", "usual", 8.0),
    "one unknown anchor": lambda: survey(walk(), ROOM[4:5], "unknown", "slow", 10.0),
    "straight path": lambda: survey(straight(8.0), ((-2.0, 3.0, 2.5),), "first_camera", "room", 10.0),
    "short ranges": lambda: survey(walk(), NEAR, "site", "usual", 3.0),
    "anchors on one side": lambda: survey(up_and_down(), ONE_SIDE, "site", "usual", 4.0),
    "small loop": lambda: survey(walk(semi_axes_m=(1.2, 1.0)), ROOM[:5], "site", "drone", 3.0),
    "few ranges": lambda: survey(up_and_down(), ROOM[:4], "site", "trolley", 0.2),
    "two known anchors": lambda: survey(walk(semi_axes_m=(2, 2)), ROOM[:2], "first_camera", "fast", 6.0),
}


def first_of(plan: SurveyPlan) -> Iterator[tuple[str, Advice]]:
    """Yield the first pieces of advice, each with its purpose, "scale" or "place"."""
    for_scale, for_place = (
        [advice for advice in each if not (advice.planned.points or advice.planned.others)]
        for each in (plan.advice_for_scale, plan.advice_for_place)
    )
    yield from (("scale", advice) for advice in for_scale[:1] if advice.kind == "tape")
    yield from (("scale", advice) for advice in [advice for advice in for_scale if advice.kind != "tape"][:1])
    yield from (("place", advice) for advice in for_place[:1])


def main() -> None:
    asked = seeds_parser(__doc__, SURVEYS, 100).parse_args()
    print(f"{'survey':30}{'for':>6}{'promised':>20}{'followed':>20}{'ratio':>14}  advice")
    off = []
    for name in asked.kinds:
        plan = plan_survey(SURVEYS[name]())
        before = runs_of(asked, name, plan.expected.planned, num_whole=0)
        for what, advice in first_of(plan):
            after = runs_of(asked, f"{name}: {advice.words}", advice.planned, num_whole=0)
            if what == "scale":
                promised, was = advice.scale_stddev, plan.expected.uncertainty.empirical
            else:
                promised, was = advice.place_stddev_m, plan.expected.worst_keyframe_m
            (found, chance), (found_before, chance_before) = spread(after, what), spread(before, what)
            is_open = not np.isfinite(was)
            gains = (promised, found) if is_open else (promised / was, found / found_before)
            ratio = gains[0] / gains[1]
            by_chance = ratio * (chance if is_open else float(np.hypot(chance, chance_before)))
            off.append((abs(ratio - 1), by_chance))
            unit = ("{:14.3f} m" if what == "place" else "{:14.5f}") if is_open else "{:11.2f} of it"
            told = "".join(f"{unit.format(gain):>20}" for gain in gains)
            print(f"{name:30}{what:>6}{told}{ratio:7.2f} +-{by_chance:4.2f}  {advice.words}", flush=True)
    ratios, by_chance = np.array(off).T
    num_off, num_surely = sum(ratios > 0.25), sum(ratios > 0.25 + 2 * by_chance)
    print(
        f"{num_off} of {len(off)} off by more than 25 %, {num_surely} of them by two stddevs of chance more; ", end=""
    )
    print(f"{100 * np.median(ratios):.0f} % in the median")


if __name__ == "__main__":
    main()
