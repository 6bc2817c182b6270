"""Ties between models of one survey: the similarity by which two models become one, from photos that match."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import pycolmap

from rangesfm.arrays import Array, Indices, Mask
from rangesfm.colmap.pieces import MIN_NUM_SHARED
from rangesfm.sfm.loop_database import Pair
from rangesfm.sfm.loops.resection import resect
from rangesfm.util.geometry.similarity import Similarity

# Matches of one pair may agree by chance; photos of a path that comes back match in more than one.
_MIN_NUM_PAIRS = 2
# Largest error of a match that agrees with a tie, in pixels: that with which COLMAP's mapper registers a photo. The tie
# is that of one pair, and both models have drifted at the others.
_MAX_ERROR_PX = pycolmap.IncrementalMapperOptions().abs_pose_max_error


@dataclass(frozen=True)
class Tie:
    """Two models of which photos see the same.

    Attributes:
        first_from_second: from the world of the second model to that of the first.
        pairs: that agree on it, a photo of the first model before one of the second.
    """

    first_from_second: Similarity
    pairs: tuple[Pair, ...]


def find_tie(
    first: pycolmap.Reconstruction,
    second: pycolmap.Reconstruction,
    verified: Mapping[Pair, Indices],
    *,
    seed: int,
) -> Tie | None:
    """Return the tie on which most matches of photos of two models agree; None if fewer than two pairs agree.

    Args:
        first, second: the models.
        verified: matches (m, 2) of features that fit a two-view geometry, by pair of ids, smaller first. Pairs that are
            not between the models do not count.
        seed: of random numbers.
    """
    ways = [way for pair, matches in verified.items() for way in ((pair, matches), (pair[::-1], matches[:, ::-1]))]
    pairs = [
        _MatchedPoints.in_photos(first, second, pair, matches)
        for pair, matches in ways
        if _has(first, pair[0]) and _has(second, pair[1])
    ]
    pairs = [pair for pair in pairs if len(pair.in_first) >= MIN_NUM_SHARED]
    found = [similarity for pair in pairs if (similarity := pair.similarity(seed)) is not None]
    num_agreeing = np.array([[pair.agree(similarity).sum() for pair in pairs] for similarity in found], dtype=np.int64)
    if not len(found):
        return None
    best = int(num_agreeing.sum(axis=1).argmax())
    agreeing = tuple(pairs[k].image_ids for k in np.flatnonzero(num_agreeing[best] >= MIN_NUM_SHARED))
    return Tie(found[best], agreeing) if len(agreeing) >= _MIN_NUM_PAIRS else None


def _has(model: pycolmap.Reconstruction, image_id: int) -> bool:
    return model.exists_image(image_id) and model.image(image_id).has_pose


@dataclass(frozen=True)
class _MatchedPoints:
    """Matches of a photo of one model with a photo of another one, where both features have a point.

    Attributes:
        image_ids: of the two photos.
        photos, cameras: the two photos with their cameras.
        in_first, in_second: (m, 3) the points in each model. pixels: (2, m, 2) the features.
    """

    image_ids: Pair
    photos: tuple[pycolmap.Image, pycolmap.Image]
    cameras: tuple[pycolmap.Camera, pycolmap.Camera]
    in_first: Array
    in_second: Array
    pixels: Array

    @classmethod
    def in_photos(
        cls, first: pycolmap.Reconstruction, second: pycolmap.Reconstruction, image_ids: Pair, matches: Indices
    ) -> _MatchedPoints:
        models = first, second
        photos = first.image(image_ids[0]), second.image(image_ids[1])
        cameras = first.camera(photos[0].camera_id), second.camera(photos[1].camera_id)
        features = [[photo.points2D[k] for k in column] for photo, column in zip(photos, matches.T.tolist())]
        rows = [row for row in zip(*features, strict=True) if all(feature.has_point3D() for feature in row)]
        in_each = [
            np.array([model.point3D(row[k].point3D_id).xyz for row in rows]).reshape(-1, 3)
            for k, model in enumerate(models)
        ]
        pixels = np.array([[row[k].xy for row in rows] for k in range(2)]).reshape(2, -1, 2)
        return cls(image_ids, photos, cameras, in_each[0], in_each[1], pixels)

    def similarity(self, seed: int) -> Similarity | None:
        """Return first_from_second with the second photo placed by the first model's points; None if it cannot be."""
        if (found := resect(self.pixels[1], self.in_first, self.cameras[1], seed)) is None:
            return None
        cam_from_first, fits = found
        center, own_center = cam_from_first.tgt_origin_in_src(), self.photos[1].projection_center()
        lengths, own_lengths = (
            np.linalg.norm(points[fits] - at, axis=1)
            for points, at in ((self.in_first, center), (self.in_second, own_center))
        )
        scale = float(np.median(lengths / own_lengths))
        rotation = cam_from_first.rotation.matrix().T @ self.photos[1].cam_from_world().rotation.matrix()
        return Similarity(scale, rotation, center - scale * rotation @ own_center)

    def agree(self, first_from_second: Similarity) -> Mask:
        """Return which of the m matches agree: in each photo, the point of the other model is where its feature is."""
        seen = (first_from_second.apply(self.in_second), first_from_second.inverse().apply(self.in_first))
        fits = np.ones(len(self.in_first), dtype=np.bool_)
        for photo, camera, points, pixels in zip(self.photos, self.cameras, seen, self.pixels, strict=True):
            pose = photo.cam_from_world()
            in_cam = points @ pose.rotation.matrix().T + pose.translation
            is_ahead = in_cam[:, 2] > 0
            in_cam[~is_ahead] = (0.0, 0.0, 1.0)
            off_px = np.linalg.norm(np.asarray(camera.img_from_cam(in_cam)) - pixels, axis=1)
            fits &= is_ahead & (off_px < _MAX_ERROR_PX)
        return fits
