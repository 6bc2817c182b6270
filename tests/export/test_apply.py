"""Files made from the unscaled model are transformed to the metric world."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pycolmap
import pytest
from scipy.spatial.transform import Rotation
from tests.export.models import synthesized

from rangesfm.arrays import Array
from rangesfm.colmap.transform import rescale
from rangesfm.errors import InputError
from rangesfm.export import MetricMap, apply_to, best_similarity, export_map, sfm_from_files
from rangesfm.export.ply import write_points
from rangesfm.options import ExportOptions
from rangesfm.util.geometry.similarity import IDENTITY, Similarity

METRIC_FROM_SFM = Similarity(2.5, Rotation.from_rotvec([0.3, -0.7, 1.1]).as_matrix(), np.array([10.0, -20.0, 3.0]))
VERTICES = np.random.default_rng(0).normal(size=(5, 3))
NORMALS = Rotation.random(5, random_state=1).as_matrix()[:, 0]
FACES = b"\x03\x00\x00\x00\x00\x01\x00\x00\x00\x02\x00\x00\x00"


def carry(path: Path, folder: Path) -> Path:
    (written,) = apply_to({path: METRIC_FROM_SFM}, folder)
    assert written == folder / path.name
    return written


def header(encoding: str, kind: str = "float") -> bytes:
    names = ("x", "y", "z", "nx", "ny", "nz")
    lines = ["ply", f"format {encoding} 1.0", "comment made elsewhere", "element vertex 5"]
    lines += [f"property {kind} {name}" for name in names] + ["property uchar red"]
    lines += ["element face 1", "property list uchar int vertex_indices", "end_header", ""]
    return "\n".join(lines).encode()


def vertices_as(code: str) -> npt.NDArray[np.void]:
    columns = [(name, code) for name in ("x", "y", "z", "nx", "ny", "nz")]
    made = np.empty(5, dtype=[*columns, ("red", "u1")])
    for name, values in zip(("x", "y", "z", "nx", "ny", "nz"), np.column_stack([VERTICES, NORMALS]).T, strict=True):
        made[name] = values
    made["red"] = np.arange(5)
    return made


@pytest.mark.parametrize(
    ("encoding", "code", "kind"),
    [
        ("binary_little_endian", "<f4", "float"),
        ("binary_little_endian", "<f8", "double"),
        ("binary_big_endian", ">f4", "float"),
    ],
)
def test_a_binary_mesh_moves_and_keeps_its_faces_and_colours(
    encoding: str, code: str, kind: str, tmp_path: Path
) -> None:
    path = tmp_path / "mesh.ply"
    path.write_bytes(header(encoding, kind) + vertices_as(code).tobytes() + FACES)
    head, _, body = carry(path, tmp_path / "out").read_bytes().partition(b"end_header\n")
    assert head + b"end_header\n" == header(encoding, kind).replace(b" 1.0\n", b" 1.0\ncomment metres\n")
    read = np.frombuffer(body[: -len(FACES)], dtype=vertices_as(code).dtype)
    assert body.endswith(FACES)
    tolerance = 1e-5 if code.endswith("4") else 1e-12
    found = np.column_stack([read[name] for name in "xyz"])
    np.testing.assert_allclose(found, METRIC_FROM_SFM.apply(VERTICES), atol=tolerance)
    turned = np.column_stack([read[name] for name in ("nx", "ny", "nz")])
    np.testing.assert_allclose(turned, NORMALS @ METRIC_FROM_SFM.rotation.T, atol=1e-6)
    np.testing.assert_array_equal(read["red"], range(5))


def test_a_mesh_in_words_moves_as_well(tmp_path: Path) -> None:
    rows = "".join(
        " ".join(map(str, [*v, *n, i])) + "\n" for i, (v, n) in enumerate(zip(VERTICES, NORMALS, strict=True))
    )
    path = tmp_path / "mesh.ply"
    path.write_bytes(header("ascii") + rows.encode() + b"3 0 1 2\n")
    lines = carry(path, tmp_path / "out").read_text().partition("end_header\n")[2].splitlines()
    found = np.array([[float(word) for word in line.split()] for line in lines[:5]])
    np.testing.assert_allclose(found[:, :3], METRIC_FROM_SFM.apply(VERTICES), atol=1e-7)
    assert lines[3].split()[-1] == "3"
    assert lines[5:] == ["3 0 1 2"]


def test_far_from_the_origin_a_mesh_becomes_double(tmp_path: Path) -> None:
    path = tmp_path / "mesh.ply"
    path.write_bytes(header("binary_little_endian") + vertices_as("<f4").tobytes() + FACES)
    far = Similarity(1.0, np.eye(3), np.array([2.6e6, 1.2e6, 400.0]))
    (written,) = apply_to({path: far}, tmp_path / "out")
    head, _, body = written.read_bytes().partition(b"end_header\n")
    assert head.count(b"property double") == 3
    kind = np.dtype([*((n, "<f8") for n in "xyz"), *((n, "<f4") for n in ("nx", "ny", "nz")), ("red", "u1")])
    read = np.frombuffer(body[: -len(FACES)], dtype=kind)
    np.testing.assert_allclose(np.column_stack([read[n] for n in "xyz"]), far.apply(VERTICES), rtol=0, atol=1e-6)


def test_an_obj_moves_and_keeps_the_rest(tmp_path: Path) -> None:
    path = tmp_path / "mesh.obj"
    path.write_text("# made elsewhere\nmtllib a.mtl\nv 1 2 3 0.5 0.5 0.5\nvn 0 0 1\nf 1//1 1//1 1//1\n")
    lines = carry(path, tmp_path / "out").read_text().splitlines()
    assert [*lines[:3], lines[5]] == ["# metres", "# made elsewhere", "mtllib a.mtl", "f 1//1 1//1 1//1"]
    v, vn = (np.array(lines[i].split()[1:], dtype=np.float64) for i in (3, 4))
    np.testing.assert_allclose(v, [*METRIC_FROM_SFM.apply(np.array([1.0, 2.0, 3.0])), 0.5, 0.5, 0.5], rtol=1e-9)
    np.testing.assert_allclose(vn, METRIC_FROM_SFM.rotation[:, 2], rtol=1e-9)


@pytest.fixture
def sfm() -> pycolmap.Reconstruction:
    return synthesized(6, 40, seed=2)


def nerfstudio_poses(path: Path) -> Array:
    return np.array([frame["transform_matrix"] for frame in json.loads(path.read_text())["frames"]])


def test_cameras_of_nerfstudio_go_where_an_export_of_the_metric_model_puts_them(
    sfm: pycolmap.Reconstruction, tmp_path: Path
) -> None:
    options = ExportOptions(formats=("nerfstudio",))
    (path,) = export_map(MetricMap(sfm), tmp_path / "sfm", options)
    # nerfstudio's own converter does the same: it turns the world and records the transform in the file.
    content = json.loads(path.read_text())
    applied = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
    content["applied_transform"] = applied[:3].tolist()
    for frame in content["frames"]:
        frame["transform_matrix"] = (applied @ np.array(frame["transform_matrix"])).tolist()
    path.write_text(json.dumps(content))
    (expected,) = export_map(MetricMap(rescale(sfm, METRIC_FROM_SFM)), tmp_path / "metric", options)
    found = carry(path, tmp_path / "out")
    np.testing.assert_allclose(nerfstudio_poses(found), nerfstudio_poses(expected), atol=1e-9)


def test_cameras_of_splatting_move_and_turn(tmp_path: Path) -> None:
    path = tmp_path / "cameras.json"
    path.write_text(json.dumps([{"id": 0, "position": [1, 2, 3], "rotation": np.eye(3).tolist(), "fx": 500.0}]))
    (camera,) = json.loads(carry(path, tmp_path / "out").read_text())
    np.testing.assert_allclose(camera["position"], METRIC_FROM_SFM.apply(np.array([1.0, 2.0, 3.0])))
    np.testing.assert_allclose(camera["rotation"], METRIC_FROM_SFM.rotation)
    assert camera["fx"] == 500.0


def test_a_model_folder_moves(sfm: pycolmap.Reconstruction, tmp_path: Path) -> None:
    (tmp_path / "dense").mkdir()
    sfm.write(tmp_path / "dense")
    moved = pycolmap.Reconstruction(carry(tmp_path / "dense", tmp_path / "out"))
    similarity, residual_m = best_similarity(sfm, moved)
    assert residual_m == pytest.approx(0, abs=1e-9)
    assert similarity.scale == pytest.approx(2.5)


def test_what_a_refinement_bent_is_said(sfm: pycolmap.Reconstruction) -> None:
    bent = rescale(sfm, IDENTITY)
    frame = bent.frame(min(bent.reg_frame_ids()))
    pose = frame.rig_from_world
    assert pose is not None
    frame.rig_from_world = pycolmap.Rigid3d(pose.rotation, pose.translation + np.array([0.1, 0, 0]))
    _, residual_m = best_similarity(sfm, bent)
    assert 0.01 < residual_m < 0.1


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("a.stl", b"solid", "cannot be transformed, expected .ply, .obj, .json or the folder"),
        ("a.ply", b"plyp", "not a PLY file"),
        ("a.ply", b"ply\nformat ascii 1.0\nelement face 1\nend_header\n", "first element is vertex"),
        ("a.ply", b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nend_header\n1\n", "no x, y and z"),
        ("a.ply", header("ascii").replace(b"vertex 5", "vertex ²".encode("latin-1")), "expected a number of vertices"),
        ("a.ply", header("ascii").replace(b"vertex 5", b"vertex " + b"5" * 30), "expected a number of vertices"),
        ("a.ply", header("binary_little_endian") + b"short", "ends within its 5 vertices"),
        ("a.ply", header("ascii") + b"1 2 3\n" * 6, "a.ply:15: not a vertex of 7 numbers"),
        (
            "a.ply",
            header("ascii") + b"0 0 inf 0 0 1 255\n" * 5,
            "coordinates of vertices are infinite",
        ),
        ("a.ply", header("ascii") + b"0 0 1e99 0 0 1 255\n" * 5, "a.ply:15: not a vertex of 7 numbers"),
        ("a.ply", header("ascii") + b"0 0 0 0 0 1 inf\n" * 5, "a.ply:15: not a vertex of 7 numbers"),
        ("a.obj", b"v 1 two 3\n", "a.obj:1: 'v 1 two 3' is not a vertex"),
        ("a.obj", b"v 1 inf 3\n", "a.obj:1: 'v 1 inf 3' is not a vertex"),
        ("a.json", b'[{"position": [1, 1e308, 3], "rotation": [[1, 0, 0], [0, 1, 0], [0, 0, 1]]}]', "not as expected"),
        ("a.json", b"{", "a.json:1: not JSON"),
        ("a.json", b"[]", "no cameras"),
        ("a.json", b'{"frames": [{}]}', "a camera is not as expected"),
        (
            "a.ply",
            header("ascii").replace(b"property uchar red", b"property float rot_0") + b"",
            "Gaussian splats cannot be transformed",
        ),
    ],
)
def test_what_cannot_be_carried_over_is_refused(name: str, content: bytes, said: str, tmp_path: Path) -> None:
    (tmp_path / name).write_bytes(content)
    with pytest.raises(InputError) as refused:
        apply_to({tmp_path / name: METRIC_FROM_SFM}, tmp_path / "out")
    assert said in str(refused.value)
    assert not list((tmp_path / "out").glob("*"))


def test_nothing_is_overwritten(tmp_path: Path) -> None:
    path = tmp_path / "a.obj"
    path.write_text("v 1 2 3\n")
    with pytest.raises(InputError, match="would overwrite"):
        apply_to({path: METRIC_FROM_SFM}, tmp_path)
    assert path.read_text() == "v 1 2 3\n"


def without_comment(path: Path) -> Path:
    """Remove the comment that a PLY file is in metres, as a program does that reads it and writes it again."""
    path.write_bytes(path.read_bytes().replace(b"comment metres\n", b""))
    return path


def written_from(model: pycolmap.Reconstruction, folder: Path) -> list[Path]:
    """Write a model as each kind of file; the points without a word of their unit, and a part of them alone."""
    folder.mkdir()
    centers = [image.projection_center().tolist() for image in model.images.values()]
    cameras = [{"position": center, "rotation": np.eye(3).tolist()} for center in centers]
    (folder / "cameras.json").write_text(json.dumps(cameras))
    rows = [point.xyz for point in model.points3D.values() if point.xyz[0] > np.mean(centers, axis=0)[0]]
    (folder / "part.obj").write_text("".join(f"v {x} {y} {z}\n" for x, y, z in rows))
    points = without_comment(write_points(model, folder / "points.ply"))
    (nerfstudio,) = export_map(MetricMap(model), folder, ExportOptions(formats=("nerfstudio",)))
    (folder / "model").mkdir()
    model.write(folder / "model")
    return [folder / "cameras.json", folder / "part.obj", points, nerfstudio, folder / "model"]


@pytest.mark.parametrize("scale", [0.02, 0.7, 1.0, 2.5, 40.0])
def test_a_file_that_lies_on_the_metric_map_is_not_scaled_again(
    scale: float, sfm: pycolmap.Reconstruction, tmp_path: Path
) -> None:
    metric = rescale(sfm, Similarity(scale, METRIC_FROM_SFM.rotation, METRIC_FROM_SFM.translation))
    sfm_from_files(written_from(sfm, tmp_path / "unscaled"), sfm, [metric])
    for path in written_from(metric, tmp_path / "metric"):
        with pytest.raises(InputError, match=r"in metres already: its .* lie on the metric map"):
            sfm_from_files([path], sfm, [metric])


def test_what_was_written_in_metres_says_so(sfm: pycolmap.Reconstruction, tmp_path: Path) -> None:
    points = without_comment(write_points(sfm, tmp_path / "points.ply"))
    (tmp_path / "mesh.obj").write_text("v 1 2 3\n")
    for path in (points, tmp_path / "mesh.obj"):
        with pytest.raises(InputError, match="says that it is in metres already"):
            sfm_from_files([carry(path, tmp_path / "out")], sfm, [])


# What nerfstudio and gsplat do by default: they turn the scene, centre it and divide it by the largest coordinate.
NORMALISED_FROM_SFM = Similarity(0.4, Rotation.from_rotvec([1.3, 0.2, -0.4]).as_matrix(), np.array([0.3, -0.6, 0.1]))


@pytest.mark.parametrize("scale", [0.37, 4.0])
def test_what_a_trainer_did_to_a_scene_is_undone_by_its_cameras(
    scale: float, sfm: pycolmap.Reconstruction, tmp_path: Path
) -> None:
    metric = rescale(sfm, Similarity(scale, METRIC_FROM_SFM.rotation, METRIC_FROM_SFM.translation))
    paths = written_from(rescale(sfm, NORMALISED_FROM_SFM), tmp_path / "normalised")
    named = json.loads(paths[0].read_text())
    for camera, image in zip(named, rescale(sfm, NORMALISED_FROM_SFM).images.values(), strict=True):
        pose = image.cam_from_world().inverse()
        # Gaussian splatting leaves out the ending of the name.
        camera |= {"img_name": Path(image.name).stem, "rotation": pose.rotation.matrix().tolist()}
    paths[0].write_text(json.dumps(named))
    nerfstudio = json.loads(paths[3].read_text())
    for frame in nerfstudio["frames"]:
        frame["file_path"] = f"./images/left/{frame['file_path'].removeprefix('images/')}"
    paths[3].write_text(json.dumps(nerfstudio))
    for path in (paths[0], paths[3], paths[4]):
        found = sfm_from_files([path], sfm, [metric])[path]
        assert found.scale == pytest.approx(1 / NORMALISED_FROM_SFM.scale, rel=1e-9)
        np.testing.assert_allclose((found @ NORMALISED_FROM_SFM).apply(VERTICES), VERTICES, atol=1e-9)


@pytest.mark.parametrize("scale", [0.37, 4.0])
def test_points_of_another_world_are_refused(scale: float, room: pycolmap.Reconstruction, tmp_path: Path) -> None:
    metric = rescale(room, Similarity(scale, METRIC_FROM_SFM.rotation, METRIC_FROM_SFM.translation))
    _, part, points, *_ = written_from(rescale(room, NORMALISED_FROM_SFM), tmp_path / "normalised")
    larger = Similarity(1.33, np.eye(3), np.zeros(3))
    _, _, stretched, *_ = written_from(rescale(room, larger), tmp_path / "stretched")
    _, _, elsewhere, *_ = written_from(synthesized(6, 400, seed=9), tmp_path / "another")
    for path in (part, points, stretched, elsewhere):
        with pytest.raises(InputError, match="lies on neither the unscaled model nor the metric map"):
            sfm_from_files([path], room, [metric])


def test_cameras_of_photos_with_the_same_names_in_another_scene_are_refused(
    sfm: pycolmap.Reconstruction, tmp_path: Path
) -> None:
    other = synthesized(6, 40, seed=9)
    assert {image.name for image in other.images.values()} == {image.name for image in sfm.images.values()}
    *_, nerfstudio, model = written_from(other, tmp_path / "other")
    for path in (nerfstudio, model):
        with pytest.raises(InputError, match="lies on neither"):
            sfm_from_files([path], sfm, [rescale(sfm, METRIC_FROM_SFM)])


def walls(num: int, seed: int, noise: float = 0.0) -> Array:
    """Places on the walls, the floor and the furniture of a room."""
    rng = np.random.default_rng(seed)
    boxes = np.array([[[0, 0, 0], [8, 6, 3]], [[1, 1, 0], [3, 2, 0.8]], [[5, 3, 0], [5.6, 5, 2]]], dtype=np.float64)
    low, high = boxes[rng.choice(3, num, p=[0.8, 0.1, 0.1])].swapaxes(0, 1)
    places = rng.uniform(low, high)
    axis, side = rng.integers(0, 3, num), rng.integers(0, 2, num)
    places[np.arange(num), axis] = np.where(side[:, None], high, low)[np.arange(num), axis]
    return np.asarray(places + noise * rng.standard_normal((num, 3)))


@pytest.fixture
def room() -> pycolmap.Reconstruction:
    """A model whose points are on surfaces, with the noise of reconstructed points."""
    model = synthesized(6, 600, seed=2)
    for point, at in zip(model.points3D.values(), walls(600, seed=1, noise=0.03), strict=True):
        point.xyz = at
    return model


def test_a_mesh_of_the_scene_or_of_a_part_of_it_has_other_vertices_and_lies_on_the_model(
    room: pycolmap.Reconstruction, tmp_path: Path
) -> None:
    metric, dense = rescale(room, METRIC_FROM_SFM), walls(20_000, seed=5, noise=0.01)
    clutter = np.random.default_rng(0).uniform(-8, 16, (8_000, 3))
    corner = dense[(dense[:, 0] < 3) & (dense[:, 1] < 2)]
    for name, vertices in {"all": dense, "part": corner, "more": np.vstack([dense, clutter])}.items():
        path = tmp_path / f"{name}.obj"
        for similarity, is_metric in ((IDENTITY, False), (METRIC_FROM_SFM, True)):
            rows = similarity.apply(vertices).tolist()
            path.write_text("".join(f"v {x} {y} {z}\n" for x, y, z in rows))
            if is_metric:
                with pytest.raises(InputError, match="is in metres already"):
                    sfm_from_files([path], room, [metric])
            else:
                assert sfm_from_files([path], room, [metric])[path] is IDENTITY
