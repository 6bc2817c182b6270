"""The result folder, which some commands start from."""

from __future__ import annotations

import argparse
from pathlib import Path

from rangesfm.errors import InputError


def add_result_argument(parser: argparse.ArgumentParser) -> None:
    """The folder, by place or as ``--input_path``."""
    parser.add_argument("result", nargs="?", metavar="RESULT", help="output folder of a run (default: out)")
    parser.add_argument("--input_path", metavar="RESULT", help="the same")


def result_path(args: argparse.Namespace) -> Path:
    if args.result is not None and args.input_path is not None:
        raise InputError(f"two result folders are given, {args.result} and {args.input_path}; expected one")
    return Path(args.result or args.input_path or "out")
