"""The words of `ceilvod map` that work on whole buildings."""

from __future__ import annotations

import argparse
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

from ceilvo.config.arguments import command
from ceilvo.daemon.building.typed import prefixed, sigma_mm, tape, typed_mark
from ceilvo.errors import CeilvoError
from ceilvo.tasks.workers import add_options

if TYPE_CHECKING:
    from ceilvo.config.arguments import Commands


def add(words: Commands, default_config: Path) -> None:
    """What follows `ceilvod map`."""
    _add_refine(words, default_config)
    _add_build(words, default_config)
    _add_join(words)
    _add_anchors(words)


def _add_anchors(words: Commands) -> None:
    text = "find where radio anchors are, from ranges along recorded drives on a map"
    p = command(words, "anchors", text, "ceilvod map anchors drive.mcap --into beacons.yaml")
    p.add_argument("recordings", type=Path, nargs="+", metavar="RECORDING", help="MCAP file, or a folder of runs")
    p.add_argument("--into", type=Path, metavar="FILE", required=True, help="beacons.file; its other entries are kept")
    p.add_argument("--height", type=float, default=2.0, metavar="M", help="of the anchors above the floor, about (2)")
    p.add_argument("--dry-run", action="store_true", help="write nothing")
    p.set_defaults(do=_locate_anchors)


def _locate_anchors(options: argparse.Namespace) -> int:
    from ceilvo.daemon.building.radio.anchoring import locate_anchors

    text, code = locate_anchors(options.recordings, options.into, options.height, options.dry_run)
    print(text, end="")
    return code


def _add_refine(words: Commands, default_config: Path) -> None:
    text = (
        "make maps better from all the key poses that are kept with them, and find what is wrong with the calibration"
    )
    p = command(words, "refine", text, "ceilvod map refine map.db --tape 0,0:38.4,0=38.397 --dry-run")
    p.add_argument("file", type=Path, metavar="DB", help="database of maps")
    p.add_argument("--floor", metavar="NAME", help="one floor (default: all together)")
    _calibrations(p, default_config)
    p.add_argument(
        "--write-calibration",
        type=prefixed,
        action="append",
        default=[],
        metavar="[SESSIONS=]NEW",
        help="write the corrected calibration to a new file",
    )
    _anchors(p)
    _trial(p)
    p.set_defaults(do=_refine)


def _add_build(words: Commands, default_config: Path) -> None:
    text = "make one refined map of recorded drives, or add them to one"
    p = command(words, "build", text, "ceilvod map build monday.mcap tuesday/ --into map.db --jobs 2")
    p.add_argument("recordings", type=Path, nargs="+", metavar="RECORDING", help="MCAP file, or a folder of runs")
    p.add_argument("--into", type=Path, metavar="DB", required=True, help="made where there is none, else added to")
    p.add_argument("--floor", metavar="NAME", help="which map of a database (default: the only one)")
    _calibrations(p, default_config)
    add_options(p)
    _trial(p)
    p.set_defaults(do=_build)


def _add_join(words: Commands) -> None:
    text = "add a map in a frame of its own, which is found by what both maps have, or refuse"
    p = command(words, "join", text, "ceilvod map join map.db other.db --dry-run --png join.png")
    p.add_argument("file", type=Path, metavar="FILE", help="database of maps, map.json or an export")
    p.add_argument("other", type=Path, metavar="OTHER", help="what is added; it stays as it is")
    p.add_argument("--floor", metavar="NAME", help="which map of a database (default: the only one)")
    _trial(p)
    p.add_argument("--out", type=Path, metavar="NEW", help="write NEW.db or NEW.json instead, and leave FILE as it is")
    p.set_defaults(do=_join)


def _trial(p: argparse.ArgumentParser) -> None:
    p.add_argument("--dry-run", action="store_true", help="say what would change, and change nothing")
    p.add_argument("--png", type=Path, metavar="PICTURE", help="draw the change")


def _calibrations(p: argparse.ArgumentParser, default_config: Path) -> None:
    p.add_argument(
        "--calibration",
        type=prefixed,
        action="append",
        default=[],
        metavar="[SESSIONS=]FILE",
        help="by which the robot saw; once for all, or for each beginning of sessions' names (default: the config's)",
    )
    p.add_argument(
        "--config", type=Path, default=default_config, metavar="FILE", help="names the calibration (%(default)s)"
    )


def _anchors(p: argparse.ArgumentParser) -> None:
    p.add_argument(
        "--tape",
        type=tape,
        action="append",
        default=[],
        metavar="[FLOOR@]x,y:x,y=LEN",
        help="a measured distance between two landmarks, m",
    )
    p.add_argument("--tape-sigma", type=sigma_mm, default=2.0, metavar="MM", help="of the tape (%(default)g)")
    p.add_argument(
        "--mark",
        type=typed_mark,
        action="append",
        default=[],
        metavar="[FLOOR@]x,y=X,Y",
        help="a landmark of the map, and where a surveyor has it, m; two or more a floor",
    )
    p.add_argument("--mark-sigma", type=sigma_mm, default=5.0, metavar="MM", help="of the survey (%(default)g)")


def _refine(options: argparse.Namespace) -> int:
    _needs_scipy("refine")
    from ceilvo.daemon.building.refining import refine  # SciPy: a robot has no need of it

    return refine(options)


def _build(options: argparse.Namespace) -> int:
    _needs_scipy("build")
    from ceilvo.daemon.building.whole import build

    return build(options)


def _join(options: argparse.Namespace) -> int:
    _needs_scipy("join")
    from ceilvo.daemon.building.joined import join_command

    return join_command(options)


def _needs_scipy(word: str) -> None:
    if find_spec("scipy") is None:
        raise CeilvoError(f"ceilvod map {word}: needs SciPy, which is not installed: pip install 'ceilvo[map]'")
