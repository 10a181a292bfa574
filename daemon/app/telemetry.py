"""The figures of a running daemon: counters for health, a snapshot for the screen, a summary for the end."""

from __future__ import annotations

import math
import threading
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Any

import numpy as np

from ceilvo.daemon.app.estimator import Estimator
from ceilvo.daemon.integrity.staleness import StalenessMonitor
from ceilvo.daemon.integrity.states import UNUSABLE
from ceilvo.daemon.map.kept.store import Store
from ceilvo.daemon.replay.summary import RunStatistics
from ceilvo.daemon.slam.pose_filter import chi_square_bounds
from ceilvo.drivers.base.link import BaseLink
from ceilvo.drivers.camera.capture import CaptureLoop
from ceilvo.drivers.ports import Publisher, Wire
from ceilvo.json_values import json_value
from ceilvo.types import Array, Estimate, FilterHealth, State

_PATH_POINTS = 400
"""Of the path on the screen; chosen: 20 m of it."""
_PATH_STEP_M = 0.05
"""Between them; chosen: a character of the plot is more."""
_MOVING_MPS, _MOVING_RADPS = 0.02, 0.05
"""A slower robot stands; chosen: above the noise of a standing robot's twist, below any drive."""

Truth = Callable[[int], Array]


def _moving(estimate: Estimate) -> bool:
    """Where the robot stands the same few errors would be counted for as long as it does."""
    vx, vy, omega = estimate.twist
    return bool(np.hypot(vx, vy) > _MOVING_MPS or abs(omega) > _MOVING_RADPS)


@dataclass(frozen=True)
class ShownBase:
    """age_s: since the base last answered, None = never."""

    age_s: float | None = None
    sent: int = 0
    failed: int = 0


@dataclass(frozen=True)
class Snapshot:
    """All that the screen shows, taken at one instant.

    Attributes:
        pose, sigma: map_from_base and its standard deviations, (3,) [m, m, rad].
        truth: (3,) when it is known.
        latency_ms: (median, p99) by stage.
        base: None when the base is disabled; zenoh_samples likewise.
        elsewhere: probability that the robot is at another place.
        landmarks_xy_m, path_xy_m: (L, 2) and (K, 2) for the plot.
        room_m: x_min, y_min, x_max, y_max of the plot; None = what has been seen so far.
        events: newest last.
    """

    title: str = "ceilvo"
    state: State = State.INIT
    reason: str = ""
    quality: float = 0.0
    uptime_s: float = 0.0
    pose: Array = field(default_factory=lambda: np.zeros(3))
    sigma: Array = field(default_factory=lambda: np.zeros(3))
    truth: Array | None = None
    fps: float = 0.0
    frames: int = 0
    drops: int = 0
    latency_ms: Mapping[str, tuple[float, float]] = field(default_factory=lambda: MappingProxyType({}))
    ess_ratio: float = 1.0
    unique_ancestors: int | None = None
    elsewhere: float = 0.0
    particles: int = 0
    nis: float = 0.0
    landmarks: int = 0
    crossings: int = 0
    inliers: int = 0
    base: ShownBase | None = None
    zenoh_samples: int | None = None
    landmarks_xy_m: Array | None = None
    path_xy_m: Array | None = None
    room_m: tuple[float, float, float, float] | None = None
    events: tuple[str, ...] = ()

    @property
    def error(self) -> tuple[float, float] | None:
        """Position (m) and signed heading (rad) error against the truth."""
        if self.truth is None:
            return None
        off = self.pose - self.truth
        turn = (float(off[2]) + math.pi) % (2.0 * math.pi) - math.pi
        return math.hypot(float(off[0]), float(off[1])), turn


