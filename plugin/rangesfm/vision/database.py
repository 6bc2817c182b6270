"""COLMAP's database of one survey: photos, features and matches.

Always through pycolmap, also to look at it while COLMAP writes: Python's sqlite3 is another copy of
SQLite, and when one copy closes a file, the system drops the locks that the other one in the same
process holds on it. The database is broken within seconds.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path

import pycolmap


def create_database(
    path: Path, image_names: Sequence[str], cameras: Sequence[pycolmap.Camera], of_photo: Sequence[int]
) -> None:
    """A new database with these photos, in the place of an old one; each camera is a rig of its own.

    COLMAP would enter photos as its threads come to them; entered here they have the same ids
    1, 2, ... in every run, and the same seed gives the same model.

    Args:
        of_photo: place of each photo's camera in ``cameras``.
    """
    remove_database(path)
    with pycolmap.Database.open(path) as database, pycolmap.DatabaseTransaction(database):
        rigs = []
        for camera in cameras:
            camera.camera_id = database.write_camera(camera)
            rigs.append(pycolmap.Rig())
            rigs[-1].add_ref_sensor(camera.sensor_id)
            rigs[-1].rig_id = database.write_rig(rigs[-1])
        for name, place in zip(image_names, of_photo, strict=True):
            image = pycolmap.Image(name=name, camera_id=cameras[place].camera_id)
            image.image_id = database.write_image(image)
            frame = pycolmap.Frame()
            frame.rig_id = rigs[place].rig_id
            frame.add_data_id(image.data_id)
            database.write_frame(frame)


def write_positions(path: Path, positions: Iterable[tuple[float, float, float] | None]) -> None:
    """Where each photo was taken, by the order of their ids: latitude, longitude (degrees, WGS 84) and altitude (m).

    COLMAP would write down those of photos that it enters itself.
    """
    with pycolmap.Database.open(path) as database, pycolmap.DatabaseTransaction(database):
        for image_id, position in enumerate(positions, 1):
            if position is not None:
                prior = pycolmap.PosePrior(
                    position=position, coordinate_system=pycolmap.PosePriorCoordinateSystem.WGS84
                )
                prior.corr_data_id = database.read_image(image_id).data_id
                database.write_pose_prior(prior)


def remove_database(path: Path) -> None:
    """Remove the file and those that SQLite keeps beside it."""
    for suffix in ("", "-wal", "-shm"):
        path.with_name(path.name + suffix).unlink(missing_ok=True)


@contextmanager
def copying(source_path: Path, path: Path) -> Iterator[tuple[pycolmap.Database, pycolmap.Database]]:
    """A database and another one, to which something is to be written; of an error nothing is."""
    with (
        pycolmap.Database.open(source_path) as source,
        pycolmap.Database.open(path) as target,
        pycolmap.DatabaseTransaction(target),
    ):
        yield source, target


def copy_features(source: pycolmap.Database, target: pycolmap.Database, new_ids: Mapping[int, int]) -> None:
    """Features of photos, by their ids in the source those in the target."""
    for old, new in new_ids.items():
        target.write_keypoints(new, source.read_keypoints(old))
        if source.exists_descriptors(old):
            target.write_descriptors(new, source.read_descriptors(old))


def copy_photos(source_path: Path, path: Path, image_ids: Sequence[int]) -> None:
    """A new database for matching some of another one's photos, which keep their ids and are called by them."""
    with copying(source_path, path) as (source, target):
        for camera in source.read_all_cameras():
            target.write_camera(camera, use_camera_id=True)
        for rig in source.read_all_rigs():
            target.write_rig(rig, use_rig_id=True)
        images = [source.read_image(image_id) for image_id in image_ids]
        for frame_id in {image.frame_id: None for image in images}:
            target.write_frame(source.read_frame(frame_id), use_frame_id=True)
        for image_id, image in zip(image_ids, images, strict=True):
            image.name = str(image_id)
            target.write_image(image, use_image_id=True)
        copy_features(source, target, {image_id: image_id for image_id in image_ids})


def copy_matches(source_path: Path, path: Path, pairs: Iterable[tuple[tuple[int, int], tuple[int, int]]]) -> None:
    """Matches of pairs of photos into another database, as far as there are any.

    Args:
        pairs: ids in the source, smaller first, and those of the same photos in the target, likewise.
    """
    with copying(source_path, path) as (source, target):
        for old, new in pairs:
            if source.exists_two_view_geometry(*old):  # COLMAP has been through them, whether or not they match
                target.write_matches(*new, source.read_matches(*old))
                target.write_two_view_geometry(*new, source.read_two_view_geometry(*old))


def clear_matches(path: Path) -> None:
    with pycolmap.Database.open(path) as database, pycolmap.DatabaseTransaction(database):
        database.clear_matches()
        database.clear_two_view_geometries()


@contextmanager
def named_by_place(path: Path, image_names: Sequence[str]) -> Iterator[None]:
    """Inside the block the photos are called by their place in ``image_names``, the order of their ids.

    COLMAP's sequential matching takes the order of names for the order in time.
    """
    name_photos(path, [f"{place:09d}" for place in range(len(image_names))])
    try:
        yield
    finally:
        name_photos(path, image_names)


def name_photos(path: Path, image_names: Sequence[str]) -> None:
    """By the order of their ids."""
    with pycolmap.Database.open(path) as database, pycolmap.DatabaseTransaction(database):
        for image in database.read_all_images():
            image.name = image_names[image.image_id - 1]
            database.update_image(image)


def num_photos_with_features(database: pycolmap.Database) -> int:
    """How many photos COLMAP has been through, whether or not it found anything in them."""
    return sum(database.exists_keypoints(image_id) for image_id in range(1, database.num_images() + 1))


def num_matching_pairs(database: pycolmap.Database) -> int:
    """How many pairs of photos have matches that fit one geometry of two views."""
    return len(database.read_two_view_geometry_num_inliers()[0])
