"""How a camera reads its rows, from a pan over the ceiling: with the right time between them lines are straightest."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from ceilvo import se2
from ceilvo.calibration import Calibration
from ceilvo.config import Features, Odometry
from ceilvo.daemon.odometry.visual_odometry import VisualOdometry
from ceilvo.daemon.vision.edges import EdgeDetector
from ceilvo.daemon.vision.finder.crossing_finder import CrossingFinder
from ceilvo.daemon.vision.line_detection import detect
from ceilvo.daemon.vision.rolling_shutter import RollingShutter, TwistPrior
from ceilvo.errors import CalibrationError
from ceilvo.types import Array, Frame

MIN_FRAMES = 12
"""With a motion before and after; chosen: sigma comes from how much they differ."""
SLOWEST_PS = 0.15
"""Median speed of the picture's corners, in focal lengths a second; chosen: 20 ms then bend a line by a pixel."""
SIGMA_S = 0.001
"""Of a PASS; chosen: a millisecond moves the ceiling's rim by a millimetre at 1 m/s."""
GLOBAL_S = 0.0005
"""A readout below this is none: the ceiling moves by less than its lines are known to; chosen."""
_STEP_S, _FINE_STEP_S = 0.005, 0.002
"""Between the times that are tried: over all there may be, then about the best; chosen: bends of a pixel and less."""
_FINE_STEPS = 3
"""To either side."""
_FEW_FRAMES, _MANY_FRAMES = 10, 40
"""That the two are tried on, the fastest ones; chosen: enough for the step, and for the sigma wanted."""
_LONGEST_S = 0.1
"""Tried at the most, however slow the frames come."""
_HELD = np.full(3, 1e-6)
"""[m/s, m/s, rad/s] of the twist: as good as exact, so that lines do not choose another."""
_LOST_PX2 = 0.64
"""What an edge point of no line counts: the square of the narrowest gate of line_fit, 0.8 px."""
_RESAMPLINGS = 200
"""Of the frames, for sigma; chosen: it is then known to 5 %."""


@dataclass(frozen=True)
class Shutter:
    """What was found: readout_s as in CameraModel, its sigma, frames used, and the corners' median speed, 1/s."""

    readout_s: float
    sigma_s: float
    frames: int
    speed_ps: float

    @property
    def rolls(self) -> bool:
        """Whether it is a rolling shutter at all."""
        return abs(self.readout_s) > max(GLOBAL_S, 3.0 * self.sigma_s)

    @property
    def text(self) -> str:
        known = f"{1e3 * abs(self.readout_s):.2f} +- {1e3 * self.sigma_s:.2f} ms"
        if not self.rolls:
            return f"global: {known} are none"
        return f"rolling: {known} for all rows, {first_row(self.readout_s)}"

    def problems(self) -> list[str]:
        """What keeps the result from a PASS, with what to do."""
        if self.sigma_s <= SIGMA_S:
            return []
        return [
            f"the readout is known to {1e3 * self.sigma_s:.1f} ms only, {1e3 * SIGMA_S:g} needed: turn faster or longer"
        ]


def first_row(readout_s: float) -> str:
    """Which end of the picture is read first, in words."""
    return f"the {'first' if readout_s > 0 else 'last'} one first"


def measure(calibration: Calibration, frames: list[Frame]) -> Shutter:
    """Readout of the camera that took the frames, in order of time, while the robot turned or drove.

    Raises:
        CalibrationError: too few frames that could be used, or too little motion.
    """
    interval_s = float(np.median(np.diff([f.stamp_ns for f in frames]))) * 1e-9 if len(frames) > 1 else 0.0
    longest_s = min(interval_s, _LONGEST_S)
    moving = _fastest(calibration, frames, 0.0)
    speed_ps = float(np.median([m.speed_ps for m in moving]))
    tried_s: Array = np.arange(np.ceil(-longest_s / _STEP_S), np.floor(longest_s / _STEP_S) + 1) * _STEP_S
    best_s = float(tried_s[np.argmin(_costs(calibration, moving[:_FEW_FRAMES], tried_s).mean(axis=0))])
    # again, with twists that were measured with this readout
    moving = _fastest(calibration, frames, best_s)[:_MANY_FRAMES]
    tried_s = (best_s + _FINE_STEP_S * np.arange(-_FINE_STEPS, _FINE_STEPS + 1)).astype(np.float64)
    costs = _costs(calibration, moving, tried_s)
    found_s = _minimum(tried_s, costs)
    rng = np.random.default_rng(1)
    again = [_minimum(tried_s, costs[rng.integers(0, len(costs), len(costs))]) for _ in range(_RESAMPLINGS)]
    return Shutter(found_s, float(np.std(again)), len(moving), speed_ps)


