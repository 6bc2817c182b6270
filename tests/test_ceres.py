"""The compiled cost functions through Ceres as pycolmap and pyceres carry it."""

from __future__ import annotations

import importlib.metadata
import itertools
import re
import subprocess
import sys
import textwrap
from collections.abc import Callable, Iterator

import numpy as np
import numpy.typing as npt
import pyceres
import pycolmap
import pytest
from scipy.spatial.transform import Rotation

from rangesfm import _ceres, _cpp
from rangesfm._ceres import (
    CostFunction,
    add_residual_block,
    cauchy_loss,
    check_compatibility,
    fixed_pose_range_cost,
    interpolated_range_cost,
    normal_prior_cost,
    range_cost,
    zero_tie_cost,
)
from rangesfm.errors import SolverError

Array = npt.NDArray[np.float64]

TAG_IN_CAM_M = np.array([-0.0012, -0.0900, -0.0663])


@pytest.fixture
def reconstruction() -> pycolmap.Reconstruction:
    pycolmap.set_random_seed(0)
    options = pycolmap.SyntheticDatasetOptions(
        num_rigs=1, num_cameras_per_rig=1, num_frames_per_rig=6, num_points3D=60, track_length=4
    )
    return pycolmap.synthesize_dataset(options)


def adjuster_of(
    reconstruction: pycolmap.Reconstruction, constant_frame_id: int | None = None, num_threads: int = 1
) -> pycolmap.CeresBundleAdjuster:
    options = pycolmap.BundleAdjustmentOptions(
        print_summary=False, refine_focal_length=False, refine_extra_params=False
    )
    options.ceres.auto_select_solver_type = False
    options.ceres.solver_options.num_threads = num_threads
    options.ceres.min_num_residuals_for_cpu_multi_threading = 0
    config = pycolmap.BundleAdjustmentConfig()
    for image_id in reconstruction.reg_image_ids():
        config.add_image(image_id)
    if constant_frame_id is not None:
        config.set_constant_rig_from_world_pose(constant_frame_id)
    return pycolmap.create_default_ceres_bundle_adjuster(options, config, reconstruction)


def pose_block(reconstruction: pycolmap.Reconstruction, frame_id: int) -> Array:
    rig_from_world = reconstruction.frame(frame_id).rig_from_world
    assert rig_from_world is not None
    params: Array = rig_from_world.params
    return params


def cost_of(problem: pyceres.Problem) -> float:
    return 0.5 * float(np.sum(np.square(problem.evaluate_residuals())))


def random_pose(rng: np.random.Generator, extent: float) -> Array:
    rotation = Rotation.random(random_state=rng.integers(2**31))
    return np.concatenate([rotation.as_quat(), rng.normal(0.0, extent, 3)])


def moved(block: Array, step: Array) -> Array:
    """A block after a step in its tangent space; of a pose as COLMAP's manifold has it (Eigen's quaternions).

    Ceres turns by twice the step's length, from the left.
    """
    if block.size != 7:
        return block + step
    rotation = Rotation.from_rotvec(2.0 * step[:3]) * Rotation.from_quat(block[:4])
    return np.concatenate([rotation.as_quat(), block[4:] + step[3:]])


def tangent_jacobian(function: Callable[[Array], Array], block: Array, step_size: float) -> Array:
    """Central differences of a function of a block, in the block's tangent space."""
    num_columns = 6 if block.size == 7 else block.size
    steps = step_size * np.eye(num_columns)
    return np.stack(
        [(function(moved(block, step)) - function(moved(block, -step))) / (2 * step_size) for step in steps], axis=1
    )


def tangent_basis(block: Array) -> Array:
    """(block.size, tangent size): how a block moves with a step in its tangent space, at no step."""
    if block.size != 7:
        return np.eye(block.size)
    x, y, z, w = block[:4]
    basis = np.zeros((7, 6))
    basis[:4, :3] = [[w, z, -y], [-z, w, x], [y, -x, w], [-x, -y, -z]]
    basis[4:, 3:] = np.eye(3)
    return basis


