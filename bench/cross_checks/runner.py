"""Odometry and checks over a drive, with a fault that begins at some moment."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from ceilvo import se2
from ceilvo.bench.cross_checks.drives import Eye, Path, wheel_motion
from ceilvo.config import Config
from ceilvo.daemon.odometry.cross_checks.checks import CrossChecks
from ceilvo.daemon.odometry.cross_checks.suspicion import Suspicions
from ceilvo.daemon.odometry.visual_odometry import VisualOdometry
from ceilvo.sim.rig import simulated_calibration
from ceilvo.types import Array, Crossings, Motion, WheelMotion


@dataclass(frozen=True)
class Fault:
    """What is wrong from begin_s until end_s.

    Attributes:
        picture: "frozen" (one picture), "frozen noisy" (one place, new noise), "ring 2" to "ring 8", "dark", "silent".
        picture_s: how long that lasts, if not to the end.
        yaw_rad: by which the camera was bumped.
        late_s: by which pictures are late.
        wheels_stand: the wheels count nothing, so the robot is carried.
        spin_mps: the wheels turn so fast, and the robot stays.
        no_wheels: the base is silent.
    """

    begin_s: float = np.inf
    end_s: float = np.inf
    picture: str = ""
    picture_s: float = np.inf
    yaw_rad: float = 0.0
    late_s: float = 0.0
    wheels_stand: bool = False
    spin_mps: float = 0.0
    no_wheels: bool = False


@dataclass
class Step:
    """One frame: time, what is suspected, the motion, and the true motion since the frame before."""

    time_s: float
    suspicions: Suspicions
    motion: Motion
    true_motion: Array
    wheels: WheelMotion | None
    failure: str = field(default="")


def run(path: Path, config: Config, rng: np.random.Generator, fault: Fault | None = None) -> Iterator[Step]:
    """Every frame of a drive."""
    calibration, fault = simulated_calibration(), fault or Fault()
    eye, odometry, checks = Eye(calibration, rng), VisualOdometry(config.odometry), CrossChecks(config)
    ring: deque[Crossings] = deque(maxlen=8)
    before_s = None
    for k in range(len(path.time_s)):
        now_s = float(path.time_s[k])
        on = fault.begin_s <= now_s < fault.end_s
        wrong = fault.picture if on and now_s < fault.begin_s + fault.picture_s else ""
        crossings = _picture(path, eye, ring, now_s, fault, on, wrong, rng)
        if wrong == "silent":
            continue
        elapsed_s = 0.0 if before_s is None else now_s - before_s
        wheels = None if before_s is None else _wheels(path, before_s, now_s, fault, on)
        usable = checks.admit(crossings, wheels, elapsed_s)
        motion = odometry.step(usable.crossings, elapsed_s, usable.wheels, usable.missing or "dark")
        suspicions = checks.step(round(now_s * 1e9), crossings, motion, wheels, elapsed_s)
        true = np.zeros(3) if before_s is None else se2.between(path.truth_at(before_s), path.truth_at(now_s))
        yield Step(now_s, suspicions, motion, true, wheels, motion.failure or "")
        before_s = now_s


def _picture(
    path: Path,
    eye: Eye,
    ring: deque[Crossings],
    now_s: float,
    fault: Fault,
    on: bool,
    wrong: str,
    rng: np.random.Generator,
) -> Crossings | None:
    if wrong in ("dark", "silent"):
        return None
    if wrong == "frozen":
        return ring[-1]
    if wrong.startswith("ring"):
        _shorten(ring, int(wrong.split()[1]))
        ring.rotate(-1)
        return ring[-1]
    stands = on and (wrong == "frozen noisy" or fault.spin_mps)
    at_s = fault.begin_s if stands else now_s - (fault.late_s if on else 0.0)
    pose = path.truth_at(max(at_s, 0.0)) + np.array([*rng.normal(0.0, path.spec.shake_m, 2), 0.0])
    ring.append(eye.see(pose, fault.yaw_rad if on else 0.0))
    return ring[-1]


def _shorten(ring: deque[Crossings], size: int) -> None:
    while len(ring) > size:
        ring.popleft()


def _wheels(path: Path, from_s: float, to_s: float, fault: Fault, on: bool) -> WheelMotion | None:
    if on and fault.no_wheels:
        return None
    said = wheel_motion(path, from_s, to_s)
    if on and fault.wheels_stand:
        return WheelMotion(np.zeros(3), np.diag([1e-9, 1e-9, 1e-11]))  # type: ignore[arg-type]
    if on and fault.spin_mps:
        return WheelMotion(np.array([fault.spin_mps * (to_s - from_s), 0.0, 0.0]), said.cov)  # type: ignore[arg-type]
    return said
