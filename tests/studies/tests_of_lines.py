"""Finding of the tests that run a line of the package, and of how long each takes, by running all of them once."""

from __future__ import annotations

import ast
import subprocess
from collections.abc import Iterable, Iterator
from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np

NAMES = """
    ceres cli comparison diagnostics distances geometry join loops planning positions ranging refine scale survey
    survey_discovery workflows test_numbers.py test_same_everywhere.py
"""
TESTS = tuple(f"tests/{name}" for name in NAMES.split())
# Largest sum of the times of the tests that judge one line: some lines are run by most tests.
MAX_SECONDS = 240.0
PYTEST = ("-m", "pytest", "-q", "-p", "no:cacheprovider", "-m", "slow or not slow")


class TestsOfLines:
    """The tests that run each line.

    Attributes:
        statements: of each file, by its path in the package.
        runs: names of the tests that run a line, by path and line.
        every: names of all tests. seconds: that a test takes, by its name.
    """

    def __init__(self, checkout: Path, folder: Path) -> None:
        from coverage import CoverageData

        package = checkout / "plugin" / "rangesfm"
        data = CoverageData(str(folder / "coverage"))
        data.read()
        self.statements: dict[Path, _Statements] = {}
        self.runs: dict[Path, dict[int, set[str]]] = {}
        for name in data.measured_files():
            path = Path(name.rsplit("/rangesfm/", 1)[1])
            self.statements[path] = _Statements((package / path).read_text(encoding="utf-8"))
            by_line = data.contexts_by_lineno(name)
            # A context is the name of a test with "|run" or, for fixtures, "|setup"; at the import it is empty.
            self.runs[path] = {line: {each.rsplit("|", 1)[0] for each in by_line[line] if each} for line in by_line}
        self.every = set().union(*(tests for by_line in self.runs.values() for tests in by_line.values()))
        self.seconds = dict(_seconds(folder / "tests.xml"))

    @classmethod
    def measured(cls, checkout: Path, python: Path, folder: Path) -> TestsOfLines:
        """Run all tests once, unless the folder has what was measured before, and return what each runs."""
        settings, times = folder / "settings", folder / "tests.xml"
        if not times.exists():
            folder.mkdir(exist_ok=True)
            settings.write_text(f"[run]\nsource = rangesfm\ndata_file = {folder / 'coverage'}\n", encoding="utf-8")
            options = [f"--cov-config={settings}", "--cov=rangesfm", "--cov-context=test", "--cov-report=", "-n", "2"]
            subprocess.run([str(python), *PYTEST, *options, f"--junitxml={times}", *TESTS], cwd=checkout, check=True)
        return cls(checkout, folder)

    def judges(self, path: Path, line: int) -> list[list[str]]:
        """Return the tests that judge a line, in two sets, the quickest first, as far as there is time for them.

        After those that run the line come the others of these files in the mirrored folder, as a test may use what was
        made once for all.
        """
        running = self._running(path, line)
        mirrored = f"tests/{path.parent.as_posix()}/"
        files = {name for name in (test.split("::")[0] for test in running) if name.startswith(mirrored)}
        others = {test for test in self.every if test.split("::")[0] in files} - running
        ordered = [*self._quick_first(running), *self._quick_first(others)]
        ends = np.cumsum([self.seconds.get(test, 0.0) for test in ordered])
        within = ordered[: int(np.searchsorted(ends, MAX_SECONDS))]
        first = int(np.searchsorted(ends, MAX_SECONDS / 20))
        return [tests for tests in (within[:first], within[first:]) if tests]

    def _quick_first(self, tests: Iterable[str]) -> list[str]:
        return sorted(tests, key=lambda test: (self.seconds.get(test, 0.0), test))

    def _running(self, path: Path, line: int) -> set[str]:
        statements = self.statements[path]
        running = self._of(path, statements.own_lines(line))
        if running:
            return running
        # It is run at the import: a constant matters where it is read, and a head or a field to its function or class.
        constants = statements.constants(line)
        if not constants:
            return self._of(path, statements.body(line))
        for other, there in self.statements.items():
            for reading in there.reading(constants):
                if not constants & there.constants(reading):
                    running |= self._running(other, reading)
        return running

    def _of(self, path: Path, lines: Iterable[int]) -> set[str]:
        return set().union(*(self.runs[path].get(line, set()) for line in lines))


class _Statements:
    """The statements of a file."""

    def __init__(self, text: str) -> None:
        self.tree = ast.parse(text)
        self.around = {child: node for node in ast.walk(self.tree) for child in ast.iter_child_nodes(node)}

    def at(self, line: int) -> ast.stmt:
        """Return the innermost statement at a line."""
        here = [node for node in ast.walk(self.tree) if isinstance(node, ast.stmt) and line in _lines(node)]
        return min(here, key=lambda node: len(_lines(node)))

    def own_lines(self, line: int) -> range:
        """Return the lines of the statement at a line, up to the first statement in it."""
        lines = _lines(self.at(line))
        inner = [_lines(node).start for node in ast.walk(self.at(line)) if isinstance(node, ast.stmt)]
        return range(lines.start, min([lines.stop, *(start for start in inner if start > line)]))

    def constants(self, line: int) -> set[str]:
        """Return the names that are assigned at a line outside any function or class."""
        statement = self.at(line)
        if self.around[statement] is not self.tree or not isinstance(statement, ast.Assign | ast.AnnAssign):
            return set()
        targets = statement.targets if isinstance(statement, ast.Assign) else [statement.target]
        return {node.id for target in targets for node in ast.walk(target) if isinstance(node, ast.Name)}

    def reading(self, names: set[str]) -> set[int]:
        """Return the lines that read one of these names."""
        read = [node for node in ast.walk(self.tree) if isinstance(getattr(node, "ctx", None), ast.Load)]
        named = [(getattr(node, "id", None) or getattr(node, "attr", None), node) for node in read]
        return {node.lineno for name, node in named if name in names and isinstance(node, ast.expr)}

    def body(self, line: int) -> range:
        """Return the lines of the function or class whose head or field is at a line."""
        node: ast.AST = self.at(line)
        while not isinstance(node, ast.FunctionDef | ast.ClassDef | ast.Module):
            node = self.around[node]
        return range(0) if isinstance(node, ast.Module) else _lines(node)


def _seconds(times: Path) -> Iterator[tuple[str, float]]:
    """Yield name and time of each test in a JUnit file."""
    for case in ET.parse(times).iter("testcase"):
        parts = case.get("classname", "").split(".")
        end = next(k for k, part in enumerate(parts, 1) if part.startswith("test_"))
        test = "::".join(["/".join(parts[:end]) + ".py", *parts[end:], case.get("name", "")])
        yield test, float(case.get("time", 0.0))


def _lines(node: ast.stmt) -> range:
    decorators: list[ast.expr] = getattr(node, "decorator_list", [])
    return range(min([node.lineno, *(each.lineno for each in decorators)]), (node.end_lineno or node.lineno) + 1)
