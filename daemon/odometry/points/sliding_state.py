"""What is remembered of points that may slide over the ceiling."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ceilvo.types import Array, Ints


@dataclass(slots=True)
class SlidingState:
    """(T,) features that are followed.

    Attributes:
        pose: (3,) of the robot, from where odometry began.
        kind: as crossings have it, all kinds of crossings of lines as one.
        xy: (T, 2) where each was last, and camera: (T, 2) the camera then, m.
        measured: (T, 2) the camera at the last measurement.
        first, last: (T, 2) in base, where each was seen first and last.
        sums: (T, 9) of the measurements: 1, camera x, y, place x, y, camera squared, camera times place, place squared,
            in m; and how far from the middle, over the height squared, in frames whose tilt no line told.
        missing: frames since each was seen.
        slides, stays: what it was found to do; neither while that is not known.
        glossy: a lamp slid, so that a lamp counts only once it is known to stay.
        by_lines: the last motion was by crossings of lines alone.
        trial: frames more in which a lamp must be known to stay because lamps have come in after such a motion.
    """

    pose: Array = field(default_factory=lambda: np.zeros(3))
    kind: Ints = field(default_factory=lambda: np.zeros(0, np.int64))
    xy: Array = field(default_factory=lambda: np.zeros((0, 2)))
    camera: Array = field(default_factory=lambda: np.zeros((0, 2)))
    measured: Array = field(default_factory=lambda: np.zeros((0, 2)))
    first: Array = field(default_factory=lambda: np.zeros((0, 2)))
    last: Array = field(default_factory=lambda: np.zeros((0, 2)))
    sums: Array = field(default_factory=lambda: np.zeros((0, 9)))
    missing: Ints = field(default_factory=lambda: np.zeros(0, np.int64))
    slides: NDArray[np.bool_] = field(default_factory=lambda: np.zeros(0, bool))
    stays: NDArray[np.bool_] = field(default_factory=lambda: np.zeros(0, bool))
    glossy: bool = False
    by_lines: bool = False
    trial: int = 0

    def __len__(self) -> int:
        return len(self.kind)
