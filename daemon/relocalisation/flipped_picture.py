"""A picture that is flipped on its way from the camera: the robot seems to have turned by half a turn at once.

Without wheels nothing else says that it did not, and the map bears it out. So no place is right then but one that is
turned back, until the picture turns back, or the robot has driven on as before: then it was turned after all.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from ceilvo.daemon.odometry.dead_reckoning import Track
from ceilvo.daemon.relocalisation.doubts import Doubt
from ceilvo.daemon.relocalisation.lattice import offset, rival_from_tracked, rival_poses
from ceilvo.se2 import compose, rotation, wrap
from ceilvo.types import Array

HALF_RAD, TURNED_RAD = 0.15, 0.5
"""A flipped picture turns by half a turn, and so nearly; of a turn less is left when it is as it was; chosen: what a
robot may have turned meanwhile besides what was foreseen."""
FLIPPED_M, FLIP_S = 0.3, 1.0
"""So near to where it was foreseen a camera is that went its way; and so long odometry takes at most to begin anew, in
which few hands turn a robot by just half a turn; chosen: half a tile of 0.6 m."""
WAY_M, MOST_WAY_M = 1.0, 10.0
"""Driven ahead, or backwards, that tells a robot which was turned from a picture that was, and how much of the way
before is remembered; chosen: few robots back up for longer."""
TURNS_BACK = 0.5
"""Chance that a picture which was flipped is as it was, once another view fits nothing before; chosen."""


@dataclass(slots=True)
class FlippedPicture:
    """What is remembered of it.

    Attributes:
        turned_rad: by how much the picture is turned against how the robot stands; 0: it is not.
        place: (N, 3) place_from_tracked where a flip would put the robot, while the doubt is one of a jump.
        forward_m, since_m: way ahead of late, less what was driven backwards; the same way since the picture turned.
        times: how often it did.
    """

    turned_rad: float = 0.0
    place: Array = field(default_factory=lambda: np.zeros((0, 3)))
    forward_m: float = 0.0
    since_m: float = 0.0
    times: int = 0

    def forget(self) -> None:
        """Somebody says where the robot is."""
        self.turned_rad, self.place = 0.0, self.place[:0]

    def follow(self, track: Track) -> None:
        """Note half a turn from one view to the next, sooner than a hand turns a robot so; and which way it drives."""
        if track.final is None or not track.bridged:
            return
        turned_rad = float(track.final.prev_from_curr[2])
        unforeseen_rad = turned_rad - float(track.blind[2])  # 0 where no frame failed: then they measured both
        turned_rad = wrap(unforeseen_rad or turned_rad)
        if np.pi - abs(turned_rad) < HALF_RAD and track.blind_s <= FLIP_S:
            self._turn(turned_rad)
        ahead_m = float(track.final.prev_from_curr[0])
        if not self.turned_rad:
            self.forward_m = min(max(self.forward_m + ahead_m, -MOST_WAY_M), MOST_WAY_M)
        elif abs(self.forward_m) >= WAY_M:  # one that was turned drives on as before, one that is seen flipped backs up
            self.since_m += ahead_m * float(np.sign(self.forward_m))
            self.turned_rad = self.turned_rad if self.since_m < WAY_M else 0.0

    def _turn(self, angle_rad: float) -> None:
        left_rad = wrap(self.turned_rad + angle_rad)
        self.turned_rad, self.since_m = (left_rad if abs(left_rad) > TURNED_RAD else 0.0), 0.0
        self.times += self.turned_rad != 0.0

    def turns_back(self, place: Array) -> bool:
        """Whether the robot stands at a place (3,) as it did before the picture turned, or it did not turn."""
        return not self.turned_rad or abs(wrap(float(place[2]) + self.turned_rad)) < TURNED_RAD

    def doubted(self, doubt: Doubt, first: bool, expected: Array, pose: Array, mount_xy_m: Array) -> Array:
        """Take in a doubt; (N, 3) place_from_tracked of a robot whose turned picture is as it was, none while it is not
        turned: then a flip is what may have put the robot there.

        Args:
            first: the place was sure before.
            expected: (3,) where the robot should be; pose: (3,) where it is tracked.
            mount_xy_m: (2,) of the camera in base, about whose axis the picture turns.
        """
        angle_rad = -self.turned_rad or np.pi
        about = np.array([*(mount_xy_m - rotation(angle_rad) @ mount_xy_m), angle_rad])
        there = rival_from_tracked(np.asarray(compose(expected, about))[None], pose)
        if self.turned_rad:
            self.place = self.place[:0]
            return there
        if doubt.jumped_within(FLIP_S):
            self.place = there
        elif first:
            self.place = self.place[:0]
        return there[:0]

    def found(self, there: Array, tracked: Array) -> None:
        """The robot, tracked at a pose (3,), was found at another one."""
        if self.turns_back(there - tracked):
            self.turned_rad = 0.0
        if len(self.place):
            off = offset(rival_poses(self.place, tracked)[0], there)
            if np.hypot(off[0], off[1]) < FLIPPED_M and abs(off[2]) < HALF_RAD:
                self._turn(np.pi)
        self.place = self.place[:0]
