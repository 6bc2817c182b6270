"""Photos to a model, stage by stage, beside the same calls of pycolmap with all its threads.

python -m tests.benchmarks.reconstruction PHOTOS [--every_nth 3] [--num_threads 2] [--num_rounds 3] [--seed 0]
    [--camera_model OPENCV --camera_params 377,432,...]

The photos of a folder in the order of their names, matched sequentially. Rounds of both take turns; printed are medians
of the seconds by the clock, their ratio within each round (median, smallest and largest), and the machine's load. Last,
matching by one process beside matching by ``--num_threads`` of them, on the same features, and whether the matches are
the same, row for row.
"""

from __future__ import annotations

import argparse
import os
import shutil
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from statistics import median

import pycolmap
from tests.vision.matches import content_of

from rangesfm.colmap.log import colmap_log
from rangesfm.options import CameraOptions, MapperOptions
from rangesfm.progress import SilentProgress
from rangesfm.vision.database import clear_matches
from rangesfm.vision.image_times import list_images
from rangesfm.vision.matching import match_features, matching_options
from rangesfm.vision.photos import usable_photos
from rangesfm.vision.reconstruct import reconstruct

STAGES = ("features", "matching", "mapping")
Seconds = dict[str, float]


def seconds_of(work: Callable[[], object]) -> float:
    begin = time.perf_counter()
    work()
    return time.perf_counter() - begin


def by_pycolmap(
    photos: Path, names: Sequence[str], output: Path, camera: CameraOptions, num: int, seed: int
) -> Seconds:
    """Its own calls, with the seed and the camera given."""
    database = output / "database.db"
    reader = pycolmap.ImageReaderOptions()
    if camera.model is not None and camera.params is not None:
        reader.camera_model, reader.camera_params = camera.model, ",".join(map(repr, camera.params))
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = seed
    mapping = pycolmap.IncrementalPipelineOptions(num_threads=num, random_seed=seed)
    calls = {
        "features": lambda: pycolmap.extract_features(
            database,
            photos,
            image_names=list(names),
            camera_mode=pycolmap.CameraMode.SINGLE,
            reader_options=reader,
            extraction_options=pycolmap.FeatureExtractionOptions(num_threads=num),
        ),
        "matching": lambda: pycolmap.match_sequential(
            database,
            pycolmap.FeatureMatchingOptions(num_threads=num),
            pycolmap.SequentialPairingOptions(),
            verification,
        ),
        "mapping": lambda: pycolmap.incremental_mapping(database, photos, output, mapping),
    }
    with colmap_log(output / "mapper.log"):
        return {stage: seconds_of(call) for stage, call in calls.items()}


def by_rangesfm(
    photos: Path, names: Sequence[str], output: Path, camera: CameraOptions, num: int, seed: int
) -> Seconds:
    mapper = MapperOptions(matching="sequential", num_threads=num)
    return reconstruct(photos, names, output, camera=camera, mapper=mapper, seed=seed).seconds


def match_anew(photos: Path, names: Sequence[str], database: Path, num_processes: int, seed: int) -> float:
    """Seconds of matching alone."""
    clear_matches(database)
    options = matching_options(MapperOptions(matching="sequential", num_threads=num_processes), len(names), seed)
    usable, log = usable_photos(photos, names), database.with_name("mapper.log")
    with colmap_log(log):
        return seconds_of(lambda: match_features(database, usable, options, log, SilentProgress()))


def row(what: str, ours: Sequence[float], theirs: Sequence[float]) -> str:
    ratios = [a / b for a, b in zip(ours, theirs, strict=True)]
    spread = f"{median(ratios):6.2f}   {min(ratios):.2f} to {max(ratios):.2f}"
    return f"{what:22} {median(theirs):9.1f} s {median(ours):9.1f} s {spread}"


def load() -> str:
    return f"load {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("photos", type=Path)
    parser.add_argument("--every_nth", type=int, default=3)
    parser.add_argument("--num_threads", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--num_rounds", type=int, default=3)
    parser.add_argument("--camera_model")
    parser.add_argument("--camera_params", type=lambda text: tuple(map(float, text.split(","))))
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    names = list_images(arguments.photos)[:: arguments.every_nth]
    camera = CameraOptions(model=arguments.camera_model, params=arguments.camera_params)
    print(f"{len(names)} photos, {arguments.num_threads} threads, {load()}", flush=True)
    found: dict[str, list[Seconds]] = {"pycolmap": [], "rangesfm": []}
    with tempfile.TemporaryDirectory() as folder:
        for number in range(arguments.num_rounds):
            for name, run in (("pycolmap", by_pycolmap), ("rangesfm", by_rangesfm)):
                output = Path(folder) / f"{name}{number}"
                output.mkdir()
                found[name].append(run(arguments.photos, names, output, camera, arguments.num_threads, arguments.seed))
        print(f"{'':22} {'pycolmap':>11} {'rangesfm':>11}  ratio   in the rounds ({load()})")
        theirs, ours = ([[*seconds.values(), sum(seconds.values())] for seconds in rounds] for rounds in found.values())
        for k, what in enumerate((*STAGES, "all")):
            print(row(what, [s[k] for s in ours], [s[k] for s in theirs]), flush=True)
        databases = [Path(folder) / f"{way}.db" for way in ("one", "several")]
        seconds: list[list[float]] = [[], []]
        for database in databases:
            shutil.copy(Path(folder) / "rangesfm0" / "database.db", database)
        for _ in range(arguments.num_rounds):
            for place, num_processes in enumerate((1, arguments.num_threads)):
                seconds[place].append(
                    match_anew(arguments.photos, names, databases[place], num_processes, arguments.seed)
                )
        is_same = content_of(databases[0]) == content_of(databases[1])
        gains = [one / several for one, several in zip(*seconds, strict=True)]
        print(
            f"matching by {arguments.num_threads} processes: {median(gains):.2f} times as fast as by one"
            f" ({min(gains):.2f} to {max(gains):.2f}; {median(seconds[0]):.1f} and {median(seconds[1]):.1f} s), matches"
            f" {'the same' if is_same else 'NOT THE SAME'}; {load()}"
        )


if __name__ == "__main__":
    main()
