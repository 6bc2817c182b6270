"""Points of a map move with its parts as their derivatives say, and err as the whole bundle adjustment has it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pycolmap
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation
from tests.known import known
from tests.solver.test_covariance import (
    ANCHORS_M,
    BIAS_STDDEV_M,
    NUM_FRAMES,
    RANGE_STDDEV_M,
    covariance_of_all,
    joint,
    model,
    variable,
)

from rangesfm.errors import InputError
from rangesfm.measurements.lengths.tape import Marker
from rangesfm.measurements.points import NamedPoints
from rangesfm.pipeline.measure import measured
from rangesfm.util.geometry.map_errors import Part

Array = npt.NDArray[np.float64]
STEP = 1e-6


def rig_model() -> pycolmap.Reconstruction:
    """Return a model of a rig with two cameras, whose points both see."""
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_cameras_per_rig, options.num_frames_per_rig = 1, 2, 5
    options.num_points3D, options.sensor_from_rig_rotation_stddev = 30, 20.0
    pycolmap.set_random_seed(3)
    return pycolmap.synthesize_dataset(options)


def points_in(reconstruction: pycolmap.Reconstruction, markers: dict[str, Marker] | None = None) -> NamedPoints:
    return NamedPoints.in_model(reconstruction, markers or {}, {"A1": np.array([1.0, 2.0, 3.0])}, pixel_stddev=1.0)


def moved(reconstruction: pycolmap.Reconstruction, part: Part, number: int, step: float) -> pycolmap.Reconstruction:
    """Return a copy in which one number of one part is changed."""
    copy = pycolmap.Reconstruction(reconstruction)
    kind, id_ = part
    assert isinstance(id_, int)
    change = np.zeros(6)
    if kind == "camera":
        copy.camera(id_).params[number] += step
        return copy
    change[number] = step
    if kind == "frame":
        frame = copy.frame(id_)
        pose = frame.rig_from_world
        assert pose is not None
        world_from_rig = Rotation.from_rotvec(change[:3]).as_matrix() @ pose.rotation.matrix().T
        center = -pose.rotation.matrix().T @ pose.translation + change[3:]
        frame.rig_from_world = pycolmap.Rigid3d(pycolmap.Rotation3d(world_from_rig.T), -world_from_rig.T @ center)
        return copy
    (rig,) = copy.rigs.values()
    (sensor,) = (one for one in rig.non_ref_sensors if one.id == id_)
    pose = rig.non_ref_sensors[sensor]
    turned = Rotation.from_rotvec(change[:3]).as_matrix() @ pose.rotation.matrix()
    rig.set_sensor_from_rig(sensor, pycolmap.Rigid3d(pycolmap.Rotation3d(turned), pose.translation + change[3:]))
    return copy


def least_squares_place(reconstruction: pycolmap.Reconstruction, point_id: int) -> Array:
    """Return where the photos of a model have a point, by its smallest reprojection errors."""
    point = reconstruction.point3D(point_id)
    views = [(reconstruction.image(e.image_id), e.point2D_idx) for e in point.track.elements]

    def off_px(at: Array) -> Array:
        return np.concatenate([known(image.project_point(at)) - image.points2D[k].xy for image, k in views])

    return np.asarray(least_squares(off_px, point.xyz, xtol=1e-15, ftol=1e-15, gtol=1e-15).x)


def assert_moves_as_told(
    reconstruction: pycolmap.Reconstruction,
    by_part: dict[Part, Array],
    place: Callable[[pycolmap.Reconstruction], Array],
) -> None:
    for part, slopes in by_part.items():
        for number, slope in enumerate(slopes.T):
            ends = [place(moved(reconstruction, part, number, sign * STEP)) for sign in (1, -1)]
            expected = (ends[0] - ends[1]) / (2 * STEP)
            np.testing.assert_allclose(slope, expected, atol=1e-4 * max(1.0, np.abs(expected).max()), err_msg=str(part))


def test_a_photo_moves_with_its_rig_and_with_its_place_on_it() -> None:
    reconstruction = rig_model()
    for image in list(reconstruction.images.values())[:4]:
        errors = points_in(reconstruction).find(image.name)
        assert len(errors.by_part) == (1 if image.is_ref_in_frame() else 2)
        assert_moves_as_told(
            reconstruction,
            dict(errors.by_part),
            lambda other, id_=image.image_id: other.image(id_).projection_center(),  # type: ignore[misc]
        )


def test_a_point_moves_with_the_photos_that_show_it() -> None:
    reconstruction = rig_model()
    point_id = min(reconstruction.point3D_ids())
    errors = points_in(reconstruction).find(f"point:{point_id}")
    assert {kind for kind, _ in errors.by_part} == {"frame", "sensor", "camera"}
    assert_moves_as_told(reconstruction, dict(errors.by_part), lambda other: least_squares_place(other, point_id))


def marked(reconstruction: pycolmap.Reconstruction, point_id: int) -> Marker:
    """Return a marker with exact marks at a point of a model."""
    point = reconstruction.point3D(point_id)
    images = [reconstruction.image(element.image_id) for element in point.track.elements]
    pixels = np.array([known(image.project_point(point.xyz)) for image in images])
    return Marker(tuple(image.name for image in images), pixels, tuple(range(2, 2 + len(images))))


def test_a_marker_moves_with_the_photos_that_show_it() -> None:
    """However far its marks are off, as those that people click."""
    reconstruction = rig_model()
    exact = marked(reconstruction, min(reconstruction.point3D_ids()))
    clicked = exact.pixels + 3.0 * np.random.default_rng(1).standard_normal(exact.pixels.shape)
    markers = {"bolt": replace(exact, pixels=clicked)}
    errors = points_in(reconstruction, markers).find("bolt")
    assert_moves_as_told(
        reconstruction, dict(errors.by_part), lambda other: points_in(other, markers).find("bolt").position_m
    )


def test_a_marker_errs_by_its_marks_as_much_as_it_moves_with_them() -> None:
    """Many draws of marks with errors spread the marker as its own covariance says."""
    reconstruction, rng = rig_model(), np.random.default_rng(2)
    exact = marked(reconstruction, min(reconstruction.point3D_ids()))
    own_m2 = points_in(reconstruction, {"bolt": exact}).find("bolt").own_m2
    num = 500
    drawn = [exact.pixels + rng.standard_normal(exact.pixels.shape) for _ in range(num)]
    markers = {f"bolt {k}": Marker(exact.image_names, pixels, exact.lines) for k, pixels in enumerate(drawn)}
    points = points_in(reconstruction, markers)
    spread = np.cov(np.array([points.find(name).position_m for name in markers]).T)
    # The relative standard deviation of an empirical variance is the root of 2 / (num - 1).
    np.testing.assert_allclose(spread, own_m2, atol=3.2 * np.sqrt(2 / (num - 1)) * np.abs(own_m2).max())


def test_points_err_relative_to_each_other_as_in_the_inverse_of_all_normal_equations() -> None:
    survey = joint(model(), hold_first=True)
    found = survey.covariance()
    points, blocks = points_in(survey.reconstruction), variable(survey)
    whole = covariance_of_all(survey.problem, blocks)
    ids = list(survey.reconstruction.points3D)
    num_columns = [6 if len(block) == 7 else len(block) for block in blocks]
    starts = np.cumsum([0, *num_columns])[len(blocks) - len(ids) :]
    for first, second in ((0, 1), (2, 9)):
        apart = np.zeros((3, len(whole)))
        apart[:, starts[first] : starts[first] + 3] -= np.eye(3)
        apart[:, starts[second] : starts[second] + 3] += np.eye(3)
        expected = apart @ whole @ apart.T
        ends = [points.find(f"point:{ids[k]}") for k in (first, second)]
        relative = found.errors.relative(ends[0], ends[1], found.errors.scale_stddev)
        np.testing.assert_allclose(relative, expected, rtol=1e-4, atol=1e-5 * np.abs(expected).max())


def test_a_printed_tag_is_the_mean_of_its_corners() -> None:
    reconstruction = rig_model()
    ids = sorted(reconstruction.point3D_ids())
    corners = {f"tag7.{k}": marked(reconstruction, ids[k]) for k in range(4)}
    points = points_in(reconstruction, corners)
    tag, found = points.find("tag7"), [points.find(name) for name in corners]
    np.testing.assert_allclose(tag.position_m, np.mean([corner.position_m for corner in found], axis=0))
    np.testing.assert_allclose(tag.own_m2, sum(corner.own_m2 for corner in found) / 16)
    part = next(iter(found[0].by_part))
    expected = sum(corner.by_part.get(part, np.zeros((3, 6))) for corner in found) / 4
    np.testing.assert_allclose(tag.by_part[part], expected)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("camera000001_frame000001.pn", "is not in the map, expected a photo .*; near: camera000001_frame000001.png"),
        ("point:99999", "'point:99999' is not in the map, expected the id of one of its 3-D points"),
        ("point:x", "expected the id of one of its 3-D points"),
        ("tag7", "tag 'tag7' has 2 of 4 corners in the map: give one of them, such as tag7.0"),
        ("lonely", "marker 'lonely' is marked in 1 photos of the model"),
    ],
)
def test_what_is_no_point_of_the_map_is_refused_by_name(name: str, message: str) -> None:
    reconstruction = rig_model()
    whole = marked(reconstruction, min(reconstruction.point3D_ids()))
    lonely = Marker(whole.image_names[:1], whole.pixels[:1], (2,))
    points = points_in(reconstruction, {"tag7.0": whole, "tag7.1": whole, "lonely": lonely})
    with pytest.raises(InputError, match=message):
        points.find(name)


def test_distances_of_solved_surveys_are_in_their_intervals() -> None:
    """Monte Carlo: of the true distances between points, photos and anchors 95 % are in their 95 % intervals."""
    rng = np.random.default_rng(11)
    inside = []
    for seed in range(60):
        noise = RANGE_STDDEV_M * rng.standard_normal((len(ANCHORS_M), NUM_FRAMES))
        biases = BIAS_STDDEV_M * rng.standard_normal((len(ANCHORS_M), 1))
        survey = joint(model(seed), hold_first=True, range_errors_m=noise + biases)
        reconstruction = survey.reconstruction
        names = [f"point:{i}" for i in sorted(reconstruction.point3D_ids())[::8]]
        names += [image.name for image in reconstruction.images.values()]
        points = NamedPoints.in_model(reconstruction, {})
        true_m = {name: points.find(name).position_m.copy() for name in names}
        assert survey.adjuster.solve().is_solution_usable()
        found = survey.covariance(anchor_ids=[f"A{k}" for k in range(len(ANCHORS_M))])
        anchors_m = {f"A{k}": at for k, at in enumerate(survey.anchors)}
        true_m |= {f"A{k}": at for k, at in enumerate(ANCHORS_M)}
        points = NamedPoints.in_model(reconstruction, {}, anchors_m, pixel_stddev=1.0)
        pairs = [tuple(rng.choice([*true_m], 2, replace=False).tolist()) for _ in range(30)]
        for row in measured(points, pairs, found.errors, found.errors.scale_stddev, None):
            low, high = row.distance_interval_m
            inside.append(low <= np.linalg.norm(true_m[row.ends[0]] - true_m[row.ends[1]]) <= high)
    # The distances of one survey share the error of its scale, so only the surveys are independent of each other.
    shares = np.reshape(inside, (60, 30)).mean(axis=1)
    standard_error = shares.std(ddof=1) / np.sqrt(len(shares))
    assert standard_error < 0.02
    assert abs(shares.mean() - 0.95) <= 2.0 * standard_error
