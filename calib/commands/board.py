"""`calib board`: a board to print."""

from __future__ import annotations

import argparse
from pathlib import Path

from ceilvo.calib.commands.intrinsics import board_of, board_options
from ceilvo.calib.session.common import Subcommands
from ceilvo.calib.targets.printed import PAPERS_MM, pdf, room_mm, sheet
from ceilvo.errors import CalibrationError
from ceilvo.files import write_atomic

_USUAL = {"chessboard": (9, 6), "charuco": (9, 6), "aprilgrid": (6, 4), "circles": (9, 6), "acircles": (4, 11)}
"""Columns and rows; chosen: what A4 holds in sizes that a camera sees from a metre."""
_TRY_MM = 10.0
"""A square's side to find out what a board needs of a page; any would do."""


def add(commands: Subcommands) -> None:
    p = commands.add_parser(
        "board",
        help="print a board: chessboard, ChArUco, AprilGrid or circles, as PDF",
        description="Writes a PDF. Print it at 100 %, check the bar with a ruler, glue it on something flat.",
        epilog="example: calib board build/board.pdf --board charuco --paper A3",
    )
    p.add_argument("file", type=Path)
    board_options(p)
    p.add_argument("--columns", type=int, help="inner corners; squares of ChArUco, tags, circles (by the board)")
    p.add_argument("--rows", type=int, help="(by the board)")
    p.add_argument(
        "--square-mm", type=float, help="side of a square, from tag to tag, circle to circle; default: what fits"
    )
    p.add_argument("--paper", choices=tuple(PAPERS_MM), default="A4", help="(%(default)s)")
    p.add_argument("--force", action="store_true", help="replace the file")
    p.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    columns, rows = _USUAL[args.board]
    args.columns, args.rows = args.columns or columns, args.rows or rows
    board = board_of(args, args.square_mm or _fitting_mm(args))
    written = pdf(sheet(board, args.paper))
    path: Path = args.file
    if path.exists() and not args.force:
        raise CalibrationError(f"{path}: found a file there, expected none; pass --force to replace it")
    try:
        write_atomic(path, written)
    except OSError as e:
        raise CalibrationError(f"{path}: cannot be written ({e.strerror}); check the folder and its rights") from None
    print(f"{path}: {board.text}, on {args.paper}")
    print("print it at 100 %, check the bar with a ruler, glue it on something flat; then:")
    print(f"  calib intrinsics {board.options} --device /dev/video0")
    return 0


def _fitting_mm(args: argparse.Namespace) -> float:
    """The largest square in whole millimetres that fits on the paper."""
    fixed, args.marker_mm = args.marker_mm, None
    x0, y0, x1, y1 = board_of(args, _TRY_MM).extent_m
    args.marker_mm = fixed
    w, h = (1e3 * v / _TRY_MM for v in (x1 - x0, y1 - y0))
    room = room_mm(args.paper, w > h)
    most = int(min(room[0] / w, room[1] / h))
    if most < 1:
        raise CalibrationError(
            f"--columns, --rows: found {args.columns} x {args.rows}, expected fewer: not even squares of 1 mm fit on "
            f"{args.paper}"
        )
    return float(most)
