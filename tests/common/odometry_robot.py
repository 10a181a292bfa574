"""A robot below a simulated ceiling that knows its odometry alone, with the truth beside it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from ceilvo import se2
from ceilvo.config import Odometry
from ceilvo.daemon.odometry.dead_reckoning import DeadReckoning, Track
from ceilvo.daemon.odometry.visual_odometry import VisualOdometry
from ceilvo.types import Crossings, Motion, WheelMotion

RATE_HZ = 15.0


class Camera(Protocol):
    """Sees crossings from map_from_base (3,), as crossing_camera.py does."""

    def sees(self, pose: np.ndarray, seed: int) -> Crossings: ...


def wheels_of(true: np.ndarray, rng: np.random.Generator) -> WheelMotion:
    length = float(np.hypot(true[0], true[1]))
    cov = np.diag([1e-4 * length + 1e-9] * 2 + [1e-4 * length + 4e-4 * abs(true[2]) + 1e-9])
    return WheelMotion(true + rng.normal(size=3) * np.sqrt(np.diag(cov)), cov)


@dataclass
class Robot:
    """Odometry of a robot below a ceiling, with the truth beside it."""

    camera: Camera
    pose: np.ndarray
    rate_hz: float = RATE_HZ

    def __post_init__(self) -> None:
        self.vo, self.path = VisualOdometry(Odometry()), DeadReckoning(np.zeros((3, 3)))
        self.anchor, self.at_s, self.frames = self.pose, 1.0, 0
        self.rng = np.random.default_rng(77)

    def step(
        self, pose: np.ndarray, dt_s: float | None = None, dark: bool = False, wheels: bool | np.ndarray = False
    ) -> tuple[Motion, Track]:
        """One frame at a pose; wheels: True for what they really do, or (3,) what they say."""
        dt_s = 1.0 / self.rate_hz if dt_s is None else dt_s
        said = None
        if wheels is not False:
            said = wheels_of(se2.between(self.pose, pose) if wheels is True else wheels, self.rng)
        seen = None if dark else self.camera.sees(pose, self.frames)
        motion = self.vo.step(seen, dt_s if self.frames else 0.0, said)
        self.at_s += dt_s
        track = self.path.advance(round(1e9 * self.at_s), motion)
        self.frames, self.pose = self.frames + 1, pose
        return motion, track

    def error(self, track: Track) -> np.ndarray:
        """(3,) of the motion since the last final one; a final one begins the next."""
        motion = track.final or track.gap
        assert motion is not None
        off = se2.between(self.anchor, self.pose) - motion.prev_from_curr
        off[2] = se2.wrap(off[2])
        if track.final is not None:
            self.anchor = self.pose
        return off

    def drive(self, poses: list[np.ndarray], **how: bool) -> list[Motion]:
        out = []
        for p in poses:
            motion, track = self.step(p, **how)
            self.error(track)
            out.append(motion)
        return out
