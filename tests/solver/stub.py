"""The type stub of the compiled part: ``python -m tests.solver.stub`` makes it anew from the docstrings."""

from __future__ import annotations

import ast
import subprocess
import sys
import tempfile
from pathlib import Path

STUB = Path(__file__).parents[2] / "plugin" / "rangesfm" / "_cpp.pyi"
# pyceres is imported first, so that the stub names its classes as return types.
_GENERATE = "import sys, pyceres, pybind11_stubgen; pybind11_stubgen.main(['rangesfm._cpp', '-o', sys.argv[1]])"


def compiled_part_stub() -> str:
    """Return the stub, without the docstrings and values that the compiled part has itself."""
    with tempfile.TemporaryDirectory() as folder:
        subprocess.run([sys.executable, "-c", _GENERATE, folder], check=True)
        stub = ast.parse((Path(folder) / "rangesfm" / "_cpp.pyi").read_text(encoding="utf-8"))
    for node in list(stub.body):
        if isinstance(node, ast.FunctionDef):
            node.body = [ast.Expr(ast.Constant(...))]
        elif isinstance(node, ast.AnnAssign):
            node.value = None
            if ast.unparse(node.target) == "__all__":
                stub.body.remove(node)
    command = [sys.executable, "-m", "ruff", "format", "--stdin-filename", str(STUB), "-"]
    return subprocess.run(command, input=ast.unparse(stub), capture_output=True, text=True, check=True).stdout


if __name__ == "__main__":
    STUB.write_text(compiled_part_stub(), encoding="utf-8")
