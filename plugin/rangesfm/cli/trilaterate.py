"""``rangesfm trilaterate``: where anchors stand, from ranges taken at known positions of the tag."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from rangesfm.cli.arguments import Commands, Outcome
from rangesfm.cli.log_arguments import add_log_arguments, notes_of_log, read_log
from rangesfm.cli.position_arguments import add_position_arguments, read_tag_positions
from rangesfm.files.text_table import align_rows
from rangesfm.progress import Progress

if TYPE_CHECKING:
    from collections.abc import Sequence

    from rangesfm.ranging.anchors.anchor_survey import AnchorPlacement
    from rangesfm.ranging.log import RangeLog

_TOWARD = {
    "above": (0.0, 0.0, 1.0),
    "below": (0.0, 0.0, -1.0),
    "x+": (1.0, 0.0, 0.0),
    "x-": (-1.0, 0.0, 0.0),
    "y+": (0.0, 1.0, 0.0),
    "y-": (0.0, -1.0, 0.0),
    "z+": (0.0, 0.0, 1.0),
    "z-": (0.0, 0.0, -1.0),
}

_HEADER = ("anchor", "ranges", "fit", "x m", "y m", "z m", "stddev m", "bias m", "noise m")
_NOTHING = ("",) * 7


def add_command(commands: Commands) -> None:
    parser = commands.add(
        "trilaterate",
        execute,
        help="anchor positions from ranges at known tag positions",
        description=(
            "Find where anchors stand from ranges that were taken at known positions of the tag, robustly. If these "
            "lie in a plane, an anchor has two possible places, one on each side: --side says which."
        ),
        example=(
            "rangesfm trilaterate uwb.csv --positions total_station.csv --side above --output_path anchors.csv\n"
            "  rangesfm run survey.toml --anchors anchors.csv --anchor_frame site"
        ),
    )
    add_log_arguments(parser)
    add_position_arguments(parser, max_interpolation_gap_s=0.5)
    parser.add_argument(
        "--side",
        type=_side,
        default={},
        metavar="WORD|ID=WORD,..",
        help=f"of two possible places the one that lies {', '.join(_TOWARD)}; for all anchors or for each",
    )
    _add_estimate_options(parser)
    parser.add_argument("--output_path", metavar="CSV", help="write the anchors there, for --anchors of other commands")


def _add_estimate_options(parser: argparse.ArgumentParser) -> None:
    group = parser.add_argument_group("estimate")
    group.add_argument("--range_stddev_m", type=_positive, metavar="M", help="noise of a range (default: estimated)")
    group.add_argument("--range_bias_m", type=float, default=0.0, metavar="M", help="what ranges read too long")
    group.add_argument(
        "--range_bias_stddev_m",
        type=_not_negative,
        default=0.1,
        metavar="M",
        help="how uncertain that is; 0 fixes it (default: 0.1)",
    )
    group.add_argument(
        "--max_position_stddev_m",
        type=_positive,
        default=1.0,
        metavar="M",
        help="an anchor less certain than this in any direction is refused (default: 1)",
    )


def execute(args: argparse.Namespace, progress: Progress) -> Outcome:
    from rangesfm.errors import GeometryError
    from rangesfm.ranging.anchors.anchor_file import write_anchors
    from rangesfm.ranging.anchors.anchor_survey import trilaterate_anchors
    from rangesfm.ranging.anchors.trilateration import TrilaterationOptions
    from rangesfm.survey.inputs import of_one_tag

    log = of_one_tag(read_log(args), args.tag_id)
    positions = read_tag_positions(args, log)
    options = TrilaterationOptions(
        range_stddev_m=args.range_stddev_m,
        range_bias_m=args.range_bias_m,
        range_bias_stddev_m=args.range_bias_stddev_m,
        max_position_stddev_m=args.max_position_stddev_m,
    )
    placements = trilaterate_anchors(log, positions, toward=_toward(args.side, log), options=options)
    if all(placement.found is None for placement in placements):
        raise GeometryError(f"anchor {placements[0].anchor_id}: {placements[0].why_not}")
    lines = [*notes_of_log(log), *_lines(log, placements)]
    if args.output_path is not None:
        write_anchors([placement.anchor for placement in placements], args.output_path)
        lines += ["", f"written to {args.output_path}"]
    return Outcome(lines)


def _toward(side: dict[str, str], log: RangeLog) -> dict[str, Sequence[float]]:
    from rangesfm.errors import InputError

    for anchor_id in side:
        if anchor_id and anchor_id not in log.anchor_ids:
            raise InputError(f"--side: anchor '{anchor_id}' is not in the log ({', '.join(log.anchor_ids)})")
    words = {anchor_id: side.get(anchor_id, side.get("")) for anchor_id in log.anchor_ids}
    return {anchor_id: _TOWARD[word] for anchor_id, word in words.items() if word is not None}


def _side(text: str) -> dict[str, str]:
    """Words by anchor; by the empty id the word for all others."""
    pairs = [part.strip().rpartition("=") for part in text.split(",")]
    for _, _, word in pairs:
        if word not in _TOWARD:
            raise argparse.ArgumentTypeError(f"'{word}' is no side, expected one of {', '.join(_TOWARD)}")
    return {anchor_id: word for anchor_id, _, word in pairs}


def _positive(text: str) -> float:
    if not (value := _not_negative(text)) > 0:
        raise argparse.ArgumentTypeError(f"'{text}' is not a length in metres, expected more than 0")
    return value


def _not_negative(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = -1.0
    if not 0 <= value < float("inf"):
        raise argparse.ArgumentTypeError(f"'{text}' is not a length in metres, expected 0 or more")
    return value


def _lines(log: RangeLog, placements: Sequence[AnchorPlacement]) -> list[str]:
    num_known = sum(placement.num_ranges for placement in placements)
    rows: list[Sequence[str]] = [_HEADER]
    notes = [""]
    for placement in placements:
        found, name = placement.found, (placement.anchor_id, str(placement.num_ranges))
        if found is None:
            rows.append((*name, *_NOTHING))
            notes.append(f"  {placement.why_not}")
            continue
        share = f"{100 * (found.weights > 0.5).mean():.0f} %"
        stddevs = (found.position_stddev_m, found.range_bias_m, found.noise_stddev_m)
        rows.append((*name, share, *(f"{value:.3f}" for value in (*found.position_m, *stddevs))))
        notes.append("")
        if found.mirror_position_m is not None:
            rows.append(("", "", "or", *(f"{value:.3f}" for value in found.mirror_position_m), "", "", ""))
            notes.append("  (the tag's positions lie in a plane: say which by --side)")
    return [
        f"{num_known} of {len(log)} ranges are at known positions of the tag",
        "",
        *(line + note for line, note in zip(align_rows(rows).split("\n"), notes, strict=True)),
    ]