COSTS: dict[str, Callable[[np.random.Generator], tuple[CostFunction, list[Array]]]] = {
    "range": lambda rng: (
        range_cost(range_m=rng.uniform(1, 10), tag_in_cam_m=TAG_IN_CAM_M, stddev_m=rng.uniform(0.05, 0.5)),
        [random_pose(rng, 5.0), rng.normal(0, 5, 3), rng.normal(0, 1, 1)],
    ),
    "fixed_pose": lambda rng: (
        fixed_pose_range_cost(range_m=rng.uniform(1, 10), tag_in_world_m=rng.normal(0, 5, 3), stddev_m=0.1),
        [rng.normal(0, 5, 3), rng.normal(0, 1, 1)],
    ),
    "interpolated": lambda rng: (
        interpolated_range_cost(
            range_m=rng.uniform(1, 10),
            tag_in_cam_m=TAG_IN_CAM_M,
            weight=rng.uniform(),
            offset_in_world_m=rng.normal(0, 0.1, 3),
            stddev_m=0.1,
        ),
        [random_pose(rng, 5.0), random_pose(rng, 5.0), rng.normal(0, 5, 3), rng.normal(0, 1, 1)],
    ),
    "normal_prior": lambda rng: (
        normal_prior_cost(mean=rng.normal(0, 1, 3), stddev=rng.uniform(0.1, 1.0, 3)),
        [rng.normal(0, 1, 3)],
    ),
    "zero_tie": lambda rng: (zero_tie_cost(size_a=3, size_b=1), [rng.normal(0, 1, 3), rng.normal(0, 1, 1)]),
}


@pytest.mark.parametrize("name", COSTS)
def test_jacobians_are_the_finite_differences_of_the_residuals(name: str) -> None:
    rng = np.random.default_rng(0)
    for _ in range(20):
        cost, blocks = COSTS[name](rng)
        jacobians = cost.evaluate(*blocks)[1]
        for i, block in enumerate(blocks):

            def residuals(moved_block: Array, i: int = i) -> Array:
                return cost.evaluate(*blocks[:i], moved_block, *blocks[i + 1 :])[0].ravel()  # noqa: B023

            expected = tangent_jacobian(residuals, block, step_size=1e-6)
            assert jacobians[i] @ tangent_basis(block) == pytest.approx(expected, rel=1e-6, abs=1e-6)


def test_jacobian_in_pycolmaps_problem_is_the_finite_difference_on_its_manifold(
    reconstruction: pycolmap.Reconstruction,
) -> None:
    adjuster = adjuster_of(reconstruction)
    anchor_in_world, range_bias = np.array([3.0, -2.0, 1.0]), np.array([0.1])
    pose = pose_block(reconstruction, 1)
    cost = range_cost(range_m=4.0, tag_in_cam_m=TAG_IN_CAM_M, stddev_m=0.1)
    add_residual_block(adjuster, cost, None, [pose, anchor_in_world, range_bias])
    options = pyceres.EvaluateOptions()
    options.set_parameter_blocks([pose, anchor_in_world, range_bias])
    jacobian = adjuster.problem.evaluate_jacobian(options)

    row = np.zeros(jacobian.num_cols)
    first, last = jacobian.rows[-2:]  # the range was added last
    row[jacobian.cols[first:last]] = jacobian.values[first:last]

    def residual(moved_pose: Array) -> Array:
        return cost.evaluate(moved_pose, anchor_in_world, range_bias)[0].ravel()

    expected = tangent_jacobian(residual, pose.copy(), step_size=1e-6)
    assert row[:6] == pytest.approx(expected.ravel(), rel=1e-6, abs=1e-6)
    assert len(row) == 6 + 3 + 1


def test_residual_is_the_hand_computed_one() -> None:
    # The camera at (1, 2.5, 0), turned by 90 degrees about z, the tag half a metre along its x axis: at (1, 2, 0),
    # 5 m from the anchor. Read 0.25 m too long, that is 2.5 stddevs of 0.1 m more than the 5 m measured.
    cost = range_cost(range_m=5.0, tag_in_cam_m=[0.5, 0.0, 0.0], stddev_m=0.1)
    pose = np.array([0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5), 2.5, -1.0, 0.0])
    residuals, _ = cost.evaluate(pose, np.array([4.0, 6.0, 0.0]), np.array([0.25]))
    assert residuals.item() == pytest.approx(2.5, abs=1e-12)


