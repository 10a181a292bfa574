"""What all steps of commissioning share on the command line: options, progress, verdict."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TypeAlias

from ceilvo.calib.practice.virtual_bench import VirtualBench
from ceilvo.calib.session.session import CALIBRATION, Session
from ceilvo.calib.session.watch import watch_of
from ceilvo.calib.targets.sources import ListSource, Picture, Source, open_source
from ceilvo.calibration import Calibration
from ceilvo.calibration_file import read_calibration
from ceilvo.camera import CameraModel
from ceilvo.config import Camera as CameraConfig
from ceilvo.config.arguments import from_up
from ceilvo.config.reader import load_config
from ceilvo.errors import CalibrationError
from ceilvo.types import Frame

Subcommands: TypeAlias = "argparse._SubParsersAction[argparse.ArgumentParser]"

DEFAULT_SESSION = Path("commissioning")
FIGURES = "figures.json"
"""In a step's folder: the names and figures that were printed, as text with units."""
FAILED = 1
"""Exit code of a FAIL."""
_ORDER = ("intrinsics", "projection", "mount", "sigma", "survey", "check", "report")


def add_step(
    commands: Subcommands,
    name: str,
    run: Callable[[argparse.Namespace], int],
    *,
    help: str,
    description: str,
    epilog: str,
    pictures: bool = True,
) -> argparse.ArgumentParser:
    """A command with what all steps have: the session, force and, unless it reads results only, where pictures come
    from."""
    p = commands.add_parser(name, help=help, description=description, epilog=epilog)
    p.set_defaults(run=run)
    p.add_argument(
        "--session", type=Path, default=DEFAULT_SESSION, metavar="DIR", help="where all of it is kept (%(default)s)"
    )
    p.add_argument("--force", action="store_true", help="do it again: replace the earlier result and keep it as .bak")
    if pictures:
        _source_options(p)
    return p


def _source_options(p: argparse.ArgumentParser) -> None:
    group = p.add_argument_group("pictures from (one of)")
    group.add_argument("--config", type=Path, metavar="FILE", help="the camera of this config.yaml, live")
    group.add_argument("--device", metavar="DEV", help="this camera, live, for example /dev/video0")
    group.add_argument("--images", type=Path, metavar="DIR", help="a folder of images, a recording or a video file")
    group.add_argument("--simulate", action="store_true", help="the virtual bench: nothing needed, for practice")
    p.add_argument("--seed", type=from_up(0), default=1, metavar="N", help="noise of the virtual bench (%(default)s)")


def bench_of(args: argparse.Namespace) -> VirtualBench:
    return VirtualBench(seed=args.seed)


@contextmanager
def pictures(args: argparse.Namespace, simulated: Iterable[Picture] | None) -> Iterator[Source]:
    """The source that was asked for, open.

    Raises:
        CalibrationError: none or several were asked for.
        CameraError, FileFormatError: it cannot be used.
    """
    watch = watch_of(args)
    if watch.no_more:
        yield ListSource(watch.no_more, iter(()))
        return
    with _pictures(args, simulated) as source:
        watch.opened(source.info)
        yield source


@contextmanager
def _pictures(args: argparse.Namespace, simulated: Iterable[Picture] | None) -> Iterator[Source]:
    chosen = [bool(args.simulate), args.images is not None, args.config is not None or args.device is not None]
    if sum(chosen) != 1:
        found = "none" if not any(chosen) else "several"
        raise CalibrationError(
            f"pictures: found {found} of --config, --device, --images and --simulate, expected one of them"
        )
    if args.simulate and simulated is not None:
        yield ListSource("virtual bench", iter(simulated), "ceilvo-sim")
        return
    settings = load_config(args.config).camera if args.config is not None else CameraConfig()
    if args.device is not None:
        settings = replace(settings, source="v4l2", device=args.device)
    with open_source(args.images, settings) as source:
        yield source


