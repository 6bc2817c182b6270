"""The components of the ranges' errors: how alike two bins err, and how large each component is over radios."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest

from rangesfm.ranging.errors.components import (
    BENDS,
    COMPONENTS,
    LOGS,
    Component,
    component_words,
    components,
    population,
    stddevs_in,
)
from rangesfm.ranging.errors.range_bins import RangeBins

Array = npt.NDArray[np.float64]

X, Y, Z = np.eye(3)


def by_name(name: str) -> Component:
    (found,) = (component for component in COMPONENTS if component.name == name)
    return found


def at(angle_deg: float) -> Array:
    """Unit vector in the plane of x and y."""
    return np.array([np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg)), 0.0])


def bins_of(
    distance_m: list[float],
    from_anchor: list[Array],
    in_cam: list[Array],
    *,
    anchor: list[int],
    tag: list[int],
    time_s: list[float],
    worth: list[float],
) -> RangeBins:
    num = len(distance_m)
    return RangeBins(
        of_range=np.arange(num),
        robust_weight=np.array(worth),
        worth=np.array(worth),
        anchor_index=np.array(anchor),
        tag_index=np.array(tag),
        time_s=np.array(time_s),
        distance_m=np.array(distance_m),
        from_anchor=np.array(from_anchor),
        in_cam=np.array(in_cam),
        noisiness=np.ones(num),
    )


# Two bins of one anchor and tag, one of another anchor, and one of another tag.
FOUR = bins_of(
    [1.0, 2.0, 2.0, 0.01],
    [X, Y, X, -X],
    [Z, at(30.0), Z, at(30.0)],
    anchor=[0, 0, 1, 0],
    tag=[0, 0, 0, 1],
    time_s=[0.0, 3.0, 3.0, 60.0],
    worth=[1.0, 4.0, 0.25, 1e-8],
)


def upper(name: str) -> list[float]:
    """Return the covariances of the first bin with itself and the three others, and of the second with the last."""
    found = by_name(name).correlation(FOUR)
    np.testing.assert_allclose(found, found.T)
    return [*found[0], found[1, 3]]


def test_noise_of_single_ranges_is_averaged_in_a_bin() -> None:
    np.testing.assert_allclose(by_name("white").correlation(FOUR), np.diag([1.0, 0.25, 4.0, 1e8]))


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("time", [1, np.exp(-1), 0, 0, 0]),
        ("drift", [1, np.exp(-3 / 60), np.exp(-3 / 60), 0, 0]),
        ("bias", [1, 1, 0, 1, 1]),
        ("tag_bias", [1, 1, 1, 0, 0]),
        ("common_bias", [1, 1, 1, 1, 1]),
    ],
)
def test_errors_last_for_a_time_and_belong_to_an_anchor_or_a_tag(name: str, expected: list[float]) -> None:
    np.testing.assert_allclose(upper(name), expected)


def test_echoes_belong_to_a_place_and_a_link() -> None:
    """The tag's places are 1 m along x and 2 m along y from the anchor."""
    np.testing.assert_allclose(upper("place"), [1, np.exp(-np.sqrt(5) / 0.5), 0, 0, 0])


def test_lobes_of_the_antenna_are_alike_in_similar_directions_of_one_link() -> None:
    np.testing.assert_allclose(upper("view"), [1, np.exp(-1 / 0.1), 0, 0, 0])
    turned = bins_of([1.0, 1.0], [X, X], [X, at(60.0)], anchor=[0, 0], tag=[0, 0], time_s=[0.0, 9.0], worth=[1.0, 1.0])
    assert by_name("view").correlation(turned)[0, 1] == pytest.approx(np.exp(-0.5 / 0.1))


def test_errors_by_distance_are_alike_at_similar_distances_whatever_the_anchor() -> None:
    np.testing.assert_allclose(upper("short"), np.exp([-2, -3, -3, -1.01, -2.01]))
    np.testing.assert_allclose(upper("slope"), [1, 2, 2, 0.01, 0.02])
    # Distances below 5 cm count as 5 cm, as the logarithm has no end.
    ratios = np.log([1.0, 2.0, 2.0, 20.0, 40.0])
    np.testing.assert_allclose(upper("curve"), np.exp(-0.5 * ratios**2))


def test_the_delay_of_an_antenna_is_a_polynomial_of_the_direction() -> None:
    """Opposite directions have opposite linear parts and like quadratic parts, of half the variance each."""
    np.testing.assert_allclose(upper("antenna"), [1, -1 / 4, 0, 0, -1 / 4], atol=1e-12)
    np.testing.assert_allclose(upper("tag_antenna"), [1, -1 / 4, 1, 0, 0], atol=1e-12)
    angles = np.radians([0.0, 60.0])
    cosine = np.cos(angles)[1]
    pair = bins_of(
        [1.0, 1.0], [X, at(60.0)], [X, at(60.0)], anchor=[0, 0], tag=[0, 0], time_s=[0.0, 9.0], worth=[1.0, 1.0]
    )
    expected = cosine / 2 + (1.5 * cosine**2 - 0.5) / 2
    assert by_name("antenna").correlation(pair)[0, 1] == pytest.approx(expected)
    assert by_name("tag_antenna").correlation(pair)[0, 1] == pytest.approx(expected)


