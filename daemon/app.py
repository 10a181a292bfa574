"""The process: stages joined to drivers, threads, signals, health and the way it ends.

    capture thread -> estimator thread -> base (its own thread), Zenoh (does not block)
    main thread: screen, health, saving, systemd, end

A thread that dies takes the process down with its cause; systemd starts it again.
"""

from __future__ import annotations

import json
import logging
import queue
import signal
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from types import FrameType
from typing import Any

import cv2
import numpy as np

from ceilvo.calibration import Calibration
from ceilvo.calibration_check import check_fits
from ceilvo.config import Config
from ceilvo.daemon.estimator import Estimator, no_wheels
from ceilvo.daemon.overlay import draw_overlay
from ceilvo.daemon.pipeline import Pipeline
from ceilvo.daemon.replay import Outputs, format_replay, replay
from ceilvo.daemon.screen import BaseLink as ScreenBase
from ceilvo.daemon.screen import Screen, Snapshot
from ceilvo.daemon.store import Store
from ceilvo.daemon.summary import RunStatistics, format_summary
from ceilvo.daemon.trajectory import (
    Alignment,
    TrajectoryError,
    format_error,
    match_stamps,
    read_tum,
    trajectory_error,
)
from ceilvo.drivers import commands, wire
from ceilvo.drivers.base_link import BaseLink
from ceilvo.drivers.cameras import make_camera, source_camera
from ceilvo.drivers.capture import CaptureEvent, CaptureLoop
from ceilvo.drivers.modbus_base import ModbusBase
from ceilvo.drivers.ports import Camera
from ceilvo.drivers.requests import Handlers, Result
from ceilvo.drivers.systemd_notify import Notifier
from ceilvo.drivers.watch import WatchOptions, watch
from ceilvo.drivers.wire import Topic
from ceilvo.drivers.zenoh_bus import ZenohBus
from ceilvo.errors import CeilvoError, FileFormatError
from ceilvo.files import write_atomic
from ceilvo.types import Array, Estimate, Frame, State

log = logging.getLogger("ceilvo")

_TICK_S = 0.05
_SILENT_FRAMES = 3.0
_COAST_PERIOD_S = 0.1
_PATH_POINTS = 400
_EVENTS = 20
_STOP_S = 1.5
_REFERENCE_TOLERANCE_NS = 10_000_000

Truth = Callable[[int], Array]


@dataclass(frozen=True)
class Plan:
    """What to run.

    Attributes:
        camera: not opened.
        truth: map_from_base (3,) at a stamp, where a simulator knows it.
        room_m: x_min, y_min, x_max, y_max for the screen's plot.
        seconds: end after this much time with frames; None = run until told to stop.
        summary_file: where to write the run's figures as JSON.
        screen: draw the live screen.
    """

    config: Config
    calibration: Calibration
    camera: Camera
    truth: Truth | None = None
    room_m: tuple[float, float, float, float] | None = None
    seconds: float | None = None
    summary_file: Path | None = None
    screen: bool = False