class Progress:
    """One line that is written over on a terminal; elsewhere only rejections are lines."""

    def __init__(self, step: str) -> None:
        self._step, self._open = step, False
        self._terminal = sys.stderr.isatty()

    def tell(self, text: str) -> None:
        if self._terminal:
            print(f"\r\033[K{self._step}: {text}", end="", file=sys.stderr, flush=True)
            self._open = True

    def note(self, text: str) -> None:
        self.end()
        print(f"{self._step}: {text}", file=sys.stderr, flush=True)

    def end(self) -> None:
        if self._open:
            print(file=sys.stderr)
            self._open = False


def conclude(
    step: str,
    rows: Sequence[tuple[str, str]],
    problems: Sequence[str],
    args: argparse.Namespace,
    then: str | None = None,
) -> int:
    """Print figures and verdict, and keep the figures for the report; 0 = PASS, 1 = FAIL.

    Args:
        then: what to do about a FAIL, None = the step again.
    """
    Session(args.session).write(f"{step}/{FIGURES}", json.dumps(rows, indent=1) + "\n")
    watch_of(args).concluded(step, rows, problems)
    print(f"\n{step}")
    width = max((len(name) for name, _ in rows), default=0) + 2
    for name, value in rows:
        print(f"  {name:<{width}}{value}")
    if not problems:
        print(f"PASS  next: {next_step(step, args)}")
        return 0
    print("FAIL")
    for problem in problems:
        print(f"  - {problem}")
    print(f"  then: {then or f'calib {step} {_source_text(args)}--force{_session_text(args)}'}")
    return FAILED


def next_step(step: str, args: argparse.Namespace) -> str:
    following = _ORDER[_ORDER.index(step) + 1] if step in _ORDER[:-1] else ""
    if not following:
        return "copy calibration.yaml to where the daemon's configuration names it"
    if following == "report":
        return f"calib report{_session_text(args)}"
    simulated = getattr(args, "simulate", False)
    tile = " --tile-m SIDE" if following == "projection" and not simulated else ""
    return f"calib {following} {_source_text(args)}".rstrip() + tile + _session_text(args)


def _session_text(args: argparse.Namespace) -> str:
    return "" if args.session == DEFAULT_SESSION else f" --session {args.session}"


def _source_text(args: argparse.Namespace) -> str:
    if getattr(args, "simulate", False):
        return "--simulate "
    if getattr(args, "config", None) is not None:
        return f"--config {args.config} "
    if getattr(args, "device", None) is not None:
        return f"--device {args.device} "
    if getattr(args, "images", None) is not None:
        return "--images DIR "
    return ""


def calibration_of(args: argparse.Namespace) -> tuple[Path, Calibration]:
    """The file of --calibration, else the session's.

    Raises:
        CalibrationError: not there, or not good.
    """
    path = args.calibration or args.session / CALIBRATION
    if args.calibration is None and not path.exists():
        raise CalibrationError(
            f"{path}: found no such file; run 'calib projection' first, or name a file with --calibration"
        )
    return path, read_calibration(path)


def check_size(picture: Picture, size: tuple[int, int] | None, what: str) -> str:
    """Why the picture does not go with the others, "" when it does."""
    h, w = picture.gray.shape
    if size is not None and (w, h) != size:
        return f"is {w} x {h} px, {what} {size[0]} x {size[1]}: all must come from the same camera mode"
    return ""


def frames_of(source: Source, camera: CameraModel, seconds: float, progress: Progress) -> Iterator[Frame]:
    """Usable pictures of the calibrated size, each later than the one before; of a live source for so long at most."""
    number, first_ns, last_ns = 0, 0, 0
    for picture in source:
        reason = picture.problem or check_size(picture, (camera.width_px, camera.height_px), "calibrated are")
        if reason:
            progress.note(f"{picture.name}: rejected, {reason}")
            continue
        if picture.stamp_ns <= last_ns:
            continue
        first_ns, last_ns = first_ns or picture.stamp_ns, picture.stamp_ns
        yield Frame(number, picture.stamp_ns, picture.gray)
        number += 1
        if source.info.live and (last_ns - first_ns) * 1e-9 > seconds:
            return


def session_of(args: argparse.Namespace) -> Session:
    return Session(args.session, force=args.force)
