"""Measure the stages from photos to a model, beside the same calls of pycolmap with all its threads.

python -m tests.benchmarks.reconstruction PHOTOS[:EVERY_NTH] ... [--num_threads 2] [--num_rounds 3] [--seed 0]
    [--camera_model OPENCV --camera_params 377,432,...]
python -m tests.benchmarks.reconstruction SURVEY.toml ... [--base_path DATA_FOLDER] [--num_threads 2] [--num_rounds 3]

PHOTOS are folders, for example ``DATA/room_env1/images:3 DATA/fountain/images plugin/rangesfm/demo/photos``. The photos
of a folder are taken in the order of their names and matched sequentially. Each round measures both programs. Printed
are the medians of the wall-clock seconds and of the processor seconds (user and system, child processes included; other
load on the machine disturbs these less), their ratios within each round (median, smallest and largest), and the
machine's load. "all" is the whole call, from reading the photos to reading the models.

Of a survey, the way to its refined metric map (``rangesfm run``, without the report) is measured beside that of
pycolmap's calls to an unscaled one, with neighbours matched by COLMAP's own options. ``--base_path`` is as for
``rangesfm run``.

A calibrated camera is held fixed by pycolmap's mapping, too. That is faster than its default.
"""

from __future__ import annotations

import argparse
import os
import resource
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from statistics import median

import pycolmap

from rangesfm.colmap.colmap_log import colmap_log
from rangesfm.mapper_options import MapperOptions
from rangesfm.options import CameraOptions
from rangesfm.pipeline.map_photos import find_keyframes
from rangesfm.pipeline.run import run_survey
from rangesfm.progress import Journal, Progress
from rangesfm.sfm.image_times import list_images
from rangesfm.sfm.reconstruct import reconstruct
from rangesfm.survey.settings import Survey
from rangesfm.survey.survey_reader import read_survey

STAGES = ("features", "matching", "mapping")


@dataclass(frozen=True)
class Effort:
    """Seconds of wall-clock time and of processor time."""

    clock_s: float
    processor_s: float

    @classmethod
    def so_far(cls) -> Effort:
        used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
        return cls(time.perf_counter(), sum(part.ru_utime + part.ru_stime for part in used))

    def __sub__(self, other: Effort) -> Effort:
        return Effort(self.clock_s - other.clock_s, self.processor_s - other.processor_s)


def effort_of(work: Callable[[], object]) -> Effort:
    begin = Effort.so_far()
    work()
    return Effort.so_far() - begin


class StageEfforts(Progress):
    """Record the time whenever a stage begins."""

    def __init__(self) -> None:
        self.marks: list[Effort] = []

    def stage(self, name: str) -> None:
        assert name == STAGES[len(self.marks)]
        self.marks.append(Effort.so_far())


def by_pycolmap(
    photos: Path, names: Sequence[str], output: Path, camera: CameraOptions, num: int, seed: int
) -> list[Effort]:
    """Run pycolmap's own calls, with the given seed and camera."""
    database = output / "database.db"
    reader = pycolmap.ImageReaderOptions()
    if camera.model and camera.params:
        reader.camera_model, reader.camera_params = camera.model, ",".join(map(repr, camera.params))
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = seed
    mapping = pycolmap.IncrementalPipelineOptions(num_threads=num, random_seed=seed)
    if camera.params:
        mapping.ba_refine_focal_length = mapping.ba_refine_extra_params = False
        mapping.mapper.abs_pose_refine_focal_length = mapping.mapper.abs_pose_refine_extra_params = False
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
        efforts = [effort_of(calls[stage]) for stage in STAGES]
    return [*efforts, Effort(sum(e.clock_s for e in efforts), sum(e.processor_s for e in efforts))]


def by_rangesfm(
    photos: Path, names: Sequence[str], output: Path, camera: CameraOptions, num: int, seed: int
) -> list[Effort]:
    mapper = MapperOptions(matching="sequential", num_threads=num)
    stages, begin = StageEfforts(), Effort.so_far()
    reconstruct(photos, names, output, camera=camera, mapper=mapper, seed=seed, progress=stages)
    marks = [begin, *stages.marks[1:], Effort.so_far()]  # what comes before the features counts as part of them
    return [*(end - start for start, end in pairwise(marks)), marks[-1] - begin]