@dataclass(frozen=True)
class _Moving:
    """A frame, the robot's twist (3,) at its instant, and the speed of the picture's corners, focal lengths per s."""

    frame: Frame
    twist: Array
    speed_ps: float


def _fastest(calibration: Calibration, frames: list[Frame], readout_s: float) -> list[_Moving]:
    """The frames between two measured motions, the fastest first."""
    steps = _motions(_with_readout(calibration, readout_s), frames)
    camera, height_m = calibration.camera, calibration.ceiling_height_m
    reach = float(np.hypot(camera.width_px, camera.height_px)) / (2.0 * camera.focal_px)
    out = []
    for frame, (before, after) in zip(frames[1:-1], pairwise(steps), strict=True):
        if before is not None and after is not None:
            twist = 0.5 * (before + after)
            speed_ps = abs(float(twist[2])) * reach + float(np.hypot(*twist[:2])) / height_m
            out.append(_Moving(frame, twist, speed_ps))
    if len(out) < MIN_FRAMES:
        raise CalibrationError(
            f"shutter: found {len(out)} of {len(frames)} frames between two measured motions, {MIN_FRAMES} needed; "
            "turn more slowly, under a ceiling with lines"
        )
    out.sort(key=lambda m: -m.speed_ps)
    middle_ps = float(np.median([m.speed_ps for m in out]))
    if middle_ps < SLOWEST_PS:
        raise CalibrationError(
            f"shutter: found a picture whose corners move by {middle_ps:.3f} focal lengths a second, at least "
            f"{SLOWEST_PS:g} needed; turn the robot on the spot at 0.3 rad/s or more while pictures are taken"
        )
    return out


def _motions(calibration: Calibration, frames: list[Frame]) -> list[Array | None]:
    """(3,) mean twist from each frame to the next, None where it was not measured."""
    find, odometry = CrossingFinder(calibration, Features()), VisualOdometry(Odometry())
    out: list[Array | None] = []
    last_ns = frames[0].stamp_ns if frames else 0
    for k, frame in enumerate(frames):
        elapsed_s = (frame.stamp_ns - last_ns) * 1e-9
        last_ns = frame.stamp_ns
        seen = find(frame, odometry.expected(elapsed_s), twist=odometry.expected_twist(elapsed_s))
        motion = odometry.step(seen, elapsed_s)
        if k:
            good = motion.ok and not motion.restarted and elapsed_s > 0.0
            out.append(se2.mean_twist(motion.prev_from_curr, elapsed_s) if good else None)
    return out


def _with_readout(calibration: Calibration, readout_s: float) -> Calibration:
    return replace(calibration, camera=replace(calibration.camera, readout_s=readout_s))


def _costs(calibration: Calibration, moving: list[_Moving], tried_s: Array) -> Array:
    """(frames, tried) mean squared distance of edge points from straight lines, px^2."""
    features, focal_px = Features(), calibration.level_view.focal_px
    find_edges = EdgeDetector(calibration, features)
    out = np.empty((len(moving), len(tried_s)))
    for k, readout_s in enumerate(tried_s):
        shutter = RollingShutter(_with_readout(calibration, float(readout_s)), features.max_view_deg)
        for i, m in enumerate(moving):
            readout = shutter.readout(TwistPrior(m.twist, _HELD))
            edges = find_edges(m.frame.gray, readout)
            found = detect(edges, features, focal_px, readout=readout)
            points = len(edges.uv_px)
            fitted = 0 if found is None else len(found[0].points)
            off_px2 = 0.0 if found is None else fitted * found[1].noise_px ** 2
            out[i, k] = (off_px2 + (points - fitted) * _LOST_PX2) / max(points, 1)
    return out


def _minimum(tried_s: Array, costs: Array) -> float:
    """Where the parabola through the mean costs is least; no further than what was tried."""
    bend, slope, _ = np.polyfit(tried_s - tried_s.mean(), costs.mean(axis=0), 2)
    if bend <= 0.0:
        return float(tried_s[np.argmin(costs.mean(axis=0))])
    return float(np.clip(tried_s.mean() - 0.5 * slope / bend, tried_s[0], tried_s[-1]))