def test_pose_block_is_colmaps_own(reconstruction: pycolmap.Reconstruction) -> None:
    rig_from_world = reconstruction.frame(1).rig_from_world
    assert rig_from_world is not None
    tag_in_world = rig_from_world.inverse() * TAG_IN_CAM_M
    anchor_in_world = np.array([3.0, -2.0, 1.0])
    expected = np.linalg.norm(tag_in_world - anchor_in_world) - 4.0
    cost = range_cost(range_m=4.0, tag_in_cam_m=TAG_IN_CAM_M, stddev_m=1.0)
    residuals, _ = cost.evaluate(rig_from_world.params, anchor_in_world, np.zeros(1))
    assert residuals.item() == pytest.approx(expected, abs=1e-12)


def test_tag_on_the_anchor_gives_finite_numbers() -> None:
    cost = range_cost(range_m=0.5, tag_in_cam_m=[0, 0, 0], stddev_m=0.1)
    residuals, jacobians = cost.evaluate(np.array([0, 0, 0, 1.0, 0, 0, 0]), np.zeros(3), np.zeros(1))
    assert residuals.item() == pytest.approx(-5.0)
    assert all(np.all(np.isfinite(jacobian)) for jacobian in jacobians)


GOOD_RANGE = {"range_m": 4.0, "tag_in_cam_m": [0.0, 0.0, 0.0], "stddev_m": 0.1}
GOOD_BETWEEN = {**GOOD_RANGE, "weight": 0.5, "offset_in_world_m": [0.0, 0.0, 0.0]}


