"""Positions of photos in a COLMAP database: the user's own priors, or those that COLMAP took from EXIF."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from rangesfm.errors import InputError
from rangesfm.measurements.positions.position_log import PositionLog
from rangesfm.util.geometry.georeference import GEOGRAPHIC
from rangesfm.util.geometry.moments import ByPhoto

_MARK = "SQLite format 3"


def is_database(head: str) -> bool:
    """Return whether a file with this beginning is a database."""
    return head.startswith(_MARK)


def read_pose_priors(path: Path) -> PositionLog:
    """Read the pose priors of the photos of a database.

    COLMAP has latitude before longitude, and gives no covariance in metres for them. The file is read from a copy,
    because pycolmap updates old databases in place.

    Raises:
        InputError: it is no database of COLMAP, or its priors are in several coordinate systems.
    """
    import pycolmap

    try:
        with TemporaryDirectory() as scratch:
            copy = Path(shutil.copy(path, Path(scratch) / "copy.db"))
            with pycolmap.Database.open(copy) as database:
                names = {image.image_id: image.name for image in database.read_all_images()}
                priors = [prior for prior in database.read_all_pose_priors() if prior.has_position()]
    except (RuntimeError, ValueError, OSError) as error:
        raise InputError(f"is no database of COLMAP ({error})", path) from None
    systems = {prior.coordinate_system for prior in priors}
    if len(systems) > 1:
        found = ", ".join(sorted(system.name for system in systems))
        raise InputError(f"has pose priors in several coordinate systems ({found}), expected one", path)
    is_geographic = systems == {pycolmap.PosePriorCoordinateSystem.WGS84}
    at = np.array([np.ravel(prior.position) for prior in priors], dtype=np.float64).reshape(-1, 3)
    covariances = np.array([prior.position_covariance for prior in priors], dtype=np.float64).reshape(-1, 3, 3)
    log = PositionLog.in_time_order(
        path,
        "pose priors",
        at[:, [1, 0, 2]] if is_geographic else at,
        ByPhoto(tuple(names.get(prior.corr_data_id.id, "") for prior in priors)),
        np.zeros(len(priors), dtype=np.int64),
        covariance_m2=np.full_like(covariances, np.nan) if is_geographic else covariances,
    )
    return replace(log, crs=GEOGRAPHIC if is_geographic else "")
