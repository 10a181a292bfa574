"""What a view of a ceiling that leans shows, over the floor; and which places and lines it shows."""

from __future__ import annotations

import math

import numpy as np

from ceilvo import se2
from ceilvo.daemon.odometry.lines.through import lines_through
from ceilvo.types import Array, Crossings

RASTER_M, MOST_LEARNT = 0.02, 2000
"""Of the places where crossings were taken to be, and how many are remembered; chosen: a third of how far landmarks are
looked for."""


def once(places: Array) -> Array:
    """Places (N, 2) of the raster once each, the last MOST_LEARNT of them in order."""
    return np.asarray(np.unique(places, axis=0)[-MOST_LEARNT:])


def lines_of(crossings: Crossings) -> int:
    """Lines that crossings are of; edges of one thing are one."""
    through = lines_through(crossings.xy_base_m, crossings.crossing_type, crossings.psi_rad)
    return sum(len(np.unique(through[:, axis])) for axis in (0, 1))


def lean_of(tilt_rad: Array) -> Array:
    """(2,) rise of a ceiling in base that a view shows as that tilt."""
    return np.array([tilt_rad[1], -tilt_rad[0]])


def over_floor(rise: Array) -> tuple[Array, Array]:
    """(2, 2) and (2,): A and off of a plane that rises by (2,) in base. Where the joint fit says (x, y) at the
    calibrated height, taking the rise for a tilt, it is A (x, y) + off over the floor at that height.

    The fit turns a ray (x, y, 1) back by I + [w]x, not by a rotation (kernel.project); so A is no multiple of one.
    """
    steep = 1.0 + float(rise @ rise)
    return np.eye(2) - np.outer(rise, rise) / steep, -rise / steep


def direction_over_floor(flat: Array, psi_rad: float) -> float:
    """The direction of lines as seen from above: the mean of both axes, whose right angle a slope may bend."""
    c, s = math.cos(psi_rad), math.sin(psi_rad)
    (a, b), (d, e) = (flat @ np.array([[c, -s], [s, c]])).T.tolist()
    first, second = math.atan2(b, a) - psi_rad, math.atan2(-d, e) - psi_rad
    return psi_rad + 0.5 * (se2.wrap(first) + se2.wrap(second))
