"""Imports run one way, from folder to folder, and stages do not import each other."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

import rangesfm

PACKAGE = Path(rangesfm.__file__).parent

# The rooms, from the bottom to the top. A room imports from itself and from the rooms in lines above its own, so that
# stages do not know each other. Files at the root are below all rooms, except for the public modules (DOORS), which may
# import from anywhere.
LAYERS = (
    "util",
    "colmap",
    "solver",
    "measurements",
    "estimation",
    "sfm export",
    "survey",
    "diagnostics",
    "planning",
    "result",
    "report",
    "comparison",
    "pipeline",
    "batch",
    "demo",
    "cli",
)
LAYER_OF = {folder: number for number, folders in enumerate(LAYERS) for folder in folders.split()}
DOORS = {"__init__", "__main__", "costs"}
ROOT = -1
MAX_NUM_FILES_AT_ROOT = 10

# What only reads a folder of results, and the folders that it must not need.
READS_RESULTS = (
    *("result.result_folder", "report", "comparison.before_after", "comparison.many_models"),
    *("batch.run_batch", "pipeline.measure", "pipeline.export_result"),
)
ESTIMATORS = ("estimation", "sfm.loops", "planning")
MAX_NUM_OF_COMPARE, MAX_NUM_OF_REFINE = 25, 60

MODULES = {
    ".".join(path.relative_to(PACKAGE).with_suffix("").parts).removesuffix(".__init__"): path
    for path in sorted(PACKAGE.rglob("*.py"))
}

OF_SENSOR = (
    *("inertial_motions", "inertial_fit", "inertial_scale", "motion", "planned_sensor", "preintegration"),
    "sensor_prior",
)
OF_FIT = ("cost", "gravity", "radio")
ON_MAP = ("range_scale", "range_start", "length_scale", "position_scale")
# Modules that say how a kind is measured. Others in the folder of a kind hold what was read.
KINDS = {
    name
    for name in MODULES
    if name.startswith("measurements.") and name.split(".")[-1] in (*OF_FIT, *ON_MAP, *OF_SENSOR)
}


def folder_of(module: str) -> str:
    """Return the room of a module, or the module's name at the root."""
    return module.partition(".")[0]


def layer(module: str) -> int:
    return LAYER_OF.get(folder_of(module), ROOT)


def imports(path: Path) -> set[str]:
    """Return the full names of all modules that a file imports, at any place in it."""
    found: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}:{node.lineno}: a relative import"
            # In `from package import name`, either of the two may be the module.
            found.add(str(node.module))
            found.update(f"{node.module}.{alias.name}" for alias in node.names)
    return found


def own_imports(module: str) -> set[str]:
    """Return the names of this package's modules that a module imports."""
    return {name.removeprefix("rangesfm.") for name in imports(MODULES[module])} & MODULES.keys()


def test_a_module_imports_only_from_its_own_folder_and_from_layers_below() -> None:
    wrong = [
        (module, name)
        for module in MODULES.keys() - DOORS
        for name in own_imports(module)
        if folder_of(name) != folder_of(module) and layer(name) >= layer(module) and layer(module) != ROOT
    ]
    assert not wrong


def test_what_stands_at_the_root_imports_no_folder() -> None:
    at_root = [module for module in MODULES.keys() - DOORS if layer(module) == ROOT]
    assert not [(module, name) for module in at_root for name in own_imports(module) if layer(name) != ROOT]


def test_settings_are_values_that_need_no_reader_and_no_disk() -> None:
    imported = own_imports("survey.settings")
    assert imported
    assert [name for name in imported if layer(name) != ROOT] == []


def test_the_root_holds_few_files_and_every_folder_has_its_layer() -> None:
    assert len(list(PACKAGE.glob("*.py"))) <= MAX_NUM_FILES_AT_ROOT
    folders = {folder_of(module) for module, path in MODULES.items() if path.parent != PACKAGE}
    assert folders == LAYER_OF.keys()


def test_only_one_package_touches_the_compiled_part_and_pyceres() -> None:
    touching = [
        module
        for module, path in MODULES.items()
        if any(f"{name}.".startswith(("rangesfm._cpp.", "pyceres.")) for name in imports(path))
    ]
    assert touching, "not even the package that is there for it"
    assert all(module.split(".")[0] == "solver" for module in touching)


def reached(module: str) -> set[str]:
    """Return all modules of the package that importing one of them loads."""
    found, waiting = set[str](), [module]
    while waiting:
        name = waiting.pop()
        if name not in found:
            found.add(name)
            waiting += own_imports(name)
    return found


@pytest.mark.parametrize("module", [*READS_RESULTS])
def test_what_only_reads_results_loads_no_estimator(module: str) -> None:
    assert not [name for name in reached(module) if name.startswith(ESTIMATORS) or name in KINDS]


def test_few_modules_are_loaded_to_compare_paths_and_none_that_reads_logs_to_refine() -> None:
    assert len(reached("comparison.with_reference")) <= MAX_NUM_OF_COMPARE
    refines = reached("estimation.with_ranges")
    assert len(refines) <= MAX_NUM_OF_REFINE
    assert not [name for name in refines if name.startswith("measurements.ranges.readers")]


def test_only_the_table_of_kinds_names_a_kind_of_measurement() -> None:
    """Whoever adds a kind writes its module or folder and its line in the table; no stage has to know of it."""
    assert {f"measurements.{kind}.cost" for kind in ("ranges", "lengths", "positions")} <= KINDS
    knowing = {(module, name) for module in MODULES.keys() - KINDS for name in own_imports(module) & KINDS}
    # The public functions of ranges, and plans, which make measurements instead of locating them.
    of_ranges = {"estimation.scale.initialize", "estimation.with_ranges"}
    of_one_kind = {name for name in MODULES if name.startswith(("measurements.ranges.", "measurements.positions."))}
    plans = {"planning.planned_kinds", "planning.planned_ranges"}
    assert {module for module, _ in knowing} <= {"survey.kinds_in_map", *plans, *of_ranges, *of_one_kind}
    logs = {"measurements.ranges.radio"}  # several kinds are in one log
    others = {(module, name) for module in KINDS - logs for name in own_imports(module) & KINDS}
    assert not {(module, name) for module, name in others if module.split(".")[1] != name.split(".")[1]}
