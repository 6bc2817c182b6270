"""Imports run one way: errors, data and readers, stages, pipeline, command line; and no stage knows another."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import rangesfm

PACKAGE = Path(rangesfm.__file__).parent

# By module or by package; the most exact name counts. What is not named is part of the pipeline: nothing below it may
# import it.
ERRORS, DATA, STAGE, PIPELINE, COMMAND_LINE = range(5)
LAYER_OF = {
    "__init__": ERRORS,
    "errors": ERRORS,
    "failures": ERRORS,
    "progress": ERRORS,
    "files": ERRORS,
    "installed_versions": ERRORS,
    "sole_writer": ERRORS,
    "_ceres": DATA,
    "child_process": ERRORS,
    "supervision": ERRORS,
    "colmap_log": DATA,
    "config": DATA,
    "costs": DATA,
    "covariance": DATA,
    "demo": DATA,
    "distances": DATA,
    "geometry": DATA,
    "georeference": DATA,
    "gravity": DATA,
    "json_files": DATA,
    "joined_model": DATA,
    "linear_solver": DATA,
    "model_files": DATA,
    "model_records": DATA,
    "options": DATA,
    "passthrough": DATA,
    "ranging": DATA,
    "reference": DATA,
    "model_transform": DATA,
    # What the stage ``refine`` is made of.
    "refinement": DATA,
    "result_folder": DATA,
    "site": DATA,
    "strict_tables": DATA,
    "plain_tables": DATA,
    "tables": DATA,
    "trajectory": DATA,
    "comparison": STAGE,
    "export": STAGE,
    "ranging.association": STAGE,
    "ranging.clock": STAGE,
    "ranging.clock_bursts": STAGE,
    "ranging.clock_curve": STAGE,
    "ranging.clock_drift": STAGE,
    "ranging.clock_fit": STAGE,
    "ranging.clock_path": STAGE,
    "ranging.clock_search": STAGE,
    "refine": STAGE,
    "report": STAGE,
    "scale": STAGE,
    "vision": STAGE,
    "__main__": COMMAND_LINE,
    "cli": COMMAND_LINE,
}

MODULES = {
    ".".join(path.relative_to(PACKAGE).with_suffix("").parts).removesuffix(".__init__"): path
    for path in sorted(PACKAGE.rglob("*.py"))
}


def layer(module: str) -> int:
    while module not in LAYER_OF and "." in module:
        module = module.rpartition(".")[0]
    return LAYER_OF.get(module, PIPELINE)


def imports(path: Path) -> set[str]:
    """Full names of all modules that a file imports, wherever in it."""
    found: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}:{node.lineno}: a relative import"
            # Of `from package import name` either may be the module.
            found.add(str(node.module))
            found.update(f"{node.module}.{alias.name}" for alias in node.names)
    return found


def own_imports(module: str) -> set[str]:
    """Names of this package's modules that one of them imports."""
    return {name.removeprefix("rangesfm.") for name in imports(MODULES[module])} & MODULES.keys()


def test_a_module_imports_only_from_its_own_layer_and_those_below() -> None:
    wrong = [(module, name) for module in MODULES for name in own_imports(module) if layer(name) > layer(module)]
    assert not wrong


def test_a_stage_imports_no_other_stage() -> None:
    stages = [module for module in MODULES if layer(module) == STAGE]
    wrong = [
        (module, name)
        for module in stages
        for name in own_imports(module) & set(stages)
        if name.partition(".")[0] != module.partition(".")[0]
    ]
    assert not wrong


def test_only_one_package_touches_the_compiled_part_and_pyceres() -> None:
    touching = [
        module
        for module, path in MODULES.items()
        if any(f"{name}.".startswith(("rangesfm._cpp.", "pyceres.")) for name in imports(path))
    ]
    assert touching, "not even the package that is there for it"
    assert all(module.split(".")[0] == "_ceres" for module in touching)


def test_the_layers_name_no_module_that_is_gone() -> None:
    assert LAYER_OF.keys() <= MODULES.keys() | {"__init__"}


def test_importing_the_package_imports_neither_pycolmap_nor_scipy() -> None:
    code = "import sys, rangesfm; print(*({'pycolmap', 'pyceres', 'scipy', 'numpy'} & sys.modules.keys()))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == []
