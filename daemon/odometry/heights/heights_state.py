"""What is remembered of the heights of a ceiling from frame to frame."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from ceilvo.daemon.odometry.heights.levels import Levels
from ceilvo.daemon.odometry.heights.tracks import Tracks
from ceilvo.types import Array, Crossings, Ints

_LATELY, _MAY_FAIL = 30.0, 0.2
"""Frames, and the share of them without a motion beyond which no height is founded; chosen: a second, a fifth."""


@dataclass(slots=True)
class HeightsState:
    """All that the stage remembers.

    Attributes:
        tracks, levels: the lines, and the heights that there are.
        camera_m: (2,) way of the camera along two fixed axes, the lines' directions at the start.
        turned_rad: of base against them.
        next_name: of the next new track.
        reference: crossings of the last frame as they were seen, None where it gave no motion; names: (M, 2) of their
            lines' tracks.
        slopes: lines move past the faster the further they are in one direction.
        settled: a second height was found, and lines are measured against a camera that is known to move right.
        remembered: heights of an earlier run; no line was met at one of them yet, or they are in levels.
        asks: none of those was met yet, and the map did not say either that all here is at the calibrated height.
        failing: share of the frames, over about the last second, that gave no motion.
    """

    tracks: Tracks = field(default_factory=Tracks)
    levels: Levels = field(default_factory=Levels)
    camera_m: Array = field(default_factory=lambda: np.zeros(2))
    turned_rad: float | None = None
    next_name: int = 0
    reference: Crossings | None = None
    names: Ints = field(default_factory=lambda: np.zeros((0, 2), np.int64))
    slopes: bool = False
    settled: bool = False
    remembered: Levels = field(default_factory=Levels)
    asks: bool = False
    failing: float = 0.0

    def told(self, ok: bool) -> None:
        """A frame gave a motion, or none."""
        self.failing += (float(not ok) - self.failing) / _LATELY

    @property
    def fails(self) -> bool:
        """Whether too many frames give no motion for lines to tell their heights by it: false tilts move them, too."""
        return self.failing > _MAY_FAIL

    def hang(self, ratio: float, sigma: float) -> None:
        """All lines in view are of that ratio, known to sigma: the way until now was so many times too long."""
        self.tracks.rescaled(ratio)
        self.levels.found(ratio, sigma)
        self.tracks.level[:], self.tracks.own[:], self.settled = len(self.levels) - 1, True, True

    @property
    def sees_calibrated(self) -> bool:
        """Whether a line that says itself that it is at the calibrated height is followed."""
        return bool(np.any(self.tracks.own & (self.tracks.level == 0)))
