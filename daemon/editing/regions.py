"""Parts of the floor as people type them: a box or a polygon; and marks, a point here and the same on a plan."""

from __future__ import annotations

import argparse
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ceilvo.json_values import MAX_COORDINATE_M
from ceilvo.types import Array

_FEWEST_CORNERS = 3


@dataclass(frozen=True)
class Region:
    """The inside of a polygon, its border with it.

    Attributes:
        corners_m: (C, 2) in their order, either way round.
        text: as it was typed.
    """

    corners_m: Array
    text: str

    def holds(self, xy_m: Array) -> NDArray[np.bool_]:
        """(N,) which points (N, 2) are inside: a ray to the right crosses the border an odd number of times."""
        x, y = np.asarray(xy_m, np.float64).reshape(-1, 2).T
        inside, border = np.zeros(len(x), bool), np.zeros(len(x), bool)
        for (ax, ay), (bx, by) in zip(self.corners_m, np.roll(self.corners_m, -1, axis=0), strict=True):
            side = (bx - ax) * (y - ay) - (by - ay) * (x - ax)
            inside ^= ((ay > y) != (by > y)) & ((side > 0) == (by > ay))
            between = (x >= min(ax, bx)) & (x <= max(ax, bx)) & (y >= min(ay, by)) & (y <= max(ay, by))
            border |= (side == 0) & between
        return inside | border


@dataclass(frozen=True)
class Mark:
    """One point: where it is in the map and where it should be, both (2,) in m."""

    here_m: Array
    there_m: Array


def box(text: str) -> Region:
    """The type of an option: x0,y0,x1,y1 in m."""
    x0, y0, x1, y1 = _numbers(text, 4, "x0,y0,x1,y1")
    if not (x0 < x1 and y0 < y1):
        raise argparse.ArgumentTypeError(f"{text}: expected x0,y0,x1,y1 with x0 below x1 and y0 below y1")
    return Region(np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]]), f"--box {text}")


def polygon(text: str) -> Region:
    """The type of an option: x,y x,y x,y ... in m."""
    points = [_numbers(word, 2, "x,y for every corner") for word in text.split()]
    if len(points) < _FEWEST_CORNERS:
        raise argparse.ArgumentTypeError(
            f"{text}: {len(points)} corners, expected {_FEWEST_CORNERS} or more, 'x,y x,y x,y'"
        )
    return Region(np.array(points), f"--polygon '{text}'")


def mark(text: str) -> Mark:
    """The type of an option: x,y=X,Y in m."""
    here, equals, there = text.partition("=")
    if not equals:
        raise argparse.ArgumentTypeError(f"{text}: expected x,y=X,Y, a point of the map and where the plan has it")
    return Mark(*(np.array(_numbers(part, 2, "x,y=X,Y")) for part in (here, there)))


def point(text: str) -> Array:
    """The type of an option: x,y in m."""
    return np.array(_numbers(text, 2, "x,y"))


def place_on_floor(text: str) -> tuple[str, Array]:
    """The type of an option: FLOOR=X,Y,DEG; the pose is (3,) [m, m, rad]."""
    floor, equals, pose = text.rpartition("=")
    if not equals:
        raise argparse.ArgumentTypeError(f"{text}: expected FLOOR=X,Y,DEG")
    x, y, deg = _numbers(pose, 3, "FLOOR=X,Y,DEG")
    return floor, np.array([x, y, math.radians(deg)])


def angle_deg(text: str) -> float:
    """The type of an option: degrees, a full turn either way at most."""
    value = _number(text)
    if not abs(value) <= 360.0:
        raise argparse.ArgumentTypeError(f"{text}: expected degrees from -360 to 360")
    return value


def _numbers(text: str, count: int, expected: str) -> list[float]:
    words = text.split(",")
    if len(words) != count:
        raise argparse.ArgumentTypeError(f"{text}: {len(words)} numbers, expected {expected}")
    values = [_number(word) for word in words]
    if not all(abs(v) <= MAX_COORDINATE_M for v in values):
        raise argparse.ArgumentTypeError(f"{text}: expected m within {MAX_COORDINATE_M:g}")
    return values


def _number(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise argparse.ArgumentTypeError(f"{text!r}: expected a number")
    return value