class Telemetry:
    """Reads everybody's counters; owns the statistics. Thread-safe."""

    def __init__(
        self,
        estimator: Estimator,
        capture: CaptureLoop,
        base: BaseLink | None,
        bus: Publisher | None,
        truth: Truth | None,
        clock: Callable[[], int],
        seed: int,
        driving_nis: float | None = None,
        store: Store | None = None,
        wires: Sequence[Wire] = (),
    ) -> None:
        self._estimator, self._capture, self._base, self._bus = estimator, capture, base, bus
        self._truth, self._clock, self._store = truth, clock, store
        self._wires = tuple(wires)
        self._started_ns = clock()
        self._stats = RunStatistics(seed)
        self._staleness = StalenessMonitor(driving_nis)
        self._lock = threading.Lock()
        self._path: deque[Array] = deque(maxlen=_PATH_POINTS)

    @property
    def uptime_s(self) -> float:
        return 1e-9 * (self._clock() - self._started_ns)

    def count(self, estimate: Estimate) -> None:
        """Add one frame's estimate, just published."""
        truth = None if self._truth is None else self._truth(estimate.stamp_ns)
        published_ms = 1e-6 * (self._clock() - estimate.stamp_ns)
        with self._lock:
            self._stats.add(estimate, truth)
            self._stats.add_latency("photon_to_published", published_ms)
            if estimate.state in UNUSABLE:
                self._staleness.reset()
            elif estimate.motion.ok and _moving(estimate):
                self._staleness.add(estimate.stamp_ns, estimate.health.nis, estimate.health.nis_dof)
        if not self._path or np.hypot(*(estimate.pose - self._path[-1])[:2]) > _PATH_STEP_M:
            self._path.append(estimate.pose)

    def counters(self) -> dict[str, object]:
        """Every counter of the process, by name, for the health message."""
        capture, rate, last = self._capture.counters(), self._capture.rate, self._estimator.last
        with self._lock:
            fps, latency, stale = self._stats.fps, self._stats.latency(), self._staleness.last
        out: dict[str, object] = {
            "estimate_age_s": None if last is None else 1e-9 * (self._clock() - last.stamp_ns),
            "fps": fps,
            "frames": capture.frames,
            "drops": capture.drops,
            "skipped_frames": capture.skipped,
            "camera_rate_hz": rate.camera_hz,
            "used_rate_hz": 1.0 / rate.used_period_s,
            "every_nth_frame": rate.every_nth,
            "bad_frames": capture.bad_frames,
            "bad_stamps": capture.bad_stamps,
            "repeated_frames": capture.repeats,
            "late_frames": self._estimator.late,
            "camera_connected": capture.connected,
            "camera_losses": capture.losses,
            "camera_reopens": capture.reopens,
            "camera_error": capture.last_error,
            "store_error": "" if self._store is None else self._store.error,
            "calibration_stale": stale.stale,
            "calibration_stale_reason": stale.reason,
            "calibration_mean_nis": json_value(stale.mean_nis),
            "latency_ms": {stage: {"median": median, "p99": p99} for stage, (median, p99) in latency.items()},
        }
        out["filter"] = dict(self._estimator.counters()) | ({} if last is None else _health(last.health))
        out["cross_checks"] = {**self._estimator.suspicions(), "stamp_fault": self._estimator.stamp_fault}
        out["elsewhere"] = self._estimator.elsewhere()
        out["place_search"] = self._estimator.place_search()
        learnt = self._estimator.senses()
        out |= {"senses": json_value(learnt)} if learnt else {}
        if self._base is not None:
            link = self._base.snapshot()
            out |= {
                "base_up": link.up,
                "base_link_age_s": link.link_age_s,
                "base_reconnects": link.reconnects,
                "base_error": link.last_error,
                "telegrams_sent": link.telegrams_sent,
                "telegrams_failed": link.telegrams_failed,
            }
        if self._bus is not None:
            out["zenoh"] = dict(self._bus.counters())
        for wire in self._wires:
            out["ros2"] = dict(wire.counters())
        return out

    def status_line(self, state: State, camera_reason: str) -> str:
        """One line for `systemctl status`."""
        last = self._estimator.last
        if not self._capture.counters().connected:
            return f"{state.name}: {camera_reason}"
        if last is None:
            return f"{state.name}: waiting for the first frame"
        x, y, theta = last.pose
        return f"{state.name} x={x:.2f} m y={y:.2f} m heading={np.degrees(theta):.1f} deg: {last.reason}"

    def snapshot(
        self, title: str, waiting: str, room_m: tuple[float, float, float, float] | None, events: tuple[str, ...]
    ) -> Snapshot:
        """Everything the screen shows; `waiting` is the reason until there is an estimate."""
        capture, landmarks = self._capture.counters(), self._estimator.map()[0]
        link = None if self._base is None else self._base.snapshot()
        with self._lock:
            fps, latency = self._stats.fps, self._stats.latency()
        shown = Snapshot(
            title=title,
            reason=waiting,
            uptime_s=self.uptime_s,
            fps=fps,
            frames=capture.frames,
            drops=capture.drops,
            latency_ms=latency,
            landmarks=len(landmarks),
            landmarks_xy_m=landmarks.xy_map_m,
            path_xy_m=np.array([p[:2] for p in tuple(self._path)]).reshape(-1, 2),
            room_m=room_m,
            base=None if link is None else ShownBase(link.link_age_s, link.telegrams_sent, link.telegrams_failed),
            zenoh_samples=None if self._bus is None else self._bus.counters()["samples"],
            events=events,
        )
        last = self._estimator.last
        return shown if last is None else self._with_estimate(shown, last)

    def _with_estimate(self, shown: Snapshot, last: Estimate) -> Snapshot:
        d = last.health
        return replace(
            shown,
            state=last.state,
            reason=last.reason,
            quality=last.quality,
            pose=last.pose,
            sigma=np.sqrt(np.maximum(np.diag(last.cov), 0.0)),
            truth=None if self._truth is None else self._truth(last.stamp_ns),
            ess_ratio=d.ess / max(d.particles, 1),
            unique_ancestors=d.unique_ancestors,
            elsewhere=self._estimator.elsewhere(),
            particles=d.particles,
            nis=d.nis,
            crossings=last.crossings,
            inliers=last.motion.inliers,
        )

    def summary(self) -> dict[str, Any]:
        """The run's figures so far (build/run-summary.json)."""
        link = None if self._base is None else self._base.snapshot()
        with self._lock:
            return self._stats.summary(
                drops=self._capture.counters().drops,
                telegrams_sent=0 if link is None else link.telegrams_sent,
                telegrams_failed=0 if link is None else link.telegrams_failed,
                zenoh_samples=0 if self._bus is None else self._bus.counters()["samples"],
            )


def _health(d: FilterHealth) -> dict[str, float | None]:
    """FilterHealth and consistency of the last estimate; NIS is of chance between its bounds."""
    low, high = chi_square_bounds(d.nis_dof)
    known = d.nis_dof > 0
    return {
        "particles": d.particles,
        "ess": d.ess,
        "unique_ancestors": d.unique_ancestors,
        "fit_residual": json_value(d.fit_residual),
        "nis": d.nis if known else None,
        "nis_low": low if known else None,
        "nis_high": high if known else None,
        "mode_weight": d.mode_weight,
    }
