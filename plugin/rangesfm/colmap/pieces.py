"""Points that photos of a model see, and parts of it that hardly any point holds together.

Each of such parts may have a scale and a place of its own.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pycolmap
from scipy.sparse import coo_array, csr_array
from scipy.sparse.csgraph import connected_components

from rangesfm.arrays import Array, Indices

# COLMAP takes two photos for a pair if this many matches agree on their geometry (min_num_inliers).
MIN_NUM_SHARED = 15


def seen_in(image: pycolmap.Image) -> tuple[Indices, Array]:
    """Return the ids (n,) of the 3-D points that a photo sees, and their image coordinates (n, 2) in pixels."""
    seen = [(point.point3D_id, point.x(), point.y()) for point in image.get_observation_points2D()]
    columns = np.array(seen, dtype=np.float64).reshape(-1, 3)
    return columns[:, 0].astype(np.int64), columns[:, 1:]


def ids_seen_in(image: pycolmap.Image) -> Indices:
    """Return the ids alone, in half the time."""
    return np.array([point.point3D_id for point in image.get_observation_points2D()], dtype=np.int64)


def overlaps_in(model: pycolmap.Reconstruction) -> csr_array:
    """Return the sparse matrix (n, n) of the numbers of points that pairs of the n registered photos both see."""
    sees = _sees(model, np.arange(model.num_reg_images()), model.num_reg_images())
    return csr_array(sees @ sees.T)


@dataclass(frozen=True)
class LoosePiece:
    """A part of a model that shares few points with the rest.

    Attributes:
        image_names: of its photos, in alphabetical order.
        num_shared: points that photos of the part and photos of the rest both see.
    """

    image_names: tuple[str, ...]
    num_shared: int


def loose_pieces(model: pycolmap.Reconstruction) -> tuple[LoosePiece, ...]:
    """Return the parts of a model that share fewer than MIN_NUM_SHARED points with the rest, without the largest part.

    Photos of one rig frame belong together. A single frame is no part, because it has no scale of its own. A model
    without points has no parts.
    """
    frame_ids, sees, labels = _parts(model)
    num_frames = np.bincount(labels, minlength=1)
    largest = num_frames.argmax()
    return tuple(
        LoosePiece(
            tuple(sorted(_names_in(model, frame_ids[labels == part]))),
            int(_shared_by_parts(sees, (labels == part).astype(np.int64))[0, 1]),
        )
        for part in np.flatnonzero(num_frames > 1).tolist()
        if part != largest
    )


def frames_of_parts(model: pycolmap.Reconstruction) -> tuple[Indices, ...]:
    """Return the ids of the frames of each part, the largest first.

    Frames that hang loose alone are parts of one frame. In a map of few points, of which the largest part has no more
    than half of all frames, they belong to it.
    """
    frame_ids, _, labels = _parts(model)
    num_frames = np.bincount(labels, minlength=1)
    if 2 * num_frames.max() <= len(frame_ids):
        labels = np.where(num_frames[labels] == 1, num_frames.argmax(), labels)
    parts = (frame_ids[labels == part] for part in np.unique(labels))
    return tuple(sorted(parts, key=len, reverse=True))


def photos_without_shared_points(model: pycolmap.Reconstruction) -> tuple[str, ...]:
    """Return the names of the photos of frames that share no point with any other, so that nothing tells their places.

    None of a model without shared points, which is a trajectory.
    """
    frame_ids, sees = _seen_by_frames(model)
    sees.data[:] = 1.0
    is_shared = sees.sum(axis=0) > 1
    is_apart = sees[:, is_shared].sum(axis=1) == 0
    return tuple(sorted(_names_in(model, frame_ids[is_apart]))) if is_shared.any() else ()


def _seen_by_frames(model: pycolmap.Reconstruction) -> tuple[Indices, csr_array]:
    """Return the ids (f,) of the frames, and the matrix (f, p) of the points that they see."""
    frame_ids = np.array(sorted(model.reg_frame_ids()), dtype=np.int64)
    frame_of = [model.image(image_id).frame_id for image_id in model.reg_image_ids()]
    return frame_ids, _sees(model, np.searchsorted(frame_ids, frame_of), len(frame_ids))


def _parts(model: pycolmap.Reconstruction) -> tuple[Indices, csr_array, Indices]:
    """Return the ids (f,) of the frames, the matrix (f, p) of the points that they see, and the part (f,) of each.

    Parts are merged as long as two of them share enough points. A model without points is one part.
    """
    frame_ids, sees = _seen_by_frames(model)
    if not sees.shape[1]:
        return frame_ids, sees, np.zeros(len(frame_ids), dtype=np.int64)
    labels = np.arange(len(frame_ids))
    while True:
        num_before = int(labels.max()) + 1
        shared = _shared_by_parts(sees, labels)
        shared.data[shared.data < MIN_NUM_SHARED] = 0
        shared.eliminate_zeros()
        num, merged = connected_components(shared, directed=False)
        labels = merged[labels]
        if num == num_before:
            return frame_ids, sees, labels


def _sees(model: pycolmap.Reconstruction, row_of_photo: Indices, num_rows: int) -> csr_array:
    """Return the sparse matrix (k, p) of how often each row sees each of p points.

    Args:
        row_of_photo: row of each registered photo, in their order.
    """
    photos = [ids_seen_in(model.image(image_id)) for image_id in model.reg_image_ids()]
    row = np.repeat(row_of_photo, [*map(len, photos)])
    unique, column = np.unique(np.concatenate([*photos, np.zeros(0, dtype=np.int64)]), return_inverse=True)
    return coo_array((np.ones(len(row)), (row, column)), shape=(num_rows, len(unique))).tocsr()


def _shared_by_parts(sees: csr_array, labels: Indices) -> csr_array:
    """Return the sparse matrix (k, k) of the numbers of points that pairs of k parts both see."""
    of_part = coo_array((np.ones(len(labels)), (labels, np.arange(len(labels)))))
    by_part = csr_array(of_part.tocsr() @ sees)
    by_part.data[:] = 1.0  # where some frame of a part sees a point
    return csr_array(by_part @ by_part.T)


def _names_in(model: pycolmap.Reconstruction, frame_ids: Indices) -> list[str]:
    """Return the names of the photos of some frames."""
    frames = map(model.frame, frame_ids.tolist())
    return [model.image(data_id.id).name for frame in frames for data_id in frame.image_ids]
