"""Measure the stages from photos to a model, beside the same calls of pycolmap with all its threads.

python -m tests.benchmarks.reconstruction PHOTOS[:EVERY_NTH] ... [--num_threads 2] [--num_rounds 3] [--seed 0]
    [--camera_model OPENCV --camera_params 377,432,...] [--only stages|matching|mapping]
python -m tests.benchmarks.reconstruction SURVEY.toml ... [--base_path DATA_FOLDER] [--num_threads 2] [--num_rounds 3]

PHOTOS are folders, for example ``DATA/room_env1/images:3 DATA/fountain/images plugin/rangesfm/demo/photos``. The photos
of a folder are taken in the order of their names and matched sequentially. Each round measures both programs. Printed
are the medians of the wall-clock seconds and of the processor seconds (user and system, child processes included; other
load on the machine disturbs these less), their ratios within each round (median, smallest and largest), and the
machine's load. "all" is the whole call, from reading the photos to reading the models.

The second table is about matching alone, on the same features: by one process bound to one core, by one that is not, by
``--num_threads`` processes and by twice as many. It gives how many cores each keeps busy, and whether the matches are
the same, row for row. A process matches in one thread and verifies in another, so on two cores it is not much slower
than two processes. Compare with the process bound to one core to see how matching scales.

The third table is about incremental mapping alone, from the same matches: by rangesfm with ``reproducible`` (in one
thread), and by rangesfm and pycolmap with ``--num_threads``. "Caller" are the processor seconds of the thread that
calls the mapper: the wall-clock time on a machine without other load, if the other threads never keep it waiting. The
last column gives how many different models the rounds have given.

Of a survey, the way to its refined metric map (``rangesfm run``, without the report) is measured beside that of
pycolmap's calls to an unscaled one, with neighbours matched by COLMAP's own options. ``--base_path`` is as for
``rangesfm run``.

A calibrated camera is held fixed by pycolmap's mapping, too. That is faster than its default.
"""

from __future__ import annotations

import argparse
import hashlib
import os
import resource
import shutil
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from statistics import median
from typing import Any

import pycolmap
from tests.sfm.matches import content_of

from rangesfm.colmap.colmap_log import colmap_log
from rangesfm.mapper_options import MapperOptions
from rangesfm.options import CameraOptions
from rangesfm.pipeline.map_photos import find_keyframes
from rangesfm.pipeline.run import run_survey
from rangesfm.progress import Journal, Progress
from rangesfm.sfm.database import clear_matches
from rangesfm.sfm.image_times import list_images
from rangesfm.sfm.incremental_mapping import incremental_mapping
from rangesfm.sfm.mapping import pipeline_options
from rangesfm.sfm.matching import match_features, matching_options
from rangesfm.sfm.photo_files import usable_photos
from rangesfm.sfm.reconstruct import reconstruct
from rangesfm.sfm.steps import Workspace
from rangesfm.survey.settings import Survey
from rangesfm.survey.survey_reader import read_survey

STAGES = ("features", "matching", "mapping")
WAYS = ("rangesfm, reproducible", "rangesfm", "pycolmap")


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

    @property
    def num_busy_cores(self) -> float:
        return self.processor_s / self.clock_s


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


def match_anew(photos: Path, names: Sequence[str], database: Path, num_processes: int, seed: int) -> Effort:
    """Match the photos anew, and return the effort of matching alone."""
    clear_matches(database)
    options = matching_options(MapperOptions(matching="sequential", num_threads=num_processes), len(names), seed)
    usable, space = usable_photos(photos, names), Workspace(database.parent, Progress())
    with space.logged():
        return effort_of(lambda: match_features(space, usable, options))


@dataclass(frozen=True)
class Mapped:
    """One mapping from given matches.

    Attributes:
        caller_s: processor seconds of the thread that called the mapper.
        content: hash of all models.
    """

    effort: Effort
    caller_s: float
    content: str


def map_anew(photos: Path, database: Path, way: str, num_threads: int, seed: int) -> Mapped:
    """Map the photos from their matches in one of ``WAYS``, from the same seed."""
    models: list[pycolmap.Reconstruction] = []
    mapper = MapperOptions(num_threads=num_threads, reproducible=way == WAYS[0])
    ours = pipeline_options(CameraOptions(), mapper, seed)
    assert isinstance(ours, pycolmap.IncrementalPipelineOptions)
    theirs = pycolmap.IncrementalPipelineOptions(num_threads=num_threads, random_seed=seed)
    with tempfile.TemporaryDirectory() as scratch, colmap_log(Path(scratch) / "mapper.log"):

        def work() -> None:
            if way != WAYS[2]:
                models.extend(incremental_mapping(database, photos, options=ours))
            else:
                models.extend(pycolmap.incremental_mapping(database, photos, scratch, theirs).values())

        begin_s = time.thread_time()
        effort = effort_of(work)
        caller_s, content = time.thread_time() - begin_s, hashlib.sha256()
        for model in models:
            model.write_binary(scratch)
            for name in ("cameras.bin", "images.bin", "points3D.bin"):
                content.update((Path(scratch) / name).read_bytes())
    return Mapped(effort, caller_s, content.hexdigest())


