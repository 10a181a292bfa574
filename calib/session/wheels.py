"""Wheel odometry that goes with pictures: live from the base, or recorded beside them."""

from __future__ import annotations

import csv
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ceilvo import se2
from ceilvo.calib.targets.points_file import ask_on_terminal, in_metres, read_table
from ceilvo.calib.targets.sources import Picture
from ceilvo.config import Base
from ceilvo.drivers.base.link import BaseLink
from ceilvo.drivers.base.modbus import ModbusBase
from ceilvo.errors import CalibrationError

Array = NDArray[np.float64]
Wheels = Callable[[Picture], Array | None]
"""(3,) cumulative odometry at a picture, None where it is not known."""

FILE = "wheels.csv"
_COLUMNS = ("x_m", "y_m", "theta_rad")
_FIRST_ANSWER_S = 2.0
"""That a base is waited for; chosen."""
_POLL_S = 0.02
"""How often it is asked."""
_TURN_RAD = 2.0 * np.pi + 0.1
"""Between two pictures; more means degrees. The excess is for rounding."""


def no_wheels(picture: Picture) -> Array | None:
    """What the picture has by itself: the virtual bench's do."""
    return picture.wheels


def recorded(folder: Path, units: str | None = None) -> Wheels:
    """From FILE in the folder, name,x_m,y_m,theta_rad with a row for each picture; no_wheels where there is none.

    Raises:
        CalibrationError: it cannot be read, names a picture twice, or millimetres that nobody has confirmed.
    """
    path = folder / FILE
    if not path.exists():
        return no_wheels
    table = in_metres(path, read_table(path, _COLUMNS), _COLUMNS[:2], units, ask_on_terminal)
    with path.open(encoding="utf-8-sig", newline="") as f:
        rows = csv.DictReader(f, skipinitialspace=True)
        names = [(row.get("name") or "").strip() for row in rows]
    if not all(names) or len(set(names)) < len(names):
        raise CalibrationError(
            f"{path}: column 'name': found {'a picture twice' if all(names) else 'none, or an empty field'}, "
            f"expected the picture's file name in each row; the first line must be name,{','.join(_COLUMNS)}"
        )
    if float(np.abs(np.diff(table["theta_rad"])).max(initial=0.0)) > _TURN_RAD:
        raise CalibrationError(f"{path}: theta_rad jumps by more than a turn, expected radians; is it in degrees?")
    poses = dict(zip(names, np.column_stack([table[c] for c in _COLUMNS]), strict=True))
    return lambda picture: poses.get(picture.name)


class LiveWheels:
    """Adds up the base's odometry from picture to picture; after a gap in it nothing is known any more."""

    def __init__(self, link: BaseLink) -> None:
        self._link = link
        self._pose: Array = np.zeros(3)
        self._stamp_ns: int | None = None

    def __call__(self, picture: Picture) -> Array | None:
        now = picture.stamp_ns
        if self._stamp_ns is None:
            if self._link.wheels.between(now, now) is None:
                return None
            self._stamp_ns = now
            return self._pose
        motion = self._link.wheels.between(self._stamp_ns, now)
        if motion is None:
            return None  # the base's next answer may cover it
        self._stamp_ns = now
        self._pose = se2.compose(self._pose, motion.prev_from_curr)
        return self._pose


@contextmanager
def live_base(
    settings: Base, note: Callable[[str], None], patience_s: float = _FIRST_ANSWER_S
) -> Iterator[BaseLink | None]:
    """The base of the configuration while it is asked for its wheels; None, with a note, when it does not answer."""
    if not (settings.enabled and settings.use_wheels):
        yield None
        return
    link = BaseLink(settings, ModbusBase(settings))
    link.start()
    try:
        until = time.monotonic() + patience_s
        while not link.snapshot().up and time.monotonic() < until:
            time.sleep(_POLL_S)
        if link.snapshot().up:
            note(f"wheels from the base at {settings.port}")
            yield link
        else:
            note(f"without wheels: {link.snapshot().last_error or f'{settings.port}: the base does not answer'}")
            yield None
    finally:
        link.stop()
