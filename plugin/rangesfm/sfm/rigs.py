"""Rigs of cameras from COLMAP's rig configuration: photos taken at once, and the cameras' poses in their rig."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap

from rangesfm.colmap.transform import transform
from rangesfm.errors import InputError
from rangesfm.measurements.lengths.tape import CONTROL, TapedDistance
from rangesfm.options import COORDINATE_M
from rangesfm.util.files.records import read_json
from rangesfm.util.geometry.similarity import IDENTITY

# Cameras nearer to each other than this share a centre, like those of a panorama, and give no length.
_MIN_BASELINE_M = 1e-4
# Largest difference of a quaternion's length from 1.
_MAX_OFF_UNIT = 1e-3
# Positions are written to a hundredth of a millimetre or finer, so that a smaller difference is no second measurement.
_SAME_PLACE_M = 1e-5


@dataclass(frozen=True)
class Rigs:
    """Rigs as configured; empty without a configuration.

    Attributes:
        configs: COLMAP's rig configurations in the order of the file, with lengths in metres.
    """

    configs: tuple[pycolmap.RigConfig, ...] = ()
    path: Path | None = None

    @cached_property
    def _cameras(self) -> list[tuple[int, pycolmap.RigConfigCamera]]:
        return [(k, camera) for k, config in enumerate(self.configs) for camera in config.cameras]

    @property
    def inputs(self) -> list[Any]:
        """Plain values that differ for other rigs; empty without rigs."""
        return [str(config.todict()) for config in self.configs]

    @property
    def are_known(self) -> list[bool]:
        """Return, for each rig, whether the configuration gives the poses of all its cameras."""
        return [all(c.ref_sensor or c.cam_from_rig is not None for c in config.cameras) for config in self.configs]

    @property
    def are_metric(self) -> bool:
        """Return whether the configuration gives the distance between any two cameras."""
        return any(_baseline_m(camera) for _, camera in self._cameras)

    def camera_of(self, name: str) -> str | None:
        """Return the image prefix of the camera that took a photo, or None if the photo belongs to no rig.

        Raises:
            InputError: the photo's name begins with the prefixes of two cameras.
        """
        found = [camera.image_prefix for _, camera in self._cameras if name.startswith(camera.image_prefix)]
        if len(found) > 1:
            message = f"the photo {name} belongs to '{found[0]}' and '{found[1]}', expected one image_prefix"
            raise InputError(message, self.path)
        return found[0] if found else None

    def frames(self, names: Sequence[str]) -> dict[str, tuple[str, ...]]:
        """Group the photos that were taken at once.

        Each group goes by its photo from the reference camera, or by its first photo if there is none.

        Raises:
            InputError: a camera has no photos, or a photo belongs to two cameras.
        """
        prefixes = {name: self.camera_of(name) for name in names}
        for _, camera in self._cameras:
            if camera.image_prefix not in prefixes.values():
                raise InputError(f"no photo's name begins with image_prefix '{camera.image_prefix}'", self.path)
        rig_of = {camera.image_prefix: k for k, camera in self._cameras}
        references = {camera.image_prefix for _, camera in self._cameras if camera.ref_sensor}
        frames: dict[Any, list[str]] = {}
        for name, prefix in prefixes.items():
            key = name if prefix is None else (rig_of[prefix], name.removeprefix(prefix))
            frames.setdefault(key, []).append(name)
        ordered = (
            sorted(photos, key=lambda name: (prefixes[name] not in references, name)) for photos in frames.values()
        )
        return {frame[0]: tuple(frame) for frame in ordered}

    def apply(self, database_path: Path, model: pycolmap.Reconstruction | None = None) -> None:
        """Write the rigs into a database in which each of their cameras is one camera.

        Args:
            model: a model of the photos without rigs, which gives the camera poses that the configuration lacks.

        Raises:
            InputError: COLMAP cannot form the rigs, because photos are missing in the database or in the model.
        """
        if not self.configs:
            return
        with pycolmap.Database.open(database_path) as database, pycolmap.DatabaseTransaction(database):
            try:
                pycolmap.apply_rig_config(list(self.configs), database, *([] if model is None else [model]))
            except ValueError as error:
                reason = " ".join(str(error).partition("Check failed: ")[2].split())
                raise InputError(f"does not fit the photos ({reason})", self.path) from None

    def ids_of_known(self, database_path: Path) -> set[int]:
        """Return the ids of the rigs in a database whose camera poses are all known.

        COLMAP gives ids to rigs in the order of the configuration.
        """
        with pycolmap.Database.open(database_path) as database:
            ids = sorted(rig.rig_id for rig in database.read_all_rigs())
        return {rig_id for rig_id, is_known in zip(ids, self.are_known, strict=False) if is_known}

    def baselines(self, model: pycolmap.Reconstruction, stddev_m: float) -> tuple[TapedDistance, ...]:
        """Return the known distances of cameras from their reference cameras, as measured lengths between two photos.

        A camera with the same position in several rigs gives one length. Such rigs are one rig used on several days, or
        were built to one plan. The position was measured once, and all rigs share its error.

        Args:
            stddev_m: standard deviation of each length, metres.
        """
        measured: list[pycolmap.RigConfigCamera] = []
        taped = []
        for camera, pairs in self._baselines_in(model):
            ends = next(pairs, None)
            if ends is not None and not any(_is_placed_alike(camera, other) for other in measured):
                measured.append(camera)
                taped.append(TapedDistance(ends, _baseline_m(camera), stddev_m, CONTROL, line=0, is_everywhere=True))
        return tuple(taped)

    def rescale(self, model: pycolmap.Reconstruction) -> None:
        """Scale a model made without the rigs, in place, to the known distances between cameras, if there are any."""
        ratios = [
            _baseline_m(camera) / length
            for camera, pairs in self._baselines_in(model)
            for pair in pairs
            if (length := _distance(model, pair)) > 0
        ]
        if ratios:
            transform(model, replace(IDENTITY, scale=float(np.median(ratios))))

    def _baselines_in(
        self, model: pycolmap.Reconstruction
    ) -> Iterator[tuple[pycolmap.RigConfigCamera, Iterator[tuple[str, str]]]]:
        """Yield each camera at a known distance from its reference camera, with the pairs of photos of the two."""
        for config in self.configs:
            reference = next(camera.image_prefix for camera in config.cameras if camera.ref_sensor)
            for camera in config.cameras:
                if _baseline_m(camera):
                    yield camera, _pairs(model, reference, camera.image_prefix)


NO_RIGS = Rigs()


def read_rigs(path: Path | None) -> Rigs:
    """Read COLMAP's ``rig_config.json``; without a path there are no rigs.

    Raises:
        InputError: the file is not a rig configuration, or a camera's pose is not valid.
    """
    if path is None:
        return NO_RIGS
    content = read_json(path)
    try:
        configs = pycolmap.read_rig_config(path)
        for camera in (camera for rig in content for camera in rig["cameras"]):
            _check_pose(camera, path)
    except (RuntimeError, ValueError, LookupError, TypeError, AttributeError) as error:
        reason = " ".join(str(error).split()).removesuffix(".")
        raise InputError(f"is not a rig configuration of COLMAP's ({reason})", path) from None
    if not configs:
        raise InputError("holds no rig, expected COLMAP's rig configuration", path)
    return Rigs(tuple(configs), path)


def _check_pose(camera: Mapping[str, Any], path: Path) -> None:
    """Check what COLMAP does not: it has arbitrary numbers where some are missing, and takes any that are there."""
    name = camera["image_prefix"]
    for key, num in (("cam_from_rig_rotation", 4), ("cam_from_rig_translation", 3)):
        if len(found := camera.get(key, [0.0] * num)) != num:
            raise InputError(f"{key} of '{name}' has {len(found)} numbers, expected {num}", path)
    turn, shift = camera.get("cam_from_rig_rotation", [1, 0, 0, 0]), camera.get("cam_from_rig_translation", [0, 0, 0])
    if not abs(np.linalg.norm(np.array(turn, dtype=float)) - 1) < _MAX_OFF_UNIT:
        raise InputError(f"cam_from_rig_rotation of '{name}' is {turn}, expected w, x, y, z of length 1", path)
    if not COORDINATE_M.hold(np.array(shift, dtype=float)).all():
        raise InputError(f"cam_from_rig_translation of '{name}' is {shift}, expected three times {COORDINATE_M}", path)


def _baseline_m(camera: pycolmap.RigConfigCamera) -> float:
    """Return the distance of a camera from its reference camera in metres; 0 if unknown or negligible."""
    length_m = 0.0 if camera.cam_from_rig is None else float(np.linalg.norm(camera.cam_from_rig.translation))
    return length_m if length_m >= _MIN_BASELINE_M else 0.0


def _is_placed_alike(camera: pycolmap.RigConfigCamera, other: pycolmap.RigConfigCamera) -> bool:
    """Return whether two cameras have the same centre in their rigs, to the precision of a configuration file."""
    centers = [known.cam_from_rig.inverse().translation for known in (camera, other) if known.cam_from_rig is not None]
    return len(centers) == 2 and bool(np.allclose(centers[0], centers[1], rtol=0, atol=_SAME_PLACE_M))


def _pairs(model: pycolmap.Reconstruction, reference: str, other: str) -> Iterator[tuple[str, str]]:
    """Yield the pairs of photos in a model that two cameras took at once."""
    names = sorted(image.name for image in model.images.values() if image.has_pose)
    there = set(names)
    for name in names:
        if name.startswith(reference) and (partner := other + name.removeprefix(reference)) in there:
            yield name, partner


def _distance(model: pycolmap.Reconstruction, names: tuple[str, str]) -> float:
    centers = [model.find_image_with_name(name).projection_center() for name in names]
    return float(np.linalg.norm(centers[0] - centers[1]))
