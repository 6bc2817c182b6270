"""All that is known of positions in a site, and its comparison with the map."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace

import pycolmap

from rangesfm.arrays import Array
from rangesfm.measurements.kind import Doubt
from rangesfm.measurements.kind_as_read import KindAsRead, TimedLog
from rangesfm.measurements.lengths.tape import Marker
from rangesfm.measurements.points import NamedPoints
from rangesfm.measurements.positions.antenna_track import AntennaTrack, locate_antenna
from rangesfm.measurements.positions.clock import find_antenna_offset
from rangesfm.measurements.positions.control_points import ControlPoints, locate_points
from rangesfm.measurements.positions.known_positions import LASTING_S, KnownPositions
from rangesfm.util.geometry.moments import ByTime
from rangesfm.util.geometry.trajectory import Trajectory

_OR_DRIFT = ", or these do not meet (by drift of the poses, or as they are of several points)"


@dataclass(frozen=True)
class SurveyedPositions(KindAsRead):
    """Positions in the site's frame: of marks, and of an antenna.

    Attributes:
        points: control and check points.
        antenna: positions of an antenna on the camera; None without any.
        lasting_s: for how long errors of the antenna's positions last, seconds.
    """

    points: ControlPoints = field(default_factory=ControlPoints)
    antenna: AntennaTrack | None = None
    lasting_s: tuple[float, ...] = LASTING_S

    @property
    def notes(self) -> tuple[str, ...]:
        """Lines for the user about how the files were read."""
        return (*self.points.notes, *(() if self.antenna is None else self.antenna.log.notes))

    def facts(self) -> Iterator[str]:
        """Yield lines that say what is known, before any map is made."""
        if self.points.points:
            nums = Counter(point.kind for point in self.points.points)
            kinds = " and ".join(f"{num} {kind}" for kind, num in nums.items())
            num = sum(point.name in self.points.markers for point in self.points.points)
            yield f"known points: {kinds}, {num} of them with marks in photos so far"
        if self.antenna is not None:
            log = self.antenna.log
            name = "" if log.path is None else f" in {log.path.name}"
            yield f"positions: {len(log)}{name} ({log.format})"

    @property
    def are_known(self) -> bool:
        """True if there are any."""
        return bool(self.points.points) or self.antenna is not None

    @property
    def timed(self) -> TimedLog | None:
        """Those of the antenna, if they are by time."""
        if self.antenna is None or not isinstance(self.antenna.log.moments, ByTime):
            return None
        log, offset = self.antenna.log, self.antenna.offset
        return TimedLog(
            "known positions", log.path, log.moments.timestamp_s, None if offset is None else offset.value_s
        )

    @property
    def clock_stddev_s(self) -> float:
        """Standard deviation of the time offset that all positions of the antenna share; 0 where it was given."""
        return 0.0 if self.antenna is None else self.antenna.offset_stddev_s

    @property
    def is_geodetic(self) -> bool:
        """Whether those of the antenna are in a coordinate system of the Earth, whose scale is right."""
        return self.antenna is not None and bool(self.antenna.log.crs)

    def located(self, model: pycolmap.Reconstruction, path: Trajectory) -> KnownPositions:
        """Find the positions that are in a model. Those by a wrong clock are left out.

        Args:
            model: in any world. path: of its keyframes.

        Raises:
            InputError: the marks of a point are not of one point, or are seen from one direction only.
        """
        marks = locate_points(self.points, model, path)
        if self.antenna is None or self.antenna.other_offset_s is not None:
            return marks
        return marks.joined(locate_antenna(self.antenna, path))

    def on_path(self, path: Trajectory) -> SurveyedPositions:
        """Return the positions with the time offset of the antenna's; errors are those of ``find_antenna_offset``."""
        return self if self.antenna is None else replace(self, antenna=find_antenna_offset(self.antenna, path))

    def with_more_markers(self, markers: Mapping[str, Marker]) -> SurveyedPositions:
        """Return the positions with more marks in photos."""
        return replace(self, points=self.points.with_more(markers))

    def without(self, names: Iterable[str]) -> SurveyedPositions:
        """Return the positions with the points of these names marked as left out."""
        return replace(self, points=self.points.without([*names]))

    @property
    def doubts_of_clock(self) -> Iterator[Doubt]:
        """Yield the reason to doubt the given time offset of the antenna's positions, if there is one."""
        track = self.antenna
        if track is not None and track.other_offset_s is not None:
            ahead_s = track.offset_s - track.other_offset_s
            yield Doubt(
                f"the positions fit the photos' path at a time offset of {track.other_offset_s:+.2f} s, not at the "
                f"given {track.offset_s:+.2f} s: their clock is {abs(ahead_s):.1f} s "
                f"{'ahead' if ahead_s > 0 else 'behind'}, as by leap seconds, or a time zone; they are not used",
                "let the offset be searched for ([positions] time_offset)",
            )

    @property
    def warnings_on_path(self) -> tuple[str, ...]:
        """Why the time offset that was found is doubtful, which moves the map along the path; empty if it is not."""
        offset = None if self.antenna is None else self.antenna.offset
        return () if offset is None or offset.is_certain or not offset.note else (offset.note,)

    def notes_on(self, model: pycolmap.Reconstruction) -> Iterator[str]:
        """Yield a line for the user about points that a model does not show."""
        points, named = self.points.points, NamedPoints.in_model(model, self.points.markers)
        if unseen := [point.name for point in points if not named.is_shown(point.name)]:
            marked = (
                ""
                if self.points.markers.keys() & {*unseen}
                else f"; there are marks of {', '.join([*self.points.markers][:8]) or 'none'}"
            )
            yield (
                f"{len(unseen)} of {len(points)} known points are left out, as fewer than two photos of the map have "
                f"marks of them{_OR_DRIFT * (not model.num_points3D())}: {', '.join(unseen)}{marked}"
            )

    def moved(self, offset_m: Array) -> SurveyedPositions:
        """Return the positions in a frame whose coordinates are larger by ``offset_m`` (3,)."""
        points, antenna = self.points.moved_to(self.points.positions_m + offset_m), self.antenna
        if antenna is not None:
            antenna = replace(antenna, log=antenna.log.moved_to(antenna.log.position_m + offset_m))
        return replace(self, points=points, antenna=antenna)


NO_POSITIONS = SurveyedPositions()
