"""First questions of a client about a map: what was done, when, by whom, and in which coordinates it is."""

from __future__ import annotations

from datetime import datetime, timezone

import numpy as np

from rangesfm.report.content import Content
from rangesfm.report.text import count, duration, fixed
from rangesfm.util.files.clock_times import are_seconds_since_1970


def facts_of(content: Content) -> list[tuple[str, str]]:
    """Return the facts about a result that are known: the name and the text of each."""
    found = (
        ("What was done", _what(content)),
        ("When", _when(content)),
        ("By", content.by),
        ("Coordinates", _coordinates(content)),
        ("Computed", _computed(content)),
    )
    return [(name, text) for name, text in found if text]


def _what(content: Content) -> str:
    """Return a sentence about the photos, another about the ranges and lengths, and one about the adjustment."""
    summary, path = content.summary, content.final
    ranges, num_points = summary.ranges, count(summary.map.num_points3D)
    length_m = float(np.linalg.norm(np.diff(path.centers, axis=0), axis=1).sum())
    way = f" along {fixed(length_m, 1, 'm')}" if path else ""
    said = [f"{count(summary.map.num_photos)} photos{way} show {num_points} points."]
    if summary.has_ranges:
        said.append(f"{count(ranges.num_used)} of {count(ranges.num)} ranges to {_anchors(content)} give it metres.")
    said += filter(None, (entry.fact for entry in summary.of_kinds.values()))
    if summary.distances:
        said.append(f"Measured lengths that fix its scale or check it: {len(summary.distances)}.")
    if summary.refine is None or not summary.refine.kept:
        return " ".join((*said, "The map was scaled as a whole."))
    return " ".join((*said, "Photos and measurements were adjusted together."))


def _anchors(content: Content) -> str:
    """Return how many anchors there are, and whether their positions were given."""
    anchors = content.summary.anchors.values()
    num, num_given = len(anchors), sum(anchor.surveyed_position_m is not None for anchor in anchors)
    if num == 1:
        return "1 radio anchor at a known position" if num_given else "1 radio anchor at an unknown position"
    where = "unknown positions" if num_given == 0 else "known positions" if num_given == num else None
    return f"{num} radio anchors" + (f" at {where}" if where else f", {num_given} of them at known positions,")


def _when(content: Content) -> str:
    """Return date and times of the photos; empty where they have no times, or their clock does not tell the date."""
    times_s = [time for time in content.result.timestamps_s.values() if np.isfinite(time)]
    if not times_s or not all(map(are_seconds_since_1970, times_s)):
        return ""
    begin, end = (datetime.fromtimestamp(time, timezone.utc) for time in (min(times_s), max(times_s)))
    if begin.date() != end.date():
        return f"{_day(begin)} to {_day(end)}, by the photos' clock"
    return f"{_day(begin)}, {begin:%H:%M} to {end:%H:%M} by the photos' clock"


def _computed(content: Content) -> str:
    """Return when and how long the result was computed, and by which version."""
    summary = content.summary
    on = "" if summary.computed is None else f"{_day(datetime.fromisoformat(summary.computed))}, "
    known_s = [value for name, value in summary.seconds.items() if value is not None and name != "total"]
    took = f" in {duration(sum(known_s))} (all stages)" if known_s else ""
    return f"{on}rangesfm {summary.versions.get('rangesfm', '')}{took}"


def _coordinates(content: Content) -> str:
    summary = content.summary
    if summary.frame == "site":
        anchors, crs = summary.settings.anchors.path, summary.settings.anchors.crs
        whose = "the site" if anchors is None else f"the site, those of {anchors.rsplit('/', 1)[-1]}"
        return f"x, y, z in metres in the frame of {whose}{f' ({crs})' if crs else ''}; z is up."
    return f"x, y, z in metres in {frame_in_words(content)}. Nothing fixes the map's place in a site."


def frame_in_words(content: Content) -> str:
    """Return which frame the coordinates of a map have, and the directions of its axes."""
    if content.summary.frame == "site":
        return "the site's frame, with z up"
    first = f"the first photo, {content.final.image_names[0]}" if content.final else "the first photo"
    return f"the frame of {first} (x right, y down, z forward)"


def _day(date: datetime) -> str:
    return f"{date.day} {date:%B %Y}"