def test_anchors_err_alike_at_like_angles_from_where_each_faces() -> None:
    """One anchor faces along x, 30 degrees from both of its bins; the other faces along y, 70 degrees from both."""
    bins = bins_of(
        [1.0] * 4,
        [at(30.0), at(-30.0), at(20.0), at(160.0)],
        [X] * 4,
        anchor=[0, 0, 1, 1],
        tag=[0] * 4,
        time_s=[0.0] * 4,
        worth=[1.0] * 4,
    )
    between = np.exp(-0.5 * np.radians(40.0) ** 2)
    ones = np.ones((2, 2))
    expected = np.block([[ones, between * ones], [between * ones, ones]])
    np.testing.assert_allclose(by_name("off_axis").correlation(bins), expected)


def test_an_anchor_that_is_heard_from_all_sides_faces_nowhere() -> None:
    bins = bins_of([1.0] * 2, [X, -X], [X] * 2, anchor=[0, 0], tag=[0] * 2, time_s=[0.0] * 2, worth=[1.0] * 2)
    np.testing.assert_allclose(by_name("off_axis").correlation(bins), np.ones((2, 2)))


def test_errors_of_each_anchor_are_larger_where_it_is_noisy_and_a_calibration_leaves_less_of_a_curve() -> None:
    of_anchor = {component.name for component in COMPONENTS if component.is_of_anchor}
    assert of_anchor == {"white", "time", "place", "view", "bias", "antenna"}
    calibrated = {c.name: c.calibrated_median / c.median for c in COMPONENTS if c.calibrated_median is not None}
    assert set(calibrated) == {"common_bias", "short", "curve", "slope"}
    assert all(0.1 < share < 1.0 for share in calibrated.values())


def test_components_have_the_median_and_the_spread_that_are_given() -> None:
    given = {name: (0.01 * k, 0.5 + k) for k, name in enumerate(population())}
    assert {c.name: (c.median, c.spread) for c in components(given)} == given


def test_the_sizes_in_a_log_are_those_of_its_column() -> None:
    assert len(LOGS) == 8
    assert (LOGS[0], LOGS[5], LOGS[-1]) == ("room_env1", "lias_mid", "starloc_fast_s1")
    last, first = stddevs_in("starloc_fast_s1"), stddevs_in("room_env1")
    assert (last["white"], last["tag_bias"], last["tag_antenna"]) == (0.094, 0.037, 0.021)
    assert (first["white"], first["slope"], first["tag_antenna"]) == (0.057, 0.0049, 0.033)
    assert set(last) - set(first) == {"tag_bias"}


def over(logs: list[str], name: str) -> tuple[float, float]:
    """Return the median and the spread of a component over logs, the spread half or more."""
    sizes = [stddevs_in(log)[name] for log in logs if name in stddevs_in(log)]
    mean = np.prod(sizes) ** (1 / len(sizes))
    spread = np.sqrt(sum(np.log(size / mean) ** 2 for size in sizes) / (len(sizes) - 1)) if len(sizes) > 1 else 0.0
    return float(mean), max(float(spread), 0.5)


def test_the_population_has_the_median_and_the_spread_of_all_logs() -> None:
    found = population()
    assert set(found) == {component.name for component in COMPONENTS}
    for name, expected in found.items():
        assert expected == pytest.approx(over([*LOGS], name))
    assert found["white"][1] > 0.6, "spread of the noise from the logs"
    assert found["slope"][1] == 0.5, "least spread"


@pytest.mark.parametrize(
    ("without", "of_its_radio"),
    [
        ("room_env1", ("room_env1", "room_calibration")),
        ("rcv_sequence3", ("rcv_sequence1", "rcv_sequence3")),
        ("lias_mid", ("lias_mid",)),
        ("starloc_fast_s1", ("starloc_fast_s1",)),
    ],
)
def test_a_log_is_left_out_with_all_of_its_radio(without: str, of_its_radio: tuple[str, ...]) -> None:
    kept = [log for log in LOGS if log not in of_its_radio]
    for name, expected in population(without).items():
        assert expected == pytest.approx(over(kept, name))


def test_components_have_words_for_people() -> None:
    names = [*(c.name for c in COMPONENTS), *BENDS, "learnt_curve", "given", "reweighting", "clocks", "places", "tape"]
    words = component_words(names)
    assert [*words] == names
    assert len(set(words.values())) == len(names)
    assert words["bias"] == by_name("bias").words == "constant range error of each anchor"
    assert words["bending"] == "bending of the map"


def test_errors_of_positions_have_their_time_in_words() -> None:
    assert component_words(["positions", "positions_2.5s"]) == {
        "positions": "noise of the known positions",
        "positions_2.5s": "errors of the known positions that last for 2.5 s",
    }
    with pytest.raises(KeyError):
        component_words(["positions_2.5"])
