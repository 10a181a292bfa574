"""A robot that drives laps while faults come and go, and what its daemon says of the pose."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from ceilvo import se2
from ceilvo.bench.faults.crossing_log import RATE_HZ, CrossingLog
from ceilvo.config import Config
from ceilvo.daemon.pipeline import Pipeline
from ceilvo.drivers.base.wheel_track import WheelNoise
from ceilvo.types import Array, Crossings, Estimate, Pose, State, WheelMotion

Kind = Literal[
    "dark", "silent", "stale picture", "slip", "no wheels", "restart", "carried", "dark and slip", "dark, no wheels"
]
KINDS: tuple[Kind, ...] = (
    "dark", "silent", "stale picture", "slip", "no wheels", "restart", "dark and slip", "dark, no wheels",
)  # fmt: skip
WRONG_M = 0.3
"""A pose further off is wrong."""
_HELP_AFTER_S = 60.0
"""An operator puts a robot right that has been wrong or searching for as long."""
_MEAN_BETWEEN_S = 30.0  # of the exponential pause after a fault, 5 s more at least; chosen: about one each half minute
_PERIOD_NS = round(1e9 / RATE_HZ)  # derived
_RESTART_SIGMA = np.array([0.05, 0.05, 0.05])  # m, m, rad, added to a stored pose: as daemon/app/estimator.py
_SAVED_EVERY_S = 10.0  # as service.state_period_s
_NEWS = 8  # faults and changes of state kept for a report; chosen: what led to a wrong pose, in one line


@dataclass
class Tally:
    """Seconds and events of a drive.

    Attributes:
        wrong_s: by state, seconds with a pose that is more than WRONG_M off.
        wrong_events: times that a pose in TRACKING became wrong, by the kind of the last fault; reports: each, and each
            false LOST, with what led to it.
        false_lost: entries into LOST with a pose that was right; true_lost: with one that was wrong; blind_lost: while
            neither camera nor wheels said anything and until the first motion after that, so that nobody could know.
    """

    seconds: float = 0.0
    state_s: dict[str, float] = field(default_factory=dict)
    wrong_s: dict[str, float] = field(default_factory=dict)
    faults: dict[str, int] = field(default_factory=dict)
    wrong_events: dict[str, int] = field(default_factory=dict)
    reports: list[str] = field(default_factory=list)
    false_lost: int = 0
    true_lost: int = 0
    blind_lost: int = 0
    helped: int = 0
    worst_tracking_m: float = 0.0

    def add(self, other: Tally) -> None:
        for name in ("seconds", "false_lost", "true_lost", "blind_lost", "helped"):
            setattr(self, name, getattr(self, name) + getattr(other, name))
        self.worst_tracking_m = max(self.worst_tracking_m, other.worst_tracking_m)
        self.reports += other.reports
        for name in ("state_s", "wrong_s", "faults", "wrong_events"):
            mine, theirs = getattr(self, name), getattr(other, name)
            for key, value in theirs.items():
                mine[key] = mine.get(key, 0) + value


class Drive:
    """One robot on one log."""

    def __init__(self, log: CrossingLog, config: Config, seed: int, kinds: tuple[Kind, ...] = KINDS) -> None:
        self._log, self._config, self._kinds = log, config, kinds
        self._rng = np.random.default_rng([seed, 6])
        self._seed = seed
        self._k = int(self._rng.integers(log.frames))
        self._take = 0
        self._ns = 10**9
        self._fault: Kind | None = None
        self._last_fault = "none"
        self._until_ns = 0
        self._next_ns = self._ns + 30 * 10**9
        self._trouble_ns: int | None = None
        self._was_wrong = self._blind = False
        self._state = State.INIT
        self._news: deque[str] = deque(maxlen=_NEWS)
        self._saved: tuple[Pose, Array] | None = None
        self._saved_ns = 0
        self._wheel_k = self._k
        self.tally = Tally()
        self._pipeline = self._fresh()
        self._at_truth()

    def run(self, seconds: float) -> Tally:
        for _ in range(round(seconds * RATE_HZ)):
            self._tick()
        return self.tally

    def _fresh(self) -> Pipeline:
        return Pipeline(self._log.calibration, self._config, self._rng.spawn(1)[0])

    def _at_truth(self) -> None:
        self._pipeline.reset(keep_map=False)
        following = self._log.truth[(self._k + 1) % self._log.frames]  # its first frame is the next one
        self._pipeline.set_pose(following, np.diag([1e-6, 1e-6, 1e-6]), "put right")
        self._state, self._trouble_ns, self._was_wrong = State.INIT, None, False
        self._wheel_k = self._k

    def _truth(self) -> Array:
        return np.asarray(self._log.truth[self._k])

    def _tick(self) -> None:
        """One frame period."""
        self._ns += _PERIOD_NS
        if self._fault != "carried":
            self._move()
        self._begin_or_end()
        wheels = self._wheels()
        dark = self._fault in ("dark", "dark and slip", "dark, no wheels", "carried")
        if self._fault == "restart":
            self.tally.seconds += 1.0 / RATE_HZ
            return
        if self._fault == "silent":
            estimate = self._pipeline.step_crossings(self._ns, None, wheels, missing="the camera gives no frames")
        else:
            estimate = self._pipeline.step_crossings(self._ns, None if dark else self._seen(), wheels)
        self._wheel_k = self._k
        self._count(estimate)
        if self._ns - self._saved_ns > _SAVED_EVERY_S * 1e9 and len(self._pipeline.filter.landmarks()):
            self._saved, self._saved_ns = (estimate.pose, estimate.cov), self._ns

    def _move(self) -> None:
        self._k += 1
        if self._k == self._log.frames:
            self._k, self._take = 0, int(self._rng.integers(len(self._log.crossings)))

    def _seen(self) -> Crossings | None:
        k = self._k
        if self._fault == "stale picture" and self._rng.random() < 0.15:
            k = (k - int(self._rng.integers(3, 20))) % self._log.frames
        return self._log.crossings[self._take][k]

    def _wheels(self) -> WheelMotion | None:
        """What a base reports of the way since the last estimate, errors included."""
        if self._fault in ("no wheels", "dark, no wheels"):
            return None
        here = self._log.truth[self._wheel_k] if self._fault != "carried" else self._truth()
        true = se2.between(here, self._truth())
        length, n = float(np.hypot(true[0], true[1])), WheelNoise()
        var_xy = n.slip_m2_per_m * length + 1e-10
        var_theta = n.turn_rad2_per_m * length + n.turn_rad2_per_rad * abs(float(true[2])) + 1e-12
        cov = np.diag([var_xy, var_xy, var_theta])
        said = true + self._rng.standard_normal(3) * np.sqrt(np.diag(cov))
        if self._fault in ("slip", "dark and slip"):
            said = said + np.array([self._slip * true[0], 0.0, 0.0])
        return WheelMotion(said, cov)

    def _begin_or_end(self) -> None:
        if self._fault is not None:
            if self._ns >= self._until_ns:
                self._end()
        elif self._ns >= self._next_ns:
            self._begin(self._kinds[int(self._rng.integers(len(self._kinds)))])

    def _begin(self, kind: Kind) -> None:
        longest = {"restart": 5.0, "carried": 8.0, "stale picture": 3.0}.get(kind, 10.0)
        lasts_s = float(self._rng.uniform(0.3, longest))
        self._fault, self._last_fault = kind, kind
        self._news.append(f"{self.tally.seconds:.1f} {kind} for {lasts_s:.1f} s")
        self._until_ns = self._ns + round(1e9 * lasts_s)
        self._slip = float(self._rng.uniform(0.1, 1.0))
        self.tally.faults[kind] = self.tally.faults.get(kind, 0) + 1

    def _end(self) -> None:
        kind, self._fault = self._fault, None
        self._next_ns = self._ns + round(1e9 * float(self._rng.exponential(_MEAN_BETWEEN_S))) + 5 * 10**9
        if kind == "carried":
            self._k = int(self._rng.integers(self._log.frames))
            self._wheel_k = self._k
        elif kind == "restart":
            self._restart()

    def _restart(self) -> None:
        """Another process with the stored map and the stored pose, which may be 10 s old."""
        landmarks, axis = self._pipeline.landmarks(), self._pipeline.relocaliser.state.map_axis_rad
        self._pipeline = self._fresh()
        self._wheel_k = self._k
        self._state = State.INIT
        if self._saved is None or axis is None or not len(landmarks):
            self._at_truth()
            return
        pose, cov = self._saved
        self._pipeline.load_map(landmarks, axis, pose, cov + np.diag(_RESTART_SIGMA**2))

    def _count(self, e: Estimate) -> None:
        t, dt = self.tally, 1.0 / RATE_HZ
        off = float(np.hypot(*(e.pose - self._truth())[:2]))
        wrong = off > WRONG_M
        t.seconds += dt
        self._blind = self._fault == "dark, no wheels" or (self._blind and not e.motion.ok)
        t.state_s[e.state.name] = t.state_s.get(e.state.name, 0.0) + dt
        if wrong:
            t.wrong_s[e.state.name] = t.wrong_s.get(e.state.name, 0.0) + dt
        if e.state is State.TRACKING:
            t.worst_tracking_m = max(t.worst_tracking_m, off)
            if wrong and not self._was_wrong:
                self._was_wrong = True
                t.wrong_events[self._last_fault] = t.wrong_events.get(self._last_fault, 0) + 1
                t.reports.append(f"seed {self._seed} {t.seconds:.1f} s, {off:.2f} m off: {'; '.join(self._news)}")
        if not wrong:
            self._was_wrong = False
        if e.state is State.LOST and self._state is not State.LOST:
            name = "blind_lost" if self._blind else "true_lost" if wrong else "false_lost"
            setattr(t, name, getattr(t, name) + 1)
            if name == "false_lost":
                t.reports.append(
                    f"seed {self._seed} {t.seconds:.1f} s, false LOST ({e.reason}): {'; '.join(self._news)}"
                )
        if e.state is not self._state:
            self._news.append(f"{t.seconds:.1f} {e.state.name} {off:.2f} m ({e.reason})")
        self._state = e.state
        trouble = wrong or e.state in (State.LOST, State.RELOCALISING)
        if not trouble:
            self._trouble_ns = None
        elif self._trouble_ns is None:
            self._trouble_ns = self._ns
        elif self._ns - self._trouble_ns > _HELP_AFTER_S * 1e9 and self._fault is None:
            t.helped += 1
            self._at_truth()