class Daemon:
    """One robot's localisation, wired and running."""

    def __init__(self, plan: Plan, notifier: Notifier, clock: Callable[[], int] = time.monotonic_ns) -> None:
        config = plan.config
        self._plan, self._config, self._notifier, self._clock = plan, config, notifier, clock
        self._stop = threading.Event()
        self._crashes: queue.SimpleQueue[BaseException] = queue.SimpleQueue()
        self.events: deque[str] = deque(maxlen=_EVENTS)
        self._started_ns = clock()
        self._noted: Estimate | None = None
        self._first_frame_ns: int | None = None
        self._camera_reason = "camera not opened yet"
        self._stats = RunStatistics(config.service.seed)
        self._stats_lock = threading.Lock()
        self._path: deque[Array] = deque(maxlen=_PATH_POINTS)
        self._store = Store.choose(config.service.state_dir)
        self._base = BaseLink(config.base, ModbusBase(config.base), clock, self._crash) if config.base.enabled else None
        rng = np.random.default_rng(config.service.seed)
        self._estimator = Estimator(
            Pipeline(plan.calibration, config, rng),
            clock,
            self._base.wheels.between if self._base is not None and config.base.use_wheels else no_wheels,
        )
        self._bus = ZenohBus(config.zenoh, config.robot.name, self._handlers()) if config.zenoh.enabled else None
        self._capture = CaptureLoop(plan.camera, config.camera, clock, self._on_capture, self._crash)
        self._thread = threading.Thread(target=self._estimate, name="estimator", daemon=True)

    # -- life

    def run(self) -> dict[str, Any]:
        """Run until stopped, the recording ends or `seconds` are over; returns the summary.

        Raises:
            CeilvoError: what took the process down.
        """
        stored = self._store.load()
        if stored is not None:
            self._estimator.start_from(*stored)
            self._event("map", "stored map loaded; the last pose is a hypothesis until landmarks confirm it")
        with ExitStack() as ending:
            ending.enter_context(_signals(self._stop))
            if self._bus is not None:
                self._bus.open()
                ending.callback(self._bus.close)
            ending.callback(self._end)
            self._capture.start()
            if self._base is not None:
                self._base.start()
            self._thread.start()
            self._notifier.ready("waiting for the camera")
            with Screen() if self._plan.screen else _no_screen() as screen:
                self._supervise(screen)
            summary = self.summary()
        if not self._crashes.empty():
            raise self._crashes.get()
        return summary

    def stop(self) -> None:
        """Ask for an orderly end; from any thread."""
        self._stop.set()

    def _supervise(self, screen: Screen | None) -> None:
        """Everything slow and periodic, until somebody says stop."""
        health = save = self._clock()
        while not self._stop.wait(_TICK_S):
            now = self._clock()
            if not self._crashes.empty() or self._is_over(now):
                break
            if now >= health:
                health = now + int(1e9 * self._config.zenoh.health_period_s)
                self._tell_health()
            if now >= save:
                save = now + int(1e9 * self._config.service.state_period_s)
                self._save()
            if screen is not None:
                screen.update(self.snapshot)

    def _is_over(self, now_ns: int) -> bool:
        if self._capture.finished and not self._thread.is_alive():
            return True
        seconds, first = self._plan.seconds, self._first_frame_ns
        return seconds is not None and first is not None and now_ns - first >= int(1e9 * seconds)

    def _end(self) -> None:
        """Stop, flush, persist; the base hears of it in a last telegram."""
        self._notifier.stopping("stopping")
        self._stop.set()
        self._capture.stop(_STOP_S)
        if self._thread.ident is not None:
            self._thread.join(_STOP_S)
        self._save()
        self._tell_health(State.STOPPED)
        if self._base is not None:
            self._base.stop()

    def _crash(self, error: BaseException) -> None:
        self._crashes.put(error)

    # -- the estimator thread

    def _estimate(self) -> None:
        try:
            while not self._stop.is_set():
                if not self._one():
                    return
                self._notifier.watchdog()
        except Exception as e:
            self._crash(e)

    def _one(self) -> bool:
        """One frame, or one look at a camera that is silent; False at the end of a recording."""
        frame = self._capture.take(self._patience_s())
        if frame is None:
            if self._capture.finished:
                return False
            info = self._capture.info
            if info is None or info.live:
                estimate = self._estimator.silence(self._camera_reason)
                if estimate is not None:
                    self._publish(estimate)
            return True
        if self._first_frame_ns is None:
            self._first_frame_ns = self._clock()
        estimate = self._estimator.frame(frame)
        if estimate is not None:
            self._publish(estimate)
            self._count(estimate)
        return True

    def _patience_s(self) -> float:
        """How long a frame may be late before that is news."""
        last = self._estimator.last
        if last is not None and last.motion.failure == self._camera_reason:
            return _COAST_PERIOD_S
        info = self._capture.info
        rate_hz = info.rate_hz if info is not None and info.rate_hz > 0 else self._config.camera.rate_hz
        return max(self._config.states.dead_reckoning_s, _SILENT_FRAMES / rate_hz)

    def _publish(self, estimate: Estimate) -> None:
        if self._base is not None:
            self._base.submit(estimate)
        if self._bus is not None:
            robot, now_ns = self._config.robot.name, self._clock()
            unix_ns = time.time_ns() - (now_ns - estimate.stamp_ns)
            self._bus.put(Topic.POSE, wire.encode_pose(robot, estimate, unix_ns, now_ns))
            self._bus.put(Topic.ODOM, wire.encode_odom(robot, estimate, unix_ns))
            self._offer_pictures(robot, estimate.seq, wire.Stamp(estimate.stamp_ns, unix_ns))
        self._note_state(estimate)

    def _offer_pictures(self, robot: str, seq: int, stamp: wire.Stamp) -> None:
        bus = self._bus
        if bus is None or not any(bus.wanted(t) for t in (Topic.LANDMARKS, Topic.PARTICLES, Topic.IMAGE)):
            return
        shown = self._estimator.shown()
        bus.offer(Topic.LANDMARKS, lambda: wire.encode_landmarks(robot, stamp, shown.landmarks))
        bus.offer(Topic.PARTICLES, lambda: wire.encode_particles(robot, seq, stamp, shown.particles, shown.weights))
        view = shown.view
        if view is not None:
            level = self._plan.calibration.level_view
            bus.offer(Topic.IMAGE, lambda: _jpeg(draw_overlay(view.frame.gray, view.lines, view.crossings, level)))

    def _note_state(self, estimate: Estimate) -> None:
        if self._noted is not None and self._noted.state is estimate.state:
            self._noted = estimate
            return
        before = "start" if self._noted is None else self._noted.state.name
        self._noted = estimate
        level = logging.INFO if estimate.state is State.TRACKING else logging.WARNING
        self._event("state", f"{before} -> {estimate.state.name}: {estimate.reason}", level)

    def _count(self, estimate: Estimate) -> None:
        truth = None if self._plan.truth is None else self._plan.truth(estimate.stamp_ns)
        published_ms = 1e-6 * (self._clock() - estimate.stamp_ns)
        with self._stats_lock:
            self._stats.add(estimate, truth)
            self._stats.add_latency("photon_to_published", published_ms)
        if not self._path or np.hypot(*(estimate.pose - self._path[-1])[:2]) > 0.05:
            self._path.append(estimate.pose)

    # -- what is told

    def _on_capture(self, event: CaptureEvent) -> None:
        """Called in the capture thread; a calibration that does not fit the opened camera ends the process."""
        if event.kind == "opened":
            info = self._capture.info
            if info is not None:
                check_fits(self._plan.calibration, info.name, info.camera_id, info.width_px, info.height_px)
            self._notifier.status(f"camera: {event.text}")
        if event.kind in ("lost", "bad_frame"):
            self._camera_reason = event.text
        level = logging.WARNING if event.kind == "lost" else logging.INFO
        self._event(f"camera_{event.kind}", f"camera {event.kind}: {event.text}", level)

    def _event(self, name: str, text: str, level: int = logging.INFO) -> None:
        log.log(level, "%s", text)
        self.events.append(text)
        if self._bus is not None:
            stamp = wire.Stamp(self._clock(), time.time_ns())
            severity = logging.getLevelName(level).lower()
            self._bus.put(Topic.EVENT, wire.encode_event(self._config.robot.name, stamp, name, severity, text))

    def _tell_health(self, state: State | None = None) -> None:
        last = self._estimator.last
        now = State.INIT if last is None else last.state
        state = now if state is None else state
        age_s = None if last is None else 1e-9 * (self._clock() - last.stamp_ns)
        self._notifier.status(self._status_line(state, last))
        if self._bus is None:
            return
        stamp = wire.Stamp(self._clock(), time.time_ns())
        uptime_s = 1e-9 * (self._clock() - self._started_ns)
        counters = {**self._counters(), "estimate_age_s": age_s}
        self._bus.put(Topic.HEALTH, wire.encode_health(self._config.robot.name, stamp, uptime_s, state, counters))

    def _status_line(self, state: State, last: Estimate | None) -> str:
        if not self._capture.counters().connected:
            return f"{state.name}: {self._camera_reason}"
        if last is None:
            return f"{state.name}: waiting for the first frame"
        x, y, theta = last.pose
        return f"{state.name} x={x:.2f} m y={y:.2f} m heading={np.degrees(theta):.1f} deg: {last.reason}"

    def _counters(self) -> dict[str, object]:
        capture = self._capture.counters()
        with self._stats_lock:
            fps, latency = self._stats.fps, self._stats.latency()
        out: dict[str, object] = {
            "fps": fps,
            "frames": capture.frames,
            "drops": capture.drops,
            "bad_frames": capture.bad_frames,
            "camera_losses": capture.losses,
            "camera_reopens": capture.reopens,
            "camera_connected": capture.connected,
            "camera_error": capture.last_error,
            "late_frames": self._estimator.late,
            "latency_ms": {k: {"median": m, "p99": p} for k, (m, p) in latency.items()},
        }
        if self._base is not None:
            link = self._base.snapshot()
            out |= {
                "base_up": link.up,
                "telegrams_sent": link.telegrams_sent,
                "telegrams_failed": link.telegrams_failed,
                "base_reconnects": link.reconnects,
                "base_link_age_s": link.link_age_s,
                "base_error": link.last_error,
            }
        if self._bus is not None:
            out["zenoh"] = dict(self._bus.counters())
        return out

    def snapshot(self) -> Snapshot:
        """Everything the screen shows."""
        last, capture = self._estimator.last, self._capture.counters()
        base = None if self._base is None else self._base.snapshot()
        landmarks, _ = self._estimator.map()
        with self._stats_lock:
            fps, latency = self._stats.fps, self._stats.latency()
        shown = Snapshot(
            title=f"ceilvo {self._config.robot.name}",
            reason=self._camera_reason if last is None else last.reason,
            uptime_s=1e-9 * (self._clock() - self._started_ns),
            fps=fps,
            frames=capture.frames,
            drops=capture.drops,
            latency_ms=latency,
            landmarks=len(landmarks),
            landmarks_xy_m=landmarks.xy_map_m,
            path_xy_m=np.array([p[:2] for p in tuple(self._path)]).reshape(-1, 2),
            room_m=self._plan.room_m,
            base=None if base is None else ScreenBase(base.link_age_s, base.telegrams_sent, base.telegrams_failed),
            zenoh_samples=None if self._bus is None else self._bus.counters()["samples"],
            events=tuple(self.events),
        )
        if last is None:
            return shown
        d = last.depletion
        return replace(
            shown,
            state=last.state,
            quality=last.quality,
            pose=last.pose,
            sigma=np.sqrt(np.maximum(np.diag(last.cov), 0.0)),
            truth=None if self._plan.truth is None else self._plan.truth(last.stamp_ns),
            ess_ratio=d.ess / max(d.particles, 1),
            unique_ancestors=d.unique_ancestors,
            particles=d.particles,
            nis=d.nis,
            crossings=last.crossings,
            inliers=last.motion.inliers,
        )

    def summary(self) -> dict[str, Any]:
        """The run's figures so far."""
        link = None if self._base is None else self._base.snapshot()
        with self._stats_lock:
            return self._stats.summary(
                drops=self._capture.counters().drops,
                telegrams_sent=0 if link is None else link.telegrams_sent,
                telegrams_failed=0 if link is None else link.telegrams_failed,
                zenoh_samples=0 if self._bus is None else self._bus.counters()["samples"],
            )

    # -- requests

    def _handlers(self) -> Handlers:
        return Handlers(
            map=lambda: self._estimator.map()[0],
            calibration=lambda: self._plan.calibration,
            config=lambda: self._config,
            initial_pose=self._initial_pose,
            relocalise=self._relocalise,
            save_map=self._save_map,
            reset=self._reset,
        )

    def _initial_pose(self, c: commands.InitialPose) -> Result:
        pose = np.array([c.x_m, c.y_m, c.theta_rad])
        sigma = np.array([c.sigma_m, c.sigma_m, c.sigma_theta_rad])
        self._estimator.assume(pose, sigma, "initial pose given")
        return {"did": "pose taken as a hypothesis; TRACKING once landmarks confirm it"}

    def _relocalise(self, c: commands.Relocalise) -> Result:
        if not len(self._estimator.map()[0]):
            raise CeilvoError("no map to find the pose in: drive first, or restore map.json and restart")
        sigma = self._estimator.search()
        return {
            "did": f"searching within {sigma[0]:.1f} m and {np.degrees(sigma[2]):.0f} deg (1 sigma) of the last pose"
        }

    def _save_map(self, c: commands.SaveMap) -> Result:
        if self._store.folder is None:
            raise CeilvoError("no state directory: set service.state_dir or run under systemd")
        if not self._save():
            raise CeilvoError("nothing saved: no landmarks yet, or the disk refused; see the log")
        return {"did": "saved", "folder": str(self._store.folder), "landmarks": len(self._estimator.map()[0])}

    def _reset(self, c: commands.Reset) -> Result:
        self._estimator.reset()
        return {"did": "map and pose forgotten; started again at the configured initial pose"}

    def _save(self) -> bool:
        last = self._estimator.last
        landmarks, axis = self._estimator.map()
        return last is not None and self._store.save(landmarks, axis, last)


