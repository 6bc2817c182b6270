"""Prepare metric input for 3D Gaussian splatting: undistorted photos and a model in metres, z up.

python gaussian_splatting.py RESULT_FOLDER OUTPUT_FOLDER [PHOTOS_FOLDER]

Give OUTPUT_FOLDER/undistorted to any trainer that takes COLMAP data (images/ and sparse/0); what it learns is then in
metres. Where the site's zero is far away, its origin is near the cameras, and OUTPUT_FOLDER/offset.txt has what to add
for the coordinates of the site. Some trainers recentre and rescale scenes unless they are told not to: for nerfstudio
and gsplat, pass ``--auto-scale-poses False --center-method none``.
"""

from __future__ import annotations

import sys
from pathlib import Path

from rangesfm import export_result
from rangesfm.export import OFFSET_NAME
from rangesfm.options import ExportOptions


def main() -> None:
    result_folder, output_folder, *photos = map(Path, sys.argv[1:])
    (folder,) = export_result(
        result_folder,
        ["undistorted"],
        output_folder,
        options=ExportOptions(frame="level"),
        images_path=photos[0] if photos else None,
    )
    print(f"{len(list((folder / 'images').iterdir()))} photos and a metric model in {folder}")
    if (output_folder / OFFSET_NAME).exists():
        print((output_folder / OFFSET_NAME).read_text().strip())


if __name__ == "__main__":
    main()
