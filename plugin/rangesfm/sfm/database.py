"""COLMAP's database of one survey: photos, features and matches.

It is always opened through pycolmap, even to look at it while COLMAP writes. Python's sqlite3 is another copy of
SQLite. When one copy closes a file, the system drops the locks that the other copy in the same process holds on it,
and the database is damaged within seconds.
"""

from __future__ import annotations

import shutil
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path

import pycolmap


def create_database(
    path: Path, image_names: Sequence[str], cameras: Sequence[pycolmap.Camera], of_photo: Sequence[int]
) -> None:
    """Create a database with these photos in the place of an old one; each camera is a rig of its own.

    COLMAP itself would add the photos in the order in which its threads come to them. Here they get the ids 1, 2, ...
    in the order of ``image_names``, so that the same seed gives the same model in every run.

    Args:
        of_photo: index of each photo's camera in ``cameras``.
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


def write_position_priors(path: Path, positions: Iterable[tuple[float, float, float] | None]) -> None:
    """Write the position of each photo, in the order of their ids, as COLMAP does for photos that it adds itself.

    Args:
        positions: latitude and longitude in degrees (WGS 84) and altitude in metres, or None for a photo without one.
    """
    with pycolmap.Database.open(path) as database, pycolmap.DatabaseTransaction(database):
        for image_id, position in enumerate(positions, 1):
            if position is not None:
                prior = pycolmap.PosePrior(
                    position=position, coordinate_system=pycolmap.PosePriorCoordinateSystem.WGS84
                )
                prior.corr_data_id = database.read_image(image_id).data_id
                database.write_pose_prior(prior)


def files_of_database(path: Path) -> list[Path]:
    """Return the path of a database, and those of the files that SQLite keeps beside it while a program has it open."""
    return [path.with_name(path.name + suffix) for suffix in ("", "-wal", "-shm")]


def remove_database(path: Path) -> None:
    for file in files_of_database(path):
        file.unlink(missing_ok=True)


def copy_database(source: Path, path: Path) -> None:
    """Copy a database, with the changes that SQLite has not yet put into its file."""
    for file, copy in zip(files_of_database(source)[:2], files_of_database(path), strict=False):
        if file == source or file.is_file():
            shutil.copyfile(file, copy)


@contextmanager
def copying(source_path: Path, path: Path) -> Iterator[tuple[pycolmap.Database, pycolmap.Database]]:
    """Open a source and a target database; an error inside the block undoes all that was written to the target."""
    with (
        pycolmap.Database.open(source_path) as source,
        pycolmap.Database.open(path) as target,
        pycolmap.DatabaseTransaction(target),
    ):
        yield source, target


def copy_features(source: pycolmap.Database, target: pycolmap.Database, new_ids: Mapping[int, int]) -> None:
    """Copy the features of photos.

    Args:
        new_ids: by each photo's id in the source, its id in the target.
    """
    for old, new in new_ids.items():
        target.write_keypoints(new, source.read_keypoints(old))
        if source.exists_descriptors(old):
            target.write_descriptors(new, source.read_descriptors(old))


def copy_photos(source_path: Path, path: Path, image_ids: Sequence[int]) -> None:
    """Copy some photos with their features into a new database, where each photo keeps its id and is named by it."""
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
    """Copy the matches of those pairs of photos that COLMAP has matched into another database.

    Args:
        pairs: for each pair, the two ids in the source and the two ids in the target, smaller id first.
    """
    with copying(source_path, path) as (source, target):
        for old, new in pairs:
            if source.exists_two_view_geometry(*old):  # COLMAP writes one for each pair it has tried, matching or not
                target.write_matches(*new, source.read_matches(*old))
                target.write_two_view_geometry(*new, source.read_two_view_geometry(*old))


def clear_matches(path: Path) -> None:
    with pycolmap.Database.open(path) as database, pycolmap.DatabaseTransaction(database):
        database.clear_matches()
        database.clear_two_view_geometries()


@contextmanager
def named_by_place(path: Path, image_names: Sequence[str]) -> Iterator[None]:
    """Name the photos by their index in ``image_names`` (the order of their ids) inside the block.

    COLMAP's sequential matching takes the order of names for the order in time.
    """
    name_photos(path, [f"{place:09d}" for place in range(len(image_names))])
    try:
        yield
    finally:
        name_photos(path, image_names)


def name_photos(path: Path, image_names: Sequence[str]) -> None:
    """Rename the photos; ``image_names`` is in the order of their ids."""
    with pycolmap.Database.open(path) as database, pycolmap.DatabaseTransaction(database):
        for image in database.read_all_images():
            image.name = image_names[image.image_id - 1]
            database.update_image(image)


def num_photos_with_features(database: pycolmap.Database) -> int:
    """Return the number of photos that COLMAP has searched for features, whether or not it found any."""
    return sum(database.exists_keypoints(image_id) for image_id in range(1, database.num_images() + 1))


def num_matching_pairs(database: pycolmap.Database) -> int:
    """Return the number of pairs of photos whose matches fit one two-view geometry."""
    return len(database.read_two_view_geometry_num_inliers()[0])