def run(plan: Plan) -> int:
    """Run a plan to its end; returns the exit code. Errors are one line in the log."""
    cv2.setNumThreads(plan.config.service.opencv_threads)
    with Notifier() as notifier:
        try:
            summary = Daemon(plan, notifier).run()
        except CeilvoError as e:
            log.error("%s", e)
            notifier.status(str(e))
            return e.exit_code
        except Exception:
            log.exception("a thread died")
            return 1
    if plan.summary_file is not None:
        plan.summary_file.parent.mkdir(parents=True, exist_ok=True)
        write_atomic(plan.summary_file, json.dumps(summary, indent=2) + "\n")
    if plan.seconds is not None or plan.summary_file is not None:
        sys.stdout.write(format_summary(summary))
    return 0


def plan_real(config: Config, calibration: Calibration, **options: Any) -> Plan:
    """A plan for the configured camera."""
    return Plan(config, calibration, make_camera(config.camera), **options)


def replay_recording(
    source: Path, config: Config, calibration: Calibration, outputs: Outputs, reference: Path | None, align: Alignment
) -> int:
    """Run a recording through the pipeline and say what came out; returns the exit code."""
    cv2.setNumThreads(config.service.opencv_threads)
    size = calibration.camera
    camera = source_camera(source, size.width_px, size.height_px, config.camera.rate_hz)
    pipeline = Pipeline(calibration, config, np.random.default_rng(config.service.seed))
    camera.open()
    try:
        estimates = replay(_frames(camera), pipeline, calibration, outputs, _progress())
    finally:
        camera.close()
    statistics = RunStatistics(config.service.seed)
    for e in estimates:
        statistics.add(e)
    sys.stdout.write(format_replay(estimates, statistics.summary()))
    if reference is not None:
        sys.stdout.write(format_error(_distance(estimates, reference, align), (str(source), str(reference))))
    return 0


