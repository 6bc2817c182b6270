"""COLMAP's work beside the main thread: in a thread that Ctrl-C can end, or in a process of its own.

When the disk is full, a library that writes from its own thread ends the whole process. So features, shares of the
matching, and mappers that take all photos are left to child processes, whose end is noticed.
``rangesfm.util.processes.supervision`` calls these functions there, with a listener to their progress as the last
argument. This module imports little, so that a process starts fast.
"""

from __future__ import annotations

import subprocess
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from pathlib import Path
from typing import TypeVar

import pycolmap

from rangesfm.colmap.glog import logging_into
from rangesfm.errors import ReconstructionError
from rangesfm.progress import Progress
from rangesfm.util.processes.supervision import POLL_INTERVAL_S, end_group_with_parent

Result = TypeVar("Result")


def run_in_background(
    work: Callable[[pycolmap.CancellationToken], Result],
    progress: Progress,
    count: Callable[[], int],
    num_total: int,
) -> Result:
    """Run ``work`` in a thread and report its progress meanwhile.

    Python notices Ctrl-C in the main thread only, and only between its own instructions, so that a call into COLMAP in
    the main thread would delay it for minutes. An exception that interrupts the waiting cancels the work, and is raised
    once the work has ended.

    Args:
        work: passes the token on to COLMAP. If its calls do not release Python's global lock, Ctrl-C and progress are
            handled only when they call back.
        count: returns how many of ``num_total`` items are done; it may exceed them.

    Raises:
        ReconstructionError: COLMAP raised an error of its own.
    """
    token = pycolmap.CancellationToken()
    with ThreadPoolExecutor(max_workers=1, thread_name_prefix="colmap") as executor:
        # After a Ctrl-C while the thread starts, nothing would wait for it. So it starts with a task that does nothing.
        executor.submit(int).result()
        try:
            future = executor.submit(work, token)
            while not wait([future], timeout=POLL_INTERVAL_S).done:
                progress.update(min(count(), num_total), num_total)
        except BaseException as error:
            token.cancel()
            if isinstance(error, KeyboardInterrupt):
                progress.message("interrupted: COLMAP finishes its current photos")
            raise
    try:
        result = future.result()
    except (RuntimeError, ValueError) as error:
        raise ReconstructionError("COLMAP stopped: " + " ".join(str(error).split())) from error
    progress.update(min(count(), num_total), num_total)
    return result


WholePipelineOptions = pycolmap.GlobalPipelineOptions | pycolmap.HierarchicalPipelineOptions
# Largest number of features that COLMAP keeps in memory, each with its index some 700 bytes. Features that it drops are
# read and indexed again when needed.
_MAX_NUM_FEATURES = 400_000


def find_features(
    database_path: Path,
    image_path: Path,
    image_names: Sequence[str],
    mask_path: Path | None,
    options: pycolmap.FeatureExtractionOptions,
    log_folder: Path,
    _: Progress,
) -> int:
    """Find features in photos of a database, except where their masks, if there are any, are black.

    Returns the number of photos. The progress is to be read from the database.
    """
    reader = pycolmap.ImageReaderOptions()
    if mask_path is not None:
        reader.mask_path = mask_path
    with logging_into(log_folder):
        pycolmap.extract_features(
            database_path,
            image_path,
            image_names=list(image_names),
            reader_options=reader,
            extraction_options=options,
            device=_device_of(options),
        )
    return len(image_names)


def match_share(
    database_path: Path,
    pairs: Sequence[tuple[int, int]],
    matcher: pycolmap.FeatureMatchingOptions,
    verification: pycolmap.TwoViewGeometryOptions,
    log_folder: Path,
    progress: Progress,
) -> int:
    """Match pairs of photos of a database in which each photo is named by its id; return the number of pairs."""
    pairing = pycolmap.ImportedPairingOptions()
    pairing.match_list_path = database_path.with_suffix(".txt")
    pairing.match_list_path.write_text("".join(f"{first} {second}\n" for first, second in pairs))
    with logging_into(log_folder), pycolmap.Database.open(database_path) as database:
        # Number of pairs after which COLMAP writes its matches; it also keeps this many photos in memory.
        pairing.block_size = max(1, _MAX_NUM_FEATURES * database.num_images() // (1 + database.num_descriptors()))
        run_in_background(
            lambda token: pycolmap.match_image_pairs(
                database_path,
                matcher,
                pairing,
                verification,
                device=_device_of(matcher),
                cancellation_token=token,
            ),
            progress,
            database.num_verified_image_pairs,
            len(pairs),
        )
    return len(pairs)


def _device_of(options: pycolmap.FeatureExtractionOptions | pycolmap.FeatureMatchingOptions) -> pycolmap.Device:
    """Return the device that the options ask for; by default COLMAP uses a GPU if there is one, whatever they say."""
    return pycolmap.Device.cuda if options.use_gpu else pycolmap.Device.cpu


def map_at_once(
    database_path: Path, image_path: Path, options: WholePipelineOptions, log_folder: Path, _: Progress
) -> int:
    """Map all photos at once, write the models beside the database, and return their number.

    It reports no progress.
    """
    with logging_into(log_folder):
        if isinstance(options, pycolmap.GlobalPipelineOptions):
            return len(pycolmap.global_mapping(database_path, image_path, database_path.parent, options))
        return len(pycolmap.hierarchical_mapping(database_path, image_path, database_path.parent, options))


def run_program(words: Sequence[str], folder: Path, environment: Mapping[str, str], log: Path, _: Progress) -> int:
    """Run a program in a folder until it ends, write all that it prints to ``log``, and return its exit status."""
    end_group_with_parent()
    with log.open("wb") as printed:
        return subprocess.run(
            words,
            cwd=folder,
            env=environment,
            stdin=subprocess.DEVNULL,
            stdout=printed,
            stderr=subprocess.STDOUT,
            check=False,
        ).returncode
