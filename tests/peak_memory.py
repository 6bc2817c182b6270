"""The largest amount of memory that a process has used."""

from __future__ import annotations

from pathlib import Path


def peak_bytes() -> int:
    """Return the peak memory of this process alone, from Linux's /proc.

    ``getrusage`` would start from the peak of the parent process.
    """
    status = Path("/proc/self/status").read_text()
    return int(next(line.split()[1] for line in status.splitlines() if line.startswith("VmHWM:"))) << 10