def watch_robots(config: Config, robot: str, raw: bool, count: int | None, stop: threading.Event) -> int:
    """Print what robots publish until Ctrl-C or `count` poses."""
    with _signals(stop):
        watch(config.zenoh, robot, sys.stdout, stop, WatchOptions(raw=raw, count=count))
    return 0


def _frames(camera: Camera) -> Iterator[Frame]:
    while (frame := camera.read()) is not None:
        yield frame


def _progress() -> Callable[[int], None]:
    if not sys.stderr.isatty():
        return lambda done: None
    return lambda done: print(f"\r{done} frames", end="" if done % 10 else "\r", file=sys.stderr, flush=True)


def _distance(estimates: list[Estimate], reference: Path, align: Alignment) -> TrajectoryError:
    ref = read_tum(reference)
    stamps = np.array([e.stamp_ns for e in estimates], np.int64)
    i, j = match_stamps(stamps, ref.stamp_ns, _REFERENCE_TOLERANCE_NS)
    if not len(i):
        raise FileFormatError(f"{reference}: no stamp within 10 ms of a frame's; the two must share a clock")
    return trajectory_error(np.array([e.pose for e in estimates])[i], ref.poses[j], align)


def simulation(config: Config, seed: int, **options: Any) -> AbstractContextManager[Plan]:
    """A plan for a rendered ceiling, a simulated robot and a Modbus base on a pseudo-terminal."""
    return _Simulation(config, seed, options)


