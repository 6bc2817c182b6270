"""An antenna's known positions, with what is known of its lever arm and of its clock."""

from __future__ import annotations

from dataclasses import dataclass, replace

from rangesfm.arrays import Array
from rangesfm.measurements.positions.position_log import PositionLog
from rangesfm.measurements.ranges.clock.offset import Rival, TimeOffset
from rangesfm.options import RangesOptions


@dataclass(frozen=True)
class AntennaTrack:
    """Positions of an antenna on the camera.

    Attributes:
        log: in the site's frame.
        antenna_in_cam_m: (3,) lever arm.
        offset_s: image time minus time of the positions; None: not known yet. offset_stddev_s: its standard deviation.
        association: how positions are placed between keyframes.
        other_offset_s: offset with which the positions fit the path much better than with the given one; None: none.
        search: how the offset was found, with other likely offsets; None where it was given or is not needed.
    """

    log: PositionLog
    antenna_in_cam_m: Array
    offset_s: float | None
    association: RangesOptions
    offset_stddev_s: float = 0.0
    other_offset_s: float | None = None
    search: TimeOffset | None = None

    def of_rival(self, rival: Rival) -> AntennaTrack:
        """Return the track with another likely time offset."""
        return replace(self, offset_s=rival.value_s, search=self.search and self.search.of_rival(rival))