@pytest.mark.parametrize(
    ("bad", "message"),
    [
        ({"range_m": 0.0}, "range_m"),
        ({"range_m": -1.0}, "range_m"),
        ({"range_m": float("nan")}, "range_m"),
        ({"range_m": float("inf")}, "range_m"),
        ({"stddev_m": 0.0}, "stddev_m"),
        ({"stddev_m": -0.1}, "stddev_m"),
        ({"stddev_m": float("nan")}, "stddev_m"),
        ({"tag_in_cam_m": [0.0, 0.0]}, "3 numbers"),
        ({"tag_in_cam_m": [[0.0, 0.0, 0.0]]}, "one dimension"),
        ({"tag_in_cam_m": 0.0}, "one dimension"),
        ({"tag_in_cam_m": [0.0, float("nan"), 0.0]}, "finite"),
        ({"weight": -0.01}, "from 0 to 1"),
        ({"weight": 1.01}, "from 0 to 1"),
        ({"weight": float("nan")}, "finite"),
        ({"offset_in_world_m": [float("inf"), 0.0, 0.0]}, "finite"),
    ],
)
def test_values_that_mean_nothing_are_refused(bad: dict[str, float | list[float]], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        interpolated_range_cost(**{**GOOD_BETWEEN, **bad})  # type: ignore[arg-type]
    if bad.keys() <= GOOD_RANGE.keys():
        with pytest.raises(ValueError, match=message):
            range_cost(**{**GOOD_RANGE, **bad})  # type: ignore[arg-type]


def test_priors_and_ties_of_impossible_shape_are_refused() -> None:
    with pytest.raises(ValueError, match="as many"):
        normal_prior_cost(mean=[1.0, 2.0], stddev=[1.0])
    with pytest.raises(ValueError, match="one number or more"):
        normal_prior_cost(mean=[], stddev=[])
    with pytest.raises(ValueError, match="more than 0"):
        normal_prior_cost(mean=[1.0, 2.0], stddev=[1.0, 0.0])
    with pytest.raises(ValueError, match="size_b"):
        zero_tie_cost(size_a=3, size_b=0)
    with pytest.raises(ValueError, match="loss scale"):
        cauchy_loss(0.0)


@pytest.mark.parametrize(
    "anchor_in_world",
    [np.zeros(3, dtype=np.float32), np.zeros((3, 3))[:, 0], np.broadcast_to(0.0, 3), np.zeros(2)],
    ids=["float32", "a column", "read-only", "too short"],
)
def test_blocks_that_the_solver_cannot_work_on_in_place_are_refused(
    reconstruction: pycolmap.Reconstruction, anchor_in_world: Array
) -> None:
    adjuster = adjuster_of(reconstruction)
    num_residuals = adjuster.problem.num_residuals()
    cost = range_cost(range_m=4.0, tag_in_cam_m=TAG_IN_CAM_M, stddev_m=0.1)
    with pytest.raises(ValueError, match=r"in place|num_dims"):
        add_residual_block(adjuster, cost, None, [pose_block(reconstruction, 1), anchor_in_world, np.zeros(1)])
    assert adjuster.problem.num_residuals() == num_residuals


def test_a_range_adds_half_its_squared_residual_to_the_bundle_adjustments_cost(
    reconstruction: pycolmap.Reconstruction,
) -> None:
    adjuster = adjuster_of(reconstruction)
    before = cost_of(adjuster.problem)
    blocks = [pose_block(reconstruction, 1), np.array([3.0, -2.0, 1.0]), np.zeros(1)]
    cost = range_cost(range_m=4.0, tag_in_cam_m=TAG_IN_CAM_M, stddev_m=0.1)
    expected = 0.5 * cost.evaluate(*blocks)[0].item() ** 2
    add_residual_block(adjuster, cost, None, blocks)
    assert cost_of(adjuster.problem) - before == pytest.approx(expected)


def test_a_cauchy_loss_tames_an_outlier_in_pycolmaps_solver(reconstruction: pycolmap.Reconstruction) -> None:
    adjuster = adjuster_of(reconstruction)
    blocks = [pose_block(reconstruction, 1), np.array([3.0, -2.0, 1.0]), np.zeros(1)]
    cost = range_cost(range_m=100.0, tag_in_cam_m=TAG_IN_CAM_M, stddev_m=0.1)
    squared = cost.evaluate(*blocks)[0].item() ** 2
    add_residual_block(adjuster, cost, cauchy_loss(2.0), blocks)
    summary = adjuster.solve()
    assert isinstance(summary, pycolmap.CeresBundleAdjustmentSummary)
    expected = 0.5 * 2.0**2 * np.log1p(squared / 2.0**2)
    assert summary.ceres_summary.initial_cost == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize("num_threads", [1, 2])
def test_ranges_pull_an_unscaled_model_to_its_scale(reconstruction: pycolmap.Reconstruction, num_threads: int) -> None:
    rng = np.random.default_rng(0)
    anchors = rng.uniform(-8.0, 8.0, (4, 3))
    truth = {
        i: np.array(reconstruction.frame(i).rig_from_world.inverse().translation)  # type: ignore[union-attr]
        for i in reconstruction.reg_frame_ids()
    }
    reconstruction.transform(pycolmap.Sim3d(1.05, pycolmap.Rotation3d(), np.zeros(3)))
    adjuster = adjuster_of(reconstruction, num_threads=num_threads)
    for (frame_id, center), anchor in itertools.product(truth.items(), anchors):
        distance = float(np.linalg.norm(center - anchor))
        cost = range_cost(range_m=distance, tag_in_cam_m=[0, 0, 0], stddev_m=0.01)
        bias = np.zeros(1)
        add_residual_block(adjuster, cost, None, [pose_block(reconstruction, frame_id), anchor, bias])
        adjuster.problem.set_parameter_block_constant(anchor)
        adjuster.problem.set_parameter_block_constant(bias)
    assert adjuster.solve().is_solution_usable()
    for frame_id, center in truth.items():
        rig_from_world = reconstruction.frame(frame_id).rig_from_world
        assert rig_from_world is not None
        assert rig_from_world.inverse().translation == pytest.approx(center, abs=1e-5)


def test_a_pose_that_the_adjuster_holds_stays_where_it_is(reconstruction: pycolmap.Reconstruction) -> None:
    pose = pose_block(reconstruction, 1)
    before = pose.copy()
    adjuster = adjuster_of(reconstruction, constant_frame_id=1)
    cost = range_cost(range_m=4.0, tag_in_cam_m=TAG_IN_CAM_M, stddev_m=0.01)
    add_residual_block(adjuster, cost, None, [pose, np.array([3.0, -2.0, 1.0]), np.zeros(1)])
    adjuster.solve()
    np.testing.assert_array_equal(pose, before)


@pytest.mark.parametrize("hold", [True, False])
def test_a_pose_that_the_adjuster_holds_is_no_part_of_its_problem_until_a_range_makes_it_one(
    reconstruction: pycolmap.Reconstruction, hold: bool
) -> None:
    """What ``add_residual_block`` is there for, shown on the bare problem; it tells if pycolmap mends it."""
    pose = pose_block(reconstruction, 1)
    before = pose.copy()
    adjuster = adjuster_of(reconstruction, constant_frame_id=1)
    problem = adjuster.problem
    assert not problem.has_parameter_block(pose)
    cost = range_cost(range_m=4.0, tag_in_cam_m=TAG_IN_CAM_M, stddev_m=0.01)
    problem.add_residual_block(cost, None, [pose, np.array([3.0, -2.0, 1.0]), np.zeros(1)])
    assert not problem.is_parameter_block_constant(pose)
    assert not problem.has_manifold(pose)
    if hold:
        problem.set_parameter_block_constant(pose)
    adjuster.solve()
    assert np.array_equal(pose, before) == hold


@pytest.mark.parametrize(
    ("tied", "structure"), [(True, "2,3,d"), (False, "d,d,d")], ids=["tied to a point", "not tied"]
)
def test_a_free_anchor_and_bias_keep_out_of_the_eliminated_points_where_tied(
    reconstruction: pycolmap.Reconstruction, tied: bool, structure: str
) -> None:
    adjuster = adjuster_of(reconstruction)
    anchor, bias = np.array([3.0, -2.0, 1.0]), np.zeros(1)
    for frame_id in reconstruction.reg_frame_ids():
        cost = range_cost(range_m=4.0, tag_in_cam_m=TAG_IN_CAM_M, stddev_m=0.1)
        add_residual_block(adjuster, cost, None, [pose_block(reconstruction, frame_id), anchor, bias])
    if tied:
        point = next(iter(reconstruction.points3D.values())).xyz
        add_residual_block(adjuster, zero_tie_cost(size_a=3, size_b=3), None, [anchor, point])
        add_residual_block(adjuster, zero_tie_cost(size_a=1, size_b=3), None, [bias, point])
    adjuster.options.ceres.solver_options.linear_solver_type = pyceres.LinearSolverType.SPARSE_SCHUR
    summary = adjuster.solve()
    assert isinstance(summary, pycolmap.CeresBundleAdjustmentSummary)
    assert summary.ceres_summary.schur_structure_used == structure


LIFETIMES = """
    {imports}
    import gc, itertools
    import numpy as np
    from rangesfm import _ceres

    def make():
        reconstruction = pycolmap.synthesize_dataset(
            pycolmap.SyntheticDatasetOptions(
                num_rigs=1, num_cameras_per_rig=1, num_frames_per_rig=3, num_points3D=30
            )
        )
        config = pycolmap.BundleAdjustmentConfig()
        for image_id in reconstruction.reg_image_ids():
            config.add_image(image_id)
        options = pycolmap.BundleAdjustmentOptions(print_summary=False)
        options.ceres.solver_options.max_num_iterations = 2
        adjuster = pycolmap.create_default_ceres_bundle_adjuster(options, config, reconstruction)
        residuals = []
        for frame_id in reconstruction.reg_frame_ids():
            cost = _ceres.range_cost(range_m=1.0, tag_in_cam_m=[0, 0, 0], stddev_m=1.0)
            loss = _ceres.cauchy_loss(1.0)
            blocks = [reconstruction.frame(frame_id).rig_from_world.params, np.ones(3), np.zeros(1)]
            _ceres.add_residual_block(adjuster, cost, loss, blocks)
            residuals.append((cost, loss, blocks))
        return dict(adjuster=adjuster, problem=adjuster.problem, reconstruction=reconstruction, residuals=residuals)

    for order in itertools.permutations(("adjuster", "problem", "reconstruction", "residuals")):
        held = make()
        for name in order:
            del held[name]
            gc.collect()
            make()  # takes and scribbles over whatever memory became free
            if "adjuster" in held:
                assert held["adjuster"].solve().is_solution_usable(), (order, name)
            elif "problem" in held:
                assert np.all(np.isfinite(held["problem"].evaluate_residuals())), (order, name)
    gc.collect()
    assert not _ceres._used_by_adjuster, "adjusters that nobody refers to are still there"
"""


@pytest.mark.parametrize("first", ["pycolmap", "pyceres"])
def test_references_may_be_dropped_in_any_order(first: str) -> None:
    # In a process of its own: what went wrong here would end this one.
    imports = "import pycolmap, pyceres" if first == "pycolmap" else "import pyceres, pycolmap"
    script = textwrap.dedent(LIFETIMES).format(imports=imports)
    run = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=120)
    assert run.returncode == 0, run.stderr[-2000:]


