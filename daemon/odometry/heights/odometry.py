"""Visual odometry under a ceiling that may have several heights."""

from __future__ import annotations

from ceilvo.calibration import Calibration
from ceilvo.config import Odometry
from ceilvo.daemon.odometry.heights.stage import Heights
from ceilvo.daemon.odometry.visual_odometry import VisualOdometry
from ceilvo.types import Array, Crossings


class HeightsOdometry(VisualOdometry):
    """With the heights of the lines that motion is measured by."""

    def __init__(self, config: Odometry, calibration: Calibration) -> None:
        super().__init__(config)
        self.heights = Heights(calibration)

    def placed(self, crossings: Crossings | None, expected: Array | None) -> Crossings | None:
        """The crossings of a frame where they are, and so those of the last one; expected: (3,) motion since then."""
        found = self.heights.look(crossings, expected)
        self.look_again(self.heights.reference())
        return found
