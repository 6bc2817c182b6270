"""Coverage-guided fuzzing of all readers of files with atheris; prints a table of what was tried and found.

    python -m pip install atheris
    python -m tests.fuzz.readers --runs 40000 --output_path /tmp/fuzz

With 40 000 runs for each of the targets (``tests/fuzz/targets.py``) it takes about an hour on one core. The output
folder holds the input and the traceback of each different failure. A run that takes more than 3 s of processor time, or
48 MB more than all before it, is a failure too; one that hangs for 300 s is killed.
"""

from __future__ import annotations

import argparse
import json
import random
import subprocess
import sys
import tempfile
import time
import traceback
import warnings
from collections import Counter
from pathlib import Path

from tests.peak_memory import peak_bytes

CORPUS = Path(__file__).parent / "corpus"
PLUGIN = Path(__file__).parents[2] / "plugin"
MAX_LENGTH = 4096
TIMEOUT_S = 300
MAX_PROCESSOR_TIME_S = 3.0
# what one run may take beyond all before it: room for chance, and for modules that are imported late
_MEMORY_BYTES = 48 << 20
_SAVE_EVERY = 250


class BoundError(Exception):
    """A small input took a lot of memory or time."""


class Campaign:
    """All runs of one target in this process."""

    def __init__(self, name: str, output_path: Path):
        from tests.fuzz.targets import TARGETS

        self._target = next(target for target in TARGETS if target.name == name)
        self.mutate = self._target.mutate
        self._output_path = output_path
        self._folder = tempfile.TemporaryDirectory(prefix="fuzz_")
        self._counts: Counter[str] = Counter()
        self._found: set[str] = set()

    def run(self, data: bytes) -> None:
        """Try one input; a failure is written to a file, and the campaign continues."""
        self._counts["runs"] += 1
        before, start_s = peak_bytes(), time.process_time()
        try:
            self._counts["accepted"] += self._target.run(data, Path(self._folder.name))
            taken_bytes, taken_s = peak_bytes() - before, time.process_time() - start_s
            if self._counts["runs"] > 1 and (taken_bytes > _MEMORY_BYTES or taken_s > MAX_PROCESSOR_TIME_S):
                raise BoundError(f"{taken_bytes >> 20} MB and {taken_s:.1f} s for {len(data)} bytes")
        except Exception as error:
            self._keep(data, error)
        if self._counts["runs"] % _SAVE_EVERY == 0:
            self.save()

    def save(self) -> None:
        (self._output_path / "counts.json").write_text(json.dumps(self._counts))

    def _keep(self, data: bytes, error: Exception) -> None:
        frame = traceback.extract_tb(error.__traceback__)[-1]
        key = f"{type(error).__name__}_{Path(frame.filename).stem}_{frame.lineno}"
        self._counts["silent acceptances" if "Silent" in key else "failures"] += key not in self._found
        if key not in self._found:
            self._found.add(key)
            (self._output_path / f"{key}.input").write_bytes(data)
            (self._output_path / f"{key}.txt").write_text("".join(traceback.format_exception(error)))
            self.save()


def fuzz_one(name: str, runs: int, seed: int, output_path: Path) -> None:
    """Fuzz one target. Does not return: libFuzzer ends the process."""
    import atheris

    # The finder of an editable installation would load rangesfm without atheris's instrumentation.
    sys.meta_path = [finder for finder in sys.meta_path if isinstance(finder, type)]
    sys.path.insert(0, str(PLUGIN))
    warnings.simplefilter("error")  # a user would see warnings among the messages
    with atheris.instrument_imports(include=["rangesfm"]):
        campaign = Campaign(name, output_path)

    def mutate(data: bytes, max_size: int, mutation_seed: int) -> bytes:
        rng = random.Random(mutation_seed)
        if rng.random() < 0.3:
            return bytes(atheris.Mutate(data, max_size))
        return campaign.mutate(data, rng, max_size)

    corpus = output_path / "corpus"
    corpus.mkdir(exist_ok=True)
    for path in (CORPUS / name).iterdir():
        (corpus / path.name).write_bytes(path.read_bytes())
    options = (f"-runs={runs}", f"-seed={seed}", f"-max_len={max(MAX_LENGTH, 2 * _longest(corpus))}")
    limits = (f"-timeout={TIMEOUT_S}", "-rss_limit_mb=2048", f"-artifact_prefix={output_path}/killed_")
    atheris.Setup([sys.argv[0], str(corpus), *options, *limits], campaign.run, custom_mutator=mutate)
    atheris.Fuzz()


def _longest(folder: Path) -> int:
    return max(path.stat().st_size for path in folder.iterdir())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=2000, help="inputs for each target")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--targets", nargs="+", default=sorted(path.name for path in CORPUS.iterdir()))
    parser.add_argument("--output_path", type=Path, required=True)
    parser.add_argument("--one", action="store_true", help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.one:
        fuzz_one(args.targets[0], args.runs, args.seed, args.output_path)
    print("| target | inputs | accepted | failures | silent acceptances | killed (time, memory, crash) |")
    print("|---|---|---|---|---|---|")
    for name in args.targets:
        folder = args.output_path / name
        folder.mkdir(parents=True, exist_ok=True)
        command = [sys.executable, "-m", "tests.fuzz.readers", "--one", "--targets", name]
        options = ("--runs", str(args.runs), "--seed", str(args.seed), "--output_path", str(folder))
        done = subprocess.run([*command, *options], capture_output=True, text=True, errors="replace")
        (folder / "log.txt").write_text(done.stderr)
        counts = Counter(json.loads((folder / "counts.json").read_text()))
        killed = len(list(folder.glob("killed_*"))) or int(done.returncode != 0)
        cells = [counts[key] for key in ("runs", "accepted", "failures", "silent acceptances")]
        print("|", " | ".join(map(str, [name, *cells, killed])), "|", flush=True)


if __name__ == "__main__":
    main()