def test_the_gate_opens_for_what_is_installed() -> None:
    check_compatibility()


@pytest.fixture
def unchecked() -> Iterator[None]:
    """Nothing has been checked yet in this process, and will not have been."""
    check_compatibility.cache_clear()
    yield
    check_compatibility.cache_clear()


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize(("package", "version"), [("pycolmap", "4.3.0"), ("pyceres", "2.5"), ("pyceres", None)])
def test_the_gate_names_what_is_installed_what_is_needed_and_what_to_run(
    monkeypatch: pytest.MonkeyPatch, package: str, version: str | None
) -> None:
    installed_version = _ceres.installed_version
    monkeypatch.setattr(
        _ceres, "installed_version", lambda name: version if name == package else installed_version(name)
    )
    with pytest.raises(SolverError) as caught:
        range_cost(range_m=4.0, tag_in_cam_m=TAG_IN_CAM_M, stddev_m=0.1)
    message = str(caught.value)
    assert f"{package} {version or 'not'}" in message
    assert f"needs {package} {_ceres.NEEDED_VERSIONS[package]}" in message
    assert "pip install 'pycolmap>=4.2,<4.3' 'pyceres>=2.6,<2.7'" in message
    assert "\n" not in message


@pytest.mark.usefixtures("unchecked")
def test_the_gate_stays_shut_where_types_are_not_shared(monkeypatch: pytest.MonkeyPatch) -> None:
    # What pybind11 does with a type that its internals do not know.
    def unknown_type(**_: object) -> CostFunction:
        raise TypeError("Unable to convert function return value to a Python type! The signature was\n\t...")

    monkeypatch.setattr(_cpp, "range_cost", unknown_type)
    with pytest.raises(SolverError, match="pyceres does not know its cost functions"):
        check_compatibility()