def to_metric_map(survey: Survey, output: Path, num: int, seed: int) -> Effort:
    """Run a survey from its photos to the refined metric map, without a report."""
    values = {"output.path": output, "output.seed": seed, "mapper.num_threads": num, "report.enabled": False}
    return effort_of(lambda: run_survey(survey.changed(values)))


def compare_with_metric_map(survey: Survey, num: int, num_rounds: int, seed: int) -> None:
    names, _ = find_keyframes(survey, Journal(Progress()))
    theirs, ours = [], []
    for _ in range(num_rounds):
        with tempfile.TemporaryDirectory() as scratch:
            output = Path(scratch) / "pycolmap"
            output.mkdir()
            theirs.append(by_pycolmap(survey.photos_path, names, output, survey.camera, num, seed)[-1])
            ours.append(to_metric_map(survey, Path(scratch) / "rangesfm", num, seed))
    print(f"{len(names)} photos to a map{'clock':>12} {'processors':>11}   ({load()})")
    for what, efforts in (("unscaled, by pycolmap", theirs), ("metric, by rangesfm", ours)):
        clock_s, processor_s = median(e.clock_s for e in efforts), median(e.processor_s for e in efforts)
        print(f"{what:24}{clock_s:8.1f}s {processor_s:10.1f}s")
    clock = ratio([e.clock_s for e in ours], [e.clock_s for e in theirs])
    processor = ratio([e.processor_s for e in ours], [e.processor_s for e in theirs])
    print(f"ratio, clock {clock}, processors {processor}", flush=True)


def ratio(over: Sequence[float], under: Sequence[float]) -> str:
    ratios = [a / b for a, b in zip(over, under, strict=True)]
    return f"{median(ratios):5.2f} ({min(ratios):.2f} to {max(ratios):.2f})"


def load() -> str:
    return f"load {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores"


def compare_stages(theirs: Sequence[Sequence[Effort]], ours: Sequence[Sequence[Effort]]) -> None:
    print(f"{'':10}{'pycolmap':>19}{'rangesfm':>19}   ratio, clock          ratio, processors   ({load()})")
    for k, what in enumerate((*STAGES, "all")):
        line, ratios = f"{what:10}", []
        for of in (theirs, ours):
            clock_s, processor_s = [e[k].clock_s for e in of], [e[k].processor_s for e in of]
            line += f"{median(clock_s):8.1f} s /{median(processor_s):7.1f} s"
            ratios.append((clock_s, processor_s))
        (clock, processor), (our_clock, our_processor) = ratios
        print(f"{line}   {ratio(our_clock, clock)}   {ratio(our_processor, processor)}", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("photos", nargs="+", help="a folder, perhaps with :N for every Nth of its photos; or a survey")
    parser.add_argument("--base_path", help="of the surveys (default: their folders)")
    parser.add_argument("--num_threads", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--num_rounds", type=int, default=3)
    parser.add_argument("--camera_model")
    parser.add_argument("--camera_params", type=lambda text: tuple(map(float, text.split(","))))
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    camera = CameraOptions(model=arguments.camera_model, params=arguments.camera_params)
    num, seed = arguments.num_threads, arguments.seed
    for given in arguments.photos:
        if given.endswith(".toml"):
            print(f"\n{given}:", flush=True)
            compare_with_metric_map(
                read_survey(given, base_folder=arguments.base_path), num, arguments.num_rounds, seed
            )
            continue
        folder, _, every_nth = given.partition(":")
        photos = Path(folder)
        names = list_images(photos)[:: int(every_nth or 1)]
        print(f"\n{photos}: {len(names)} photos, {num} threads, {load()}", flush=True)
        theirs, ours = list[list[Effort]](), list[list[Effort]]()
        with tempfile.TemporaryDirectory() as scratch:
            for number in range(arguments.num_rounds):
                for run, found in ((by_pycolmap, theirs), (by_rangesfm, ours)):
                    output = Path(scratch) / f"{run.__name__}{number}"
                    output.mkdir()
                    found.append(run(photos, names, output, camera, num, seed))
        compare_stages(theirs, ours)


if __name__ == "__main__":
    main()
