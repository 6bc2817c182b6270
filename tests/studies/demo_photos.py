"""Compare the photos that ship with the demo with what the renderer makes.

Run: python -m tests.studies.demo_photos [--numbers 0 23]

Prints the mean difference of each photo on a scale of 255, and ends with status 1 if one is 2 or more. The loss of JPEG
is 1.4; a camera two centimetres away would give 3.5.
"""

from __future__ import annotations

import argparse
import sys

import numpy as np
import numpy.typing as npt
from PIL import Image
from tests.rendering.courtyard import courtyard
from tests.rendering.make_demo_photos import take_photo, walk

from rangesfm.demo.survey import NUM_PHOTOS, PHOTOS

MOST = 2.0


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--numbers", type=int, nargs="+", default=[0, 23], choices=range(NUM_PHOTOS), metavar="N")
    scene, (path, times_s) = courtyard(), walk()
    is_good = True
    for number in parser.parse_args().numbers:
        rendered = take_photo(scene, path, times_s, number)
        with Image.open(PHOTOS / f"IMG_{number + 1:04d}.jpg") as photo:
            error = float(np.abs(_averaged(rendered) - _averaged(photo)).mean())
        print(f"photo {number}: {error:.2f}")
        is_good &= error < MOST
    return 0 if is_good else 1


def _averaged(photo: Image.Image) -> npt.NDArray[np.float64]:
    """Average the photo over blocks of 4 x 4 pixels."""
    return np.asarray(photo.resize((photo.width // 4, photo.height // 4), Image.Resampling.BOX), dtype=np.float64)


if __name__ == "__main__":
    sys.exit(main())
