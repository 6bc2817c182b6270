"""Put small mistakes into the estimation packages, and count how many their tests notice.

    pip install cosmic-ray pytest-cov
    python -m tests.studies.mutants --num 60 --seed 0 [--first 31] [--keep seen]

Draws mutants (another operator, a number one off, a negated condition, ...) at random from the packages, and puts each
into a copy of the checkout. Its judges are the tests that run its line, and then the others of their files in the
folder of its package, as these may use what was made once for all; quick ones first, of four minutes in all. (A
constant is run where it is read, and the head of a function or class, by what runs any line of it.) A mutant that all
of these pass has survived. Which test runs which line, and how long it takes, is measured once, before anything is
changed; ``--keep`` names a folder for that. Results of small surveys that are compared with a file of numbers have no
say, nor do tests of pages.
Type hints, ``frozen=True`` and ``strict=True`` are not changed: no run depends on them unless it is wrong already.
"""

from __future__ import annotations

import argparse
import importlib.util
import os
import random
import shutil
import subprocess
import sys
import sysconfig
import tempfile
import time
import venv
from pathlib import Path
from typing import Any, NamedTuple

from tests.studies.tests_of_lines import PYTEST, TESTS, TestsOfLines

PACKAGE = Path("plugin/rangesfm")
PACKAGES = ("scale", "refine", "ranging/errors", "ranging/anchors", "ranging/clock", "diagnostics", "ceres")
MAX_SECONDS = 1200
# Operators that are left out: they only apply to type hints, change nothing that runs, or (those of variables) need
# names.
LEFT_OUT = ("BitOr", "RemoveDecorator", "ExceptionReplacer", "BitAnd", "Variable")


class Mutant(NamedTuple):
    """One change of one file: an operator of Cosmic Ray, and the number of the place where it is applied."""

    path: Path
    operator: str
    occurrence: int


def mutants_of(path: Path) -> list[tuple[Mutant, int]]:
    """List all mutants of a file, with the line of each."""
    from cosmic_ray.ast import ast_nodes, get_ast_from_path
    from cosmic_ray.plugins import get_operator, operator_names

    nodes = list(ast_nodes(get_ast_from_path(path)))
    lines = path.read_text().split("\n")
    found = []
    for name in operator_names():
        if any(word in name for word in LEFT_OUT):
            continue
        operator: Any = get_operator(name)()
        places = [start[0] for node in nodes for start, _ in operator.mutation_positions(node)]
        left = ("frozen=True", "strict=True") if name.endswith("ReplaceTrueWithFalse") else ()
        kept = [(k, line) for k, line in enumerate(places) if not any(word in lines[line - 1] for word in left)]
        found += [(Mutant(path, name, k), line) for k, line in kept]
    return found


def checkout_of(folder: Path) -> tuple[Path, Path]:
    """Copy what is mutated and what judges it into a folder, and return the copy and a Python that imports from it.

    An editable installation finds the package before any path is looked at, and a copy lacks the compiled part. So the
    copy is given that part, and an environment whose path names the installed packages without what they install there.
    """
    copy, environment = folder / "checkout", folder / "environment"
    for part in ("plugin", "tests", "examples", "cpp_ext"):
        shutil.copytree(part, copy / part)
    shutil.copy("pyproject.toml", copy)
    compiled = importlib.util.find_spec("rangesfm._cpp")
    assert compiled is not None
    assert compiled.origin is not None
    shutil.copy(compiled.origin, copy / PACKAGE)
    venv.create(environment)
    paths = sysconfig.get_paths(vars={"base": str(environment), "platbase": str(environment)})
    text = "\n".join([str(copy / "plugin"), sysconfig.get_path("purelib")])
    (Path(paths["purelib"]) / "others.pth").write_text(text + "\n", encoding="utf-8")
    python = Path(paths["scripts"]) / "python"
    command = [str(python), "-c", "import rangesfm; print(rangesfm.__file__)"]
    imported = subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()
    if not Path(imported).is_relative_to(copy):
        sys.exit(f"rangesfm is imported from {imported}, expected from {copy}: no change would be noticed")
    # This leaves compiled files, which are not written later: two changes of a file within a second would look alike.
    subprocess.run([str(python), *PYTEST, "--collect-only", *TESTS], cwd=copy, capture_output=True, check=True)
    return copy, python


def survives(mutant: Mutant, copy: Path, python: Path, judges: list[list[str]]) -> tuple[bool, str]:
    """Return whether every test passes, and the change as a diff."""
    from cosmic_ray.mutating import use_mutation
    from cosmic_ray.plugins import get_operator

    environment = {**os.environ, "PYTHONDONTWRITEBYTECODE": "1"}
    with use_mutation(copy / mutant.path, get_operator(mutant.operator)(), mutant.occurrence) as (before, after):
        old, new = before.split("\n"), (after or before).split("\n")
        changed = "; ".join(f"{a.strip()} -> {b.strip()}" for a, b in zip(old, new, strict=False) if a != b)
        for tests in judges:
            command = [str(python), *PYTEST, "-x", "-p", "no:hypothesispytest", *tests]
            try:
                done = subprocess.run(command, cwd=copy, env=environment, capture_output=True, timeout=MAX_SECONDS)
            except subprocess.TimeoutExpired:
                return False, changed
            if done.returncode != 0:
                return False, changed
    return True, changed


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--num", type=int, default=60)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--first", type=int, default=1, help="of those drawn, to go on where a run was cut")
    parser.add_argument("--keep", type=Path, help="folder for what tests run, which is used again")
    args = parser.parse_args()
    files = sorted(path for package in PACKAGES for path in (PACKAGE / package).glob("*.py") if path.stem != "__init__")
    # Each place counts once, however many changes it allows.
    choices: dict[tuple[Path, int, str], list[Mutant]] = {}
    for path in files:
        for mutant, line in mutants_of(path):
            choices.setdefault((path, line, mutant.operator.split("_")[0]), []).append(mutant)
    rng = random.Random(args.seed)
    places = rng.sample(sorted(choices), args.num)
    drawn = [(rng.choice(choices[place]), place[1]) for place in places]
    survivors, left = 0, list(enumerate(drawn, 1))[args.first - 1 :]
    with tempfile.TemporaryDirectory(prefix="mutants_") as folder:
        copy, python = checkout_of(Path(folder))
        tests_of = TestsOfLines.measured(copy, python, (args.keep or Path(folder)).absolute())
        for num, (mutant, line) in left:
            begun = time.monotonic()
            judges = tests_of.judges(mutant.path.relative_to(PACKAGE), line)
            survived, changed = survives(mutant, copy, python, judges)
            survivors += survived
            word = "SURVIVED" if survived else "noticed"
            print(f"{num:3d} {word} {mutant.path}:{line} {changed} ({time.monotonic() - begun:.0f} s)", flush=True)
    share = f"{100 * survivors / len(left):.0f} %"
    print(f"{survivors} of {len(left)} mutants survived ({share}), drawn from {len(choices)} places, seed {args.seed}")


if __name__ == "__main__":
    main()