@pytest.mark.usefixtures("unchecked")
def test_the_gate_stays_shut_where_a_known_cost_comes_out_wrong(monkeypatch: pytest.MonkeyPatch) -> None:
    right = _cpp.range_cost
    monkeypatch.setattr(
        _cpp,
        "range_cost",
        lambda *, range_m, tag_in_cam_m, stddev_m: right(
            range_m=range_m, tag_in_cam_m=tag_in_cam_m, stddev_m=2 * stddev_m
        ),
    )
    with pytest.raises(SolverError, match=r"a residual of cost 2\.0 costs 0\.5 in pyceres' problem"):
        check_compatibility()


def test_the_compiled_part_needs_no_library_that_pycolmap_does_not_need_too() -> None:
    """Ceres is linked in, and never the system's: else two of them would meet."""
    readelf = subprocess.run(["readelf", "-dW", _cpp.__file__], capture_output=True, text=True, check=True)
    needed = set(re.findall(r"NEEDED.*\[(.+?)\.so", readelf.stdout))
    assert needed <= {"libstdc++", "libm", "libgcc_s", "libc", "ld-linux-x86-64", "ld-linux-aarch64"}


def test_the_pins_checked_are_the_pins_of_the_package() -> None:
    requirements = importlib.metadata.requires("rangesfm")
    assert requirements is not None
    for package, needed in _ceres.NEEDED_VERSIONS.items():
        major, minor = map(int, needed.split("."))
        (requirement,) = (r for r in requirements if re.match(rf"{package}\b", r))
        assert set(re.findall(r"[<>=]+[\d.]+", requirement)) == {f">={needed}", f"<{major}.{minor + 1}"}
        assert f"'{package}>={needed},<{major}.{minor + 1}'" in _ceres.INSTALL_COMMAND