class _Simulation:
    def __init__(self, config: Config, seed: int, options: dict[str, Any]) -> None:
        self._config, self._seed, self._options = config, seed, options
        self._ending = ExitStack()

    def __enter__(self) -> Plan:
        from ceilvo.sim.base import SimBase
        from ceilvo.sim.camera import SimCamera
        from ceilvo.sim.world import World, WorldSpec

        world = World(WorldSpec(seed=self._seed))
        _ = world.renderer  # drawn now: it takes a second of processor time that the base would miss
        cfg = self._config
        base = SimBase(
            baud=cfg.base.baud,
            parity=cfg.base.parity,
            unit_id=cfg.base.unit_id,
            odometry=lambda t_s: tuple(world.wheel_odometry_at(world.seconds(round(1e9 * t_s)))),
        )
        self._ending.enter_context(base)
        x, y, theta = world.initial_pose
        camera = world.calibration.camera
        start = {"initial_pose_x_m": x, "initial_pose_y_m": y, "initial_pose_theta_deg": float(np.degrees(theta))}
        cfg = replace(
            cfg,
            camera=replace(cfg.camera, width_px=camera.width_px, height_px=camera.height_px),
            base=replace(cfg.base, port=base.port),
            filter=replace(cfg.filter, **start),
        )
        size = world.spec.lap.room_m
        return Plan(
            cfg,
            world.calibration,
            SimCamera(world, cfg.camera.rate_hz),
            truth=lambda stamp_ns: world.truth_at(world.seconds(stamp_ns)),
            room_m=(0.0, 0.0, size, size),
            **self._options,
        )

    def __exit__(self, *_: object) -> None:
        self._ending.close()


class _no_screen:
    def __enter__(self) -> None:
        return None

    def __exit__(self, *_: object) -> None:
        return None


class _signals:
    """SIGTERM and SIGINT set an event; only in the main thread, where Python allows it."""

    def __init__(self, stop: threading.Event) -> None:
        self._stop = stop
        self._before: dict[signal.Signals, Any] = {}

    def __enter__(self) -> None:
        if threading.current_thread() is threading.main_thread():
            for number in (signal.SIGTERM, signal.SIGINT):
                self._before[number] = signal.signal(number, self._set)

    def __exit__(self, *_: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def _set(self, number: int, frame: FrameType | None) -> None:
        self._stop.set()


def _jpeg(image: Any) -> bytes:
    ok, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 80])
    if not ok:
        raise CeilvoError("the picture could not be encoded")
    return bytes(data)
