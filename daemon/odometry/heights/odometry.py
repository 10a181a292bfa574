"""Visual odometry under a ceiling that may have several heights, or slope."""

from __future__ import annotations

import numpy as np

from ceilvo.calibration import Calibration
from ceilvo.config import Odometry
from ceilvo.daemon.odometry.heights.slope import Slope
from ceilvo.daemon.odometry.heights.stage import Heights
from ceilvo.daemon.odometry.visual_odometry import VisualOdometry
from ceilvo.types import Array, Crossings, Motion


class HeightsOdometry(VisualOdometry):
    """With the heights of the lines that motion is measured by."""

    def __init__(self, config: Odometry, calibration: Calibration) -> None:
        super().__init__(config)
        self.slope = Slope(calibration)
        self.heights = Heights(calibration)

    def placed(self, crossings: Crossings | None, expected: Array | None) -> Crossings | None:
        """The crossings of a frame where they are, and so those of the last one; expected: (3,) motion since then."""
        flat = self.slope.placed(crossings, expected)
        found = self.heights.look(flat, expected)
        self.look_again(self.heights.reference() if self.heights.several else self.slope.reference())
        return found

    def learn(self, motion: Motion, placed: Crossings | None) -> Crossings | None:
        """What the motion says about the ceiling; returns the crossings, where they are known to be now."""
        self.heights.learn(motion)
        self.slope.learn(motion)
        anew = None if self.heights.several else self.slope.reference()
        return placed if anew is None else anew

    @property
    def misplaced(self) -> Array:
        """(N, 2) in base, where crossings of the last frame were taken to be until it told otherwise."""
        return np.vstack([self.heights.misplaced, self.slope.misplaced])

    @property
    def suspicion(self) -> str:
        """What is wrong with the ceiling, for people; "" for nothing."""
        return self.slope.suspicion if self.slope.state.used is not None else self.heights.suspicion
