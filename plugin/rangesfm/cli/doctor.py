"""The command ``doctor``, which checks that all parts of the installation fit together."""

from __future__ import annotations

import argparse

from rangesfm.cli.arguments import Commands, Outcome
from rangesfm.errors import SolverError
from rangesfm.progress import Progress


def add_doctor_commands(commands: Commands) -> None:
    commands.add("doctor", _doctor, "check the installation: versions, and whether the compiled part fits them")


def _doctor(args: argparse.Namespace, progress: Progress) -> Outcome:
    """Check versions and threads, and that the compiled part shares its types with pycolmap and pyceres.

    example:
      rangesfm doctor
    """
    from rangesfm.solver.installation_checks import diagnose
    from rangesfm.util.files.text_tables import align_rows

    checks = diagnose()
    rows = []
    for check in checks:
        rows.append(("ok" if check.ok else "BAD", check.name, check.found))
        if not check.ok:
            rows.append(("", "", f"expected {check.expected}; {check.remedy}"))
    return Outcome([align_rows(rows, num_left=3)], 0 if all(check.ok for check in checks) else SolverError.exit_status)
