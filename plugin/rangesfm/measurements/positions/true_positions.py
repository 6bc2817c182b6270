"""True positions to compare with, from every file from which known positions are read."""

from __future__ import annotations

from pathlib import Path

from rangesfm.errors import InputError
from rangesfm.measurements.positions.position_formats import read_positions
from rangesfm.measurements.ranges.readers.unclear import UnclearFileError
from rangesfm.options import PositionOptions
from rangesfm.util.files.contents import AnyPath
from rangesfm.util.files.text_tables import read_head
from rangesfm.util.geometry.reference import Reference, is_reference_file, read_reference

_EXPECTED = "expected image_name or timestamp_s, and x_m,y_m,z_m, or a file that --positions reads"


def read_true_positions(path: AnyPath) -> Reference:
    """Read a reference as ``read_reference``, or else positions as ``read_positions``, which have no rotations.

    Raises:
        InputError: the file is not valid, its columns are not known for sure, or its positions are degrees.
    """
    path = Path(path)
    if path.suffix == ".tum" or is_reference_file(read_head(path)):
        return read_reference(path)
    try:
        log = read_positions(path, PositionOptions())
    except UnclearFileError as error:
        raise InputError(f"{'; '.join(error.about)}; {_EXPECTED}", path) from None
    if log.crs:
        raise InputError(f"the positions are in {log.crs}, expected metres in the frame of the map", path)
    return Reference(log.position_m, log.moments, notes=log.notes)
