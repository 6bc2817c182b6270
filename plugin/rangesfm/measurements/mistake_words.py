"""Names of the mistakes that are tested for, as ``result.json`` has them, in words for people."""

from __future__ import annotations

CHECKED_KINDS = (
    "anchor place",
    "anchor bias",
    "lever arm",
    "length",
    "lengths against ranges",
    "lengths against positions",
)
"""Mistakes in what was given: coordinates and ranges of each anchor, lever arm of each tag, measured lengths."""
# Short names for people of kinds whose name in result.json does not say what they are. "{}" is the subject.
_KINDS = {
    "anchor place": "position of anchor {}",
    "anchor coordinate": "coordinate of anchor {}",
    "anchor bias": "constant error of anchor {}",
    "common bias": "constant error of all ranges",
    "range scale": "scale error of all ranges",
    "anchor range scale": "scale error of anchor {}",
    "anchors' scale": "scale of the anchors' coordinates",
    "anchor heights": "heights of the anchors",
    "radio drift": "slow drift of all ranges",
    "behind the camera": "ranges from behind the camera",
    "clock offset": "time offset of the clocks",
    "clock drift": "drift between the clocks",
    "clock jump": "jump between the clocks",
    "anchor moved": "anchor {} moved",
    "map break": "break in the map",
    "tag slipped": "tag slipped on the camera",
    "anchor step": "jump of the ranges to {}",
    "step": "jump of all ranges",
    "anchor stretch": "temporary error of anchor {}",
    "stretch": "temporary error of all ranges",
    "range noise": "scatter of single ranges",
    "lasting errors": "errors lasting for seconds",
    "anchor hardly used": "few ranges to {} fit",
    "anchor's outliers": "outliers of anchor {}",
    "anchor mixed up": "ranges to {} are of another",
    "labels swapped": "swapped labels {}",
    "lines shifted": "shifted lines of anchors",
    "anchors' axes": "axes of the anchors",
    "anchors' unit": "unit of anchors or ranges",
    "lever arm's axes": "axes of the lever arm",
    "photos reversed": "order of the photos",
}


def mistake_in_words(name: str, subject: str) -> str:
    """Return a short name of a mistake for people, given its kind and its subject, which may be empty."""
    return _KINDS.get(name, f"{name} {{}}").format(subject).strip()
