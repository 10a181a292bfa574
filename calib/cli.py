"""The command `calib`: from a camera in a box to a robot that knows its errors, step by step."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence

from ceilvo.calib.commands import (
    board,
    calibration_file,
    check,
    intrinsics,
    mount,
    projection,
    report,
    shutter,
    sigma,
    survey,
)
from ceilvo.config.arguments import check_word
from ceilvo.errors import CeilvoError

STEPS = (intrinsics, projection, mount, sigma, survey, check, report)
_INTERRUPTED = 130
"""As shells have it: 128 + SIGINT."""


def main(argv: Sequence[str] | None = None) -> int:
    """Exit code: 0 = PASS, 1 = FAIL or a failure, 2 = wrong use, 78 = wrong input, 130 = interrupted."""
    words = sys.argv[1:] if argv is None else list(argv)
    args = parser_of(words).parse_args(words)
    try:
        return int(args.run(args))
    except CeilvoError as e:
        print(e, file=sys.stderr)
        return e.exit_code
    except KeyboardInterrupt:
        kept = f"; what was taken so far is kept in {args.session}" if hasattr(args, "session") else ""
        print(f"\nstopped{kept}; the same command goes on from there", file=sys.stderr)
        return _INTERRUPTED


def parser_of(words: Sequence[str]) -> argparse.ArgumentParser:
    """Of all commands; words whose first is none of them end it, with exit code 2."""
    parser = argparse.ArgumentParser(
        prog="calib",
        description="Commissioning of a ceiling camera: the numbered commands, one after the other.",
        epilog="practice without any hardware: calib intrinsics --simulate, and so on; each command says which is next",
    )
    commands = parser.add_subparsers(required=True, metavar="COMMAND", title="commands")
    for step in STEPS:
        step.add(commands)
    shutter.add(commands)
    board.add(commands)
    calibration_file.add(commands)
    check_word(parser, commands, words)
    return parser


if __name__ == "__main__":
    sys.exit(main())