def compare_mappings(photos: Path, database: Path, num_threads: int, num_rounds: int, seed: int) -> None:
    found: list[list[Mapped]] = [[] for _ in WAYS]
    for _ in range(num_rounds):
        for of_way, way in zip(found, WAYS, strict=True):
            of_way.append(map_anew(photos, database, way, num_threads, seed))
    print(f"{'mapping alone':25}{'clock':>9} {'processors':>10} {'caller':>9}   models ({load()})")
    for of_way, way in zip(found, WAYS, strict=True):
        clock_s = median(one.effort.clock_s for one in of_way)
        processor_s, caller_s = median(one.effort.processor_s for one in of_way), median(one.caller_s for one in of_way)
        line = f"{way:25}{clock_s:8.1f}s {processor_s:9.1f}s {caller_s:8.1f}s"
        print(f"{line}   {len({one.content for one in of_way})} of {num_rounds}", flush=True)


@contextmanager
def on_cores(num: int) -> Iterator[None]:
    """Restrict this thread, and the processes that it starts, to this number of cores."""
    cores = os.sched_getaffinity(0)
    os.sched_setaffinity(0, sorted(cores)[:num])
    try:
        yield
    finally:
        os.sched_setaffinity(0, cores)


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


def compare_processes(
    photos: Path, names: Sequence[str], features: Path, num_threads: int, num_rounds: int, seed: int
) -> None:
    all_cores = len(os.sched_getaffinity(0))
    ways = [(1, 1), (1, all_cores), (num_threads, all_cores), (2 * num_threads, all_cores)]
    spaces = [features.with_name(str(k)) for k in range(len(ways))]
    for space in spaces:
        space.mkdir()
    databases = [Path(shutil.copy(features, space / "database.db")) for space in spaces]
    efforts: list[list[Effort]] = [[] for _ in ways]
    for _ in range(num_rounds):
        for of_way, database, (num_processes, num_cores) in zip(efforts, databases, ways, strict=True):
            with on_cores(num_cores):
                of_way.append(match_anew(photos, names, database, num_processes, seed))
    print(f"{'matching alone':32}{'clock':>9} {'processors':>10} {'busy':>5}   times as fast as the first ({load()})")
    first = [effort.clock_s for effort in efforts[0]]
    for (num_processes, num_cores), of_way in zip(ways, efforts, strict=True):
        clock_s, processor_s, busy = (
            median(getattr(effort, of) for effort in of_way) for of in ("clock_s", "processor_s", "num_busy_cores")
        )
        line = f"processes: {num_processes}, on cores: {num_cores:<9} {clock_s:8.1f}s {processor_s:9.1f}s {busy:5.2f}"
        print(f"{line}   {ratio(first, [effort.clock_s for effort in of_way])}", flush=True)
    several, one = ([effort.clock_s for effort in efforts[k]] for k in (2, 1))
    contents = [content_of(database) for database in databases]
    print(
        f"{num_threads} processes beside one, all cores for both: {ratio(one, several)} times as fast; matches"
        f" {'the same' if all(content == contents[0] for content in contents) else 'NOT THE SAME'}"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("photos", nargs="+", help="a folder, perhaps with :N for every Nth of its photos; or a survey")
    parser.add_argument("--base_path", help="of the surveys (default: their folders)")
    parser.add_argument("--num_threads", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--num_rounds", type=int, default=3)
    parser.add_argument("--camera_model")
    parser.add_argument("--camera_params", type=lambda text: tuple(map(float, text.split(","))))
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", choices=("stages", "matching", "mapping"), help="one table (default: all)")
    arguments = parser.parse_args()
    camera = CameraOptions(model=arguments.camera_model, params=arguments.camera_params)
    num, seed = arguments.num_threads, arguments.seed
    for given in arguments.photos:
        if given.endswith(".toml"):
            print(f"\n{given}:", flush=True)
            compare_with_metric_map(read_survey(given, None, arguments.base_path), num, arguments.num_rounds, seed)
            continue
        folder, _, every_nth = given.partition(":")
        photos = Path(folder)
        names = list_images(photos)[:: int(every_nth or 1)]
        print(f"\n{photos}: {len(names)} photos, {num} threads, {load()}", flush=True)
        tables = [arguments.only] if arguments.only else ["stages", "matching", "mapping"]
        programs = (by_pycolmap, by_rangesfm) if "stages" in tables else (by_rangesfm,)
        efforts: dict[Any, list[list[Effort]]] = {run: [] for run in programs}
        with tempfile.TemporaryDirectory() as scratch:
            for number in range(arguments.num_rounds if "stages" in tables else 1):
                for run, found in efforts.items():
                    output = Path(scratch) / f"{run.__name__}{number}"
                    output.mkdir()
                    found.append(run(photos, names, output, camera, num, seed))
            database = Path(scratch) / "by_rangesfm0" / "database.db"
            if "stages" in tables:
                compare_stages(*(efforts[run] for run in programs))
            if "matching" in tables:
                compare_processes(photos, names, database, num, arguments.num_rounds, seed)
            if "mapping" in tables:
                compare_mappings(photos, database, num, arguments.num_rounds, seed)


if __name__ == "__main__":
    main()
