"""Visual odometry under a ceiling that may have several heights, or slope, of a robot that may rock."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from ceilvo.calibration import Calibration, CeilingShape
from ceilvo.config import Odometry
from ceilvo.daemon.odometry.course import Course, Found
from ceilvo.daemon.odometry.heights.by_map import AskMap, no_map
from ceilvo.daemon.odometry.heights.slope import Slope
from ceilvo.daemon.odometry.heights.stage import Heights
from ceilvo.daemon.odometry.heights.tracks import Sharpness
from ceilvo.daemon.odometry.points import fixtures, flicker
from ceilvo.daemon.odometry.points.constellation import has_lines
from ceilvo.daemon.odometry.points.fixtures import FixturesState
from ceilvo.daemon.odometry.points.lean import learn, step_cov, sway_m, view_cov
from ceilvo.daemon.odometry.points.sliding import Sliding
from ceilvo.daemon.odometry.registration import points_of
from ceilvo.daemon.odometry.visual_odometry import VisualOdometry
from ceilvo.se2 import greatest_variance
from ceilvo.types import Array, Crossings, Motion

ROCKS_M = 0.015
"""Standard deviation by which a view is off, from which no place is called good: within 5 cm, by three of them; chosen.
"""
_LEVEL_RAD = np.radians(0.02)
"""A view that is tilted less may have been taken to be level, for want of lines that tell; chosen: floors in buildings.
"""


class HeightsOdometry(VisualOdometry):
    """With the heights of the lines that motion is measured by, and how far one from points alone may be off.

    Attributes:
        ask_map: for the heights of lines that do not tell them.
    """

    def __init__(self, config: Odometry, calibration: Calibration) -> None:
        super().__init__(config)
        self.slope = Slope(calibration)
        self.heights = Heights(calibration)
        coarse = Sharpness.of(calibration).coarse
        self._sliding = Sliding(calibration.mount_xy_m, calibration.ceiling_height_m, coarse)
        self._height_m = calibration.ceiling_height_m
        self.ask_map: AskMap = no_map
        self._mount = calibration.mount_xy_m
        self._lines: Crossings | None = None
        self._hung = np.zeros((0, 2))

    def know(self, ceiling: CeilingShape, pose: Array) -> None:
        """Begin with what an earlier run found of the ceiling, at a pose (3,) on its map."""
        self.heights.know(ceiling.drops_m)
        self.slope.know(ceiling.slope, pose)
        self.state.fixtures = FixturesState()

    def ceiling(self, pose: Array) -> CeilingShape:
        """What was found, on a map where the robot is at a pose (3,)."""
        return CeilingShape(self.heights.drops_m, self.slope.on_map(pose))

    @property
    def wants_points(self) -> bool:
        """Whether points are to be looked for though lines cross often."""
        return self.state.flicker.flickers and self.one_plane

    @property
    def wants_fixtures(self) -> bool:
        """Whether the next frame is to say whether all lines are lower than the calibrated height."""
        return self.state.fixtures.due and self.one_plane

    @property
    def suspicion(self) -> str:
        """What is wrong with the ceiling, for people; "" for nothing."""
        if said := fixtures.said(self.state.fixtures, self._height_m):
            return said
        return self.slope.suspicion if self.slope.state.used is not None else self.heights.suspicion

    @property
    def rocking(self) -> str:
        """How far off a view may be because the robot rocks and little tells its tilt, for people; "" where that is
        little."""
        lean, view = self.state.lean, self.state.reference
        sigma_m = 0.0 if lean.told else math.sqrt(float(np.max(view_cov(lean))))
        if sigma_m > ROCKS_M:
            return f"the robot rocks by {sigma_m:.3f} m under points alone"
        open_m = 0.0 if view is None else math.sqrt(greatest_variance(view.common_cov_m2))
        return f"too few lines to tell the robot's tilt to better than {open_m:.3f} m" if open_m > ROCKS_M else ""

    @property
    def one_plane(self) -> bool:
        """Whether all is taken to be at the calibrated height."""
        return not self.heights.several and self.slope.state.used is None

    def placed(self, crossings: Crossings | None, expected: Array | None) -> Crossings | None:
        """The crossings of a frame where they are, and so those of the last one; expected: (3,) motion since then."""
        self._lines = crossings
        if self.one_plane:
            crossings = flicker.steady(self.state.flicker, crossings)
        flat = self.slope.placed(crossings, expected)
        found = self.heights.look(flat, expected, self.ask_map)
        self.look_again(self.heights.reference() if self.heights.several else self.slope.reference())
        if found is not None and not self.one_plane:
            found = replace(found, lines=None)
        return self._sliding.look(self.state.sliding, found, expected)

    def learn(self, motion: Motion, placed: Crossings | None) -> Crossings | None:
        """What the motion says about the ceiling; returns the crossings, where they are known to be now."""
        self.heights.learn(motion)
        self.slope.learn(motion, self.heights.several)
        self._sliding.learn(self.state.sliding, motion, sway_m(self.state.lean))
        flicker.learn(self.state.flicker, self._lines, placed, motion, self.state.reference)
        self._hung = self._hang(motion)
        anew = None if self.heights.several else self.slope.reference()
        return placed if anew is None else anew

    def _hang(self, motion: Motion) -> Array:
        """(N, 2) where crossings of this frame were taken to be until fixtures told that all of them hang lower."""
        s = self.state.fixtures
        if not self.one_plane:
            s.slower = 0.0  # lines tell their heights themselves
        ratio = fixtures.learn(s, self._lines if self.one_plane else None, motion, self._mount)
        if ratio != 1.0 and self._lines is not None:
            self.heights.state.hang(ratio, fixtures.SIGMA)
            return self._lines.xy_base_m
        if self.heights.state.sees_calibrated:
            s.hang_m = 0.0
        return np.zeros((0, 2))

    @property
    def misplaced(self) -> Array:
        """(N, 2) in base, where crossings of the last frame were taken to be until it told otherwise."""
        return np.vstack([self.heights.misplaced, self.slope.misplaced, self._sliding.misplaced, self._hung])

    @property
    def _lines_tell_tilt(self) -> bool:
        """Whether a view of points alone is so because crossings flicker, and their lines show a tilt."""
        if not self.state.flicker.by_points or self._lines is None:
            return False
        return has_lines(self._lines) and float(np.max(np.abs(self._lines.tilt_rad))) > _LEVEL_RAD

    def directed(self, crossings: Crossings) -> Crossings:
        seen = super().directed(crossings)
        self.state.lean.told = has_lines(seen) or self._lines_tell_tilt
        if self.state.lean.told:
            return seen
        shared = view_cov(self.state.lean)
        return replace(seen, cov_base_m2=seen.cov_base_m2 + shared, common_cov_m2=seen.common_cov_m2 + shared)

    def _accept(self, ref: Crossings, crossings: Crossings, course: Course, found: Found, predicted: Motion) -> Motion:
        motion, lean = super()._accept(ref, crossings, course, found, predicted), self.state.lean
        if has_lines(ref) or has_lines(crossings) or found.place is None or self._lines_tell_tilt:
            return motion
        moved = found.place.fit.b_from_a
        learn(lean, points_of(ref), points_of(crossings), moved, course.elapsed_s, self._height_m)
        cov = motion.cov.copy()
        cov[:2, :2] += step_cov(lean)
        return replace(motion, cov=cov)
