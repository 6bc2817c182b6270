"""Maps that drift by metres around a field lose their drift without a radio, and say how well they do."""

from __future__ import annotations

import pytest
from tests.studies.drifting_maps import told


@pytest.mark.parametrize(
    ("kind", "seed", "most_m"),
    [
        ("positions", 3, 0.05),  # two a second with 0.02 m of noise
        ("positions", 7, 0.2),  # the same with 0.1 m; half of the lap fits the other half better than its own place
        ("points", 3, 0.8),  # six of them, one far from the others on the map as it was
        ("lengths", 10, 3.5),  # eight of them, whose scales differ by 20 %, and which tell no turn of the path
    ],
)
def test_drift_is_removed_to_what_the_covariance_says(kind: str, seed: int, most_m: float) -> None:
    found = told(kind, seed)
    assert found["drift_m"] > 3
    assert found["refused"] == ""
    assert found["kept"]
    assert found["final_m"] < most_m
    assert found["places"] < 1.5
    assert found["places_covered"] >= 0.9
    assert found["covered"]
    assert found["verdict"] == "good"
