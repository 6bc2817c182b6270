"""Options of the stages: how each does its work. Plain values with defaults.

A survey file's tables are these classes, key for key; what a key means is said here.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

ANCHOR_FRAMES = ("site", "first_camera", "unknown")
SCALE_METHODS = ("robust", "two-candidate")
CAMERA_SIDES = ("above", "below")
EXPORT_FRAMES = ("result", "level", "enu")
DEFAULT_FORMATS = ("tum", "ply")
STAMP_UNITS = ("ns", "us", "ms", "s", "ticks")
MATCHING_METHODS = ("sequential", "exhaustive", "auto")


@dataclass(frozen=True)
class KeyframeOptions:
    """Which photos become keyframes (table ``[images]``). All that are given must hold.

    Attributes:
        every_nth: every n-th photo in time order.
        min_interval_s: at least this long after the previous keyframe.
        max_num_keyframes: evenly thinned to at most this many.
    """

    every_nth: int = 1
    min_interval_s: float = 0.0
    max_num_keyframes: int | None = None


@dataclass(frozen=True)
class CameraOptions:
    """One camera for all photos (table ``[camera]``).

    Attributes:
        model: COLMAP's camera model name; None lets COLMAP guess from EXIF.
        params: the model's parameters in COLMAP's order; None if not known.
        refine_intrinsics: whether mapping and refinement adjust them; None: mapping does if they
            are not given, and the refinement keeps what it finds, so that it does the same to a
            model just mapped and to one brought along.
    """

    model: str | None = None
    params: tuple[float, ...] | None = None
    refine_intrinsics: bool | None = None

    @property
    def mapping_refines_intrinsics(self) -> bool:
        return self.params is None if self.refine_intrinsics is None else self.refine_intrinsics


@dataclass(frozen=True)
class MapperOptions:
    """Photos to unscaled model (table ``[mapper]``).

    Attributes:
        matching: "sequential", "exhaustive" or "auto" (exhaustive up to 60 keyframes).
        features, pairing, matcher, pipeline: passed through to pycolmap's
            FeatureExtractionOptions, the pairing options of the chosen matching,
            FeatureMatchingOptions and IncrementalPipelineOptions.
        ranges_in_mapping: whether each global bundle adjustment of the mapping carries the ranges, as soon as they
            determine the scale. Takes much longer; the refinement at the end mostly comes to the same map.
        num_threads: -1 for all cores. Matching on the processor takes one thread all the same, as
            pycolmap 4.2 loses matches with more; ``matcher.num_threads`` overrides that.
        submap_size: photos of a submap: more photos than that are mapped in stretches of so many in their order, each
            on its own, which are joined by the photos that they share; None: all in one piece.
        submap_overlap: photos that a submap shares with the one before.
        num_submaps_at_once: each is mapped by a process of its own; they share the threads.
    """

    matching: str = "auto"
    features: dict[str, Any] = field(default_factory=dict)
    pairing: dict[str, Any] = field(default_factory=dict)
    matcher: dict[str, Any] = field(default_factory=dict)
    pipeline: dict[str, Any] = field(default_factory=dict)
    ranges_in_mapping: bool = False
    num_threads: int = -1
    submap_size: int | None = None
    submap_overlap: int = 20
    num_submaps_at_once: int = 1


@dataclass(frozen=True)
class AssociationOptions:
    """Ranges to places on the path (part of table ``[ranges]``).

    Attributes:
        max_interpolation_gap_s: between keyframes further apart than this no pose is interpolated.
        max_time_difference_s: a range this close to a keyframe counts as taken there, where no pose
            can be interpolated.
    """

    max_interpolation_gap_s: float = 2.0
    max_time_difference_s: float = 0.02


@dataclass(frozen=True)
class CheckOptions:
    """Ranges held out of every estimate, to be compared with the result (part of table ``[ranges]``).

    Attributes:
        check_share: share of the ranges, chosen at random. Neighbours in time err alike, so that
            this is the mildest check.
        check_anchors: ids of anchors; each must have a surveyed position, or nothing could be said of its ranges.
        check_times_s: (from, to) on the radio's clock; empty for none.
    """

    check_share: float = 0.0
    check_anchors: tuple[str, ...] = ()
    check_times_s: tuple[float, ...] = ()


@dataclass(frozen=True)
class RangeModelOptions:
    """What is assumed of the radio (part of table ``[ranges]``).

    Attributes:
        range_stddev_m: noise of a range; None: estimated from the residuals.
        range_bias_stddev_m: prior of each anchor's own constant bias, mean 0. Small on purpose:
            a freer bias soaks up errors that depend on direction, and shifts the map instead.
        common_bias_stddev_m: prior of the bias that all anchors share (the tag's delay), mean 0.
    """

    range_stddev_m: float | None = None
    range_bias_stddev_m: float = 0.01
    common_bias_stddev_m: float = 0.1


@dataclass(frozen=True)
class ScaleOptions:
    """Table ``[scale]``.

    Attributes:
        method: "robust" (default) or "two-candidate" (the paper's).
        num_bootstrap: resamplings of the block bootstrap over time.
        bootstrap_block_s: length of its blocks.
        max_relative_stddev: a scale less certain than this is refused.
        up_in_first_camera: (3,) the upward direction in the first keyframe's camera frame, of any length: (0, -1, 0)
            for a camera held level. Two anchors of a site are enough with it, and a mirror image is ruled out that
            would stand the map on its head.
        camera_side: "above" or "below": where the camera went, seen from surveyed anchors that are all in one
            plane; None: not told.
    """

    method: str = "robust"
    num_bootstrap: int = 200
    bootstrap_block_s: float = 10.0
    max_relative_stddev: float = 0.1
    up_in_first_camera: tuple[float, float, float] | None = None
    camera_side: str | None = None


@dataclass(frozen=True)
class RefineOptions:
    """Table ``[refine]``.

    Attributes:
        enabled: False leaves the map as scaled.
        max_num_iterations: of the solver.
        range_loss_scale: residual in stddevs from which a range is down-weighted (Geman-McClure).
        lever_arm_stddev_m: of each coordinate of the tags' places in the camera frame, which are estimated if this is
            more than 0.
        time_offset_stddev_s: of the clocks' offset, likewise.
        short_range_stddev_m: of an error of short ranges that all share and that dies out with a length of 1 m,
            likewise.
        covariance: whether to find that of poses, anchors and scale; not found of more than 1500 photos that
            see much of the same; along a path, of some thousands.
        bundle_adjustment: passed through to pycolmap's BundleAdjustmentOptions.
    """

    enabled: bool = True
    max_num_iterations: int = 200
    range_loss_scale: float = 3.46
    lever_arm_stddev_m: float = 0.0
    time_offset_stddev_s: float = 0.0
    short_range_stddev_m: float = 0.0
    covariance: bool = True
    bundle_adjustment: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class ExportOptions:
    """Table ``[export]``: the metric model in other formats, and in which frame.

    Attributes:
        formats: names of exporters.
        frame: "result" (the site's or the first camera's, as the result has it), "level" (z up, y as the first camera
            looks, origin as it is) or "enu" (x east, y north, z up; for that the map must be georeferenced).
        up: what is up: "cameras" (the mean of what is up in the photos), "path" (across the plane of the path), three
            numbers, a direction in the result's frame, or "auto": z in a site frame, else as "cameras".
        crs: coordinate system of what is written for maps (LAZ, GeoPackage), as "EPSG:2056"; None: that of the
            anchors, else longitude and latitude.
        origin_anchor: id of an anchor whose place on the Earth is known.
        origin_lat_lon_height: that place, degrees and metres above the ellipsoid (WGS 84).
        heading_deg: azimuth in which the first camera looks, from north through east.
    """

    formats: tuple[str, ...] = DEFAULT_FORMATS
    frame: str = "result"
    up: str = "auto"
    crs: str | None = None
    origin_anchor: str | None = None
    origin_lat_lon_height: tuple[float, float, float] | None = None
    heading_deg: float | None = None
