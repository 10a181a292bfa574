"""Kinds of features: which two kinds of lines meet, coded so that they can be turned with their axes; points; lines.

A crossing's kind is 3 * (kind of the axis-0 line + 1) + (kind of the axis-1 line + 1), with LineKind -1, 0, 1 along
the axis' normal. Axes are only known modulo 90 deg; naming them a quarter turn further (axis 0' = axis 1,
axis 1' = -axis 0) exchanges the two kinds and reverses one. Points have no axes: turning leaves them what they are.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Ints = NDArray[np.int64]

LINE_CROSSINGS = 9
"""Three line kinds on each of two axes."""

LAMP, SPOT, CORNER = 10, 11, 12
"""Points: a bright blob's weighted centre, the middle of what is darker or brighter around it, a corner or a long
lamp's end. 9 is no type: its bit means mapped ground in the index of places, also in recordings older than points."""

CROSSING_TYPES = 13
"""Crossings of lines, and points."""

JOINTS = 4
"""Where two joints between tiles meet."""

TYPE_MISTAKEN = np.array([0.04, 0.38, 0.04, 0.38, 0.01, 0.38, 0.04, 0.38, 0.04, 0.04, 0.04, 0.04, 0.04])
"""Chance that a crossing is seen as one of another type, by its type: an edge that crosses a joint often is, for the
joint's nearer edge may be all that is found of it; counted on 7000 crossings in pairs of views up to 0.8 s apart. Of
points chosen, as of corners of lamps."""


def crossing_type_of(kind_axis0: Ints, kind_axis1: Ints) -> Ints:
    """(M,) codes from two (M,) LineKind arrays."""
    return np.asarray(3 * (kind_axis0 + 1) + (kind_axis1 + 1), dtype=np.int64)


def turned_type(kind: Ints, quarter_turns: int) -> Ints:
    """(M,) codes after naming the axes `quarter_turns` x 90 deg further counter-clockwise."""
    if quarter_turns % 4 == 0:
        return kind
    k0, k1 = kind // 3 - 1, kind % 3 - 1
    for _ in range(quarter_turns % 4):
        k0, k1 = k1, -k0
    return np.where(kind < LINE_CROSSINGS, crossing_type_of(k0, k1), kind)


def quarter_turns(psi_rad: float, reference_rad: float) -> int:
    """How many quarter turns further an axis at psi must be named to lie nearest to an axis at reference."""
    return round((reference_rad - psi_rad) / (0.5 * np.pi)) % 4


def commonest(kind: Ints) -> int:
    """The code that most of (M,) have; 0 of none."""
    return int(np.argmax(np.bincount(kind, minlength=1)))


@dataclass(frozen=True, slots=True)
class CeilingLines:
    """Straight lines on the ceiling, normal . xy = offset in base; all share one direction modulo 90 deg.

    Attributes:
        axis: (L,) 0 where the normal is at the common direction, 1 where it is a quarter turn further.
        offset_m, sigma_m: (L,) and its standard deviation, but for what an error of the tilt moves all of them by.
        kind: (L,) LineKind.
    """

    axis: Ints
    offset_m: NDArray[np.float64]
    sigma_m: NDArray[np.float64]
    kind: Ints
