"""Export for COLMAP, and for programs that read COLMAP models, such as dense reconstruction and splatting."""

from __future__ import annotations

import shutil
import tempfile
from pathlib import Path

import numpy as np
import pycolmap
from scipy.spatial.transform import Rotation

from rangesfm.colmap.colmap_log import colmap_log
from rangesfm.colmap.model_files import write_binary_model
from rangesfm.errors import InputError
from rangesfm.export.metric_map import MetricMap, photo_files, registered_images, require_space
from rangesfm.util.files.atomic import new_file, new_folder, write_text
from rangesfm.util.files.folders import real_path


def write_model(reconstruction: pycolmap.Reconstruction, path: Path, *, as_text: bool = False) -> Path:
    """Write the model as the folder ``path`` and replace an older one. If that fails, nothing is changed.

    Raises:
        InputError: with ``as_text``, the name of a photo has white space, where COLMAP would split it.
    """
    if as_text:
        _require_names_without_blanks(reconstruction, "colmap_text")
    with new_folder(path) as folder:
        if as_text:
            reconstruction.write_text(folder)
        else:
            write_binary_model(reconstruction, folder)
    return path


def write_project(map_: MetricMap, path: Path, *, as_text: bool = False) -> Path:
    """Write the model and, where the folder of the photos is known, a ``project.ini`` for COLMAP's GUI.

    COLMAP refuses a project whose folder of photos does not exist; its database need not exist.
    """
    write_model(map_.reconstruction, path, as_text=as_text)
    if map_.images_path is not None and map_.images_path.is_dir():
        database_path = map_.database_path or path / "database.db"
        text = f"database_path={real_path(database_path)}\nimage_path={real_path(map_.images_path)}\n"
        if "#" not in text:  # a # would begin a comment in project.ini
            write_text(text, path / "project.ini")
    return path


def write_transform(map_: MetricMap, folder: Path) -> tuple[Path, Path]:
    """Write metric_from_sfm for COLMAP's ``model_transformer``, with all digits, in both forms that COLMAP has had.

    ``transform_colmap_4.txt`` has ``scale qw qx qy qz tx ty tz`` on one line, for COLMAP from 3.9 on;
    ``transform_colmap_3.8.txt`` has a 4 x 4 matrix. Each version also reads the other's file without an error, but then
    transforms the model wrongly.

    Raises:
        InputError: the similarity is not known.
    """
    metric_from_sfm = map_.metric_from_sfm
    if metric_from_sfm is None:
        raise InputError("the format 'transform' needs metric_from_sfm, which is not known for this model")
    qx, qy, qz, qw = Rotation.from_matrix(metric_from_sfm.rotation).as_quat()
    numbers = np.array([metric_from_sfm.scale, qw, qx, qy, qz, *metric_from_sfm.translation])
    matrix = np.eye(4)
    matrix[:3] = np.column_stack([metric_from_sfm.scale * metric_from_sfm.rotation, metric_from_sfm.translation])
    paths = folder / "transform_colmap_4.txt", folder / "transform_colmap_3.8.txt"
    for path, rows in zip(paths, (numbers[None], matrix)):
        write_text("".join(" ".join(f"{number:.17g}" for number in row) + "\n" for row in rows), path)
    return paths


def write_camera_positions(reconstruction: pycolmap.Reconstruction, path: Path) -> Path:
    """Write the camera positions in metres, ``image_name x y z`` for each registered photo, in order of the names.

    Raises:
        InputError: the name of a photo has white space, where COLMAP would split it.
    """
    _require_names_without_blanks(reconstruction, "model_aligner")
    lines = [
        " ".join([image.name, *(f"{value:.17g}" for value in image.projection_center())])
        for image in registered_images(reconstruction)
    ]
    write_text("\n".join(lines) + "\n", path)
    return path


def write_pose_priors(map_: MetricMap, path: Path) -> Path:
    """Write a copy of the photos' database in which their positions are pose priors, for ``pose_prior_mapper``.

    The positions are those of the map, with their covariance if it is known, in the map's frame. COLMAP can match by
    them (``spatial_matcher``) and map with them, also together with photos that are added to the database later.

    Raises:
        InputError: there is no database, or it has none of the photos.
    """
    if map_.database_path is None or not map_.database_path.is_file():
        raise InputError("the format 'pose_priors' needs the photos' database (database.db), which is not there")
    covariances = map_.center_covariance_m2
    with new_file(path) as temporary, tempfile.TemporaryDirectory() as scratch:
        copy = Path(shutil.copy(map_.database_path, Path(scratch) / "copy.db"))
        with pycolmap.Database.open(copy) as database:
            database.clear_pose_priors()
            data_ids = {image.name: image.data_id for image in database.read_all_images()}
            known = [image for image in registered_images(map_.reconstruction) if image.name in data_ids]
            if not known:
                raise InputError("it has none of the map's photos, expected their database", map_.database_path)
            for image in known:
                prior = pycolmap.PosePrior(
                    corr_data_id=data_ids[image.name],
                    position=image.projection_center(),
                    position_covariance=covariances.get(image.name, np.full((3, 3), np.nan)),
                    coordinate_system=pycolmap.PosePriorCoordinateSystem.CARTESIAN,
                )
                database.write_pose_prior(prior)
        shutil.copyfile(copy, temporary)
    return path


def _require_names_without_blanks(reconstruction: pycolmap.Reconstruction, name: str) -> None:
    for image in reconstruction.images.values():
        if len(image.name.split()) != 1:
            raise InputError(f"the format {name!r} cannot hold white space in a photo's name: {image.name!r}")


def write_undistorted(map_: MetricMap, folder: Path) -> Path:
    """Write undistorted photos (``images/``) and a model of them with pinhole cameras (``sparse/0``) into ``folder``.

    Raises:
        InputError: the folder of the photos is not known, or a photo is not in it.
        OSError: the disk is too full for the photos.
    """
    images_path = map_.images_path
    if images_path is None:
        raise InputError("the format 'undistorted' needs the photos: give their folder (--images)")
    files = photo_files(map_, images_path)
    with new_folder(folder) as temporary, tempfile.TemporaryDirectory() as model_path:
        write_binary_model(map_.reconstruction, Path(model_path))
        # On a full disk, the library that writes the photos ends the whole process without an error message.
        require_space(temporary, files.values())
        with colmap_log(temporary / "undistortion.log"):
            pycolmap.undistort_images(temporary, model_path, images_path)
        _into_sparse_0(temporary)
    return folder


def _into_sparse_0(folder: Path) -> None:
    """Move the model to ``sparse/0``, where programs look for it, and delete COLMAP's scripts for MVS and its log."""
    files = list((folder / "sparse").iterdir())
    (folder / "sparse" / "0").mkdir()
    for path in files:
        path.rename(folder / "sparse" / "0" / path.name)
    for path in folder.iterdir():
        if path.name not in ("images", "sparse"):
            shutil.rmtree(path) if path.is_dir() else path.unlink()
