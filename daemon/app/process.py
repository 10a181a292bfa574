"""The process: stages joined to drivers, threads, signals, and its end.

    capture thread -> estimator thread -> base (its own thread), Zenoh (does not block)
    main thread: screen, health, saving, systemd, end

A thread that dies takes the process down with its cause; systemd starts it again.
"""

from __future__ import annotations

import json
import logging
import queue
import sys
import threading
import time
from collections.abc import Callable
from contextlib import AbstractContextManager, ExitStack, nullcontext
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from ceilvo.calibration import Calibration
from ceilvo.calibration_check import check_fits
from ceilvo.config import Config
from ceilvo.daemon.app.estimator import Estimator, no_listener
from ceilvo.daemon.app.fleet import Membership
from ceilvo.daemon.app.keeping import Keeper, begin_on, load, store_of
from ceilvo.daemon.app.outputs import Outputs
from ceilvo.daemon.app.requests import handlers
from ceilvo.daemon.app.senses.hearing import Hearing
from ceilvo.daemon.app.telemetry import Telemetry, Truth
from ceilvo.daemon.app.wires import wires_of
from ceilvo.daemon.pipeline import Pipeline
from ceilvo.daemon.replay.recording import RecordedBase, recording_of
from ceilvo.daemon.replay.summary import format_summary
from ceilvo.drivers.base.late import late_modbus
from ceilvo.drivers.bus.namesake import refuse_namesake
from ceilvo.drivers.camera.capture import CaptureEvent, CaptureLoop
from ceilvo.drivers.camera.paced import PacedCamera
from ceilvo.drivers.camera.selection import make_camera
from ceilvo.drivers.host.machine import give_back_memory
from ceilvo.drivers.host.ownership import owner_of_folder, owner_of_name
from ceilvo.drivers.host.signals import stop_on_signals, watch_threads
from ceilvo.drivers.host.systemd_notify import Notifier
from ceilvo.drivers.ports import Base, Camera
from ceilvo.errors import CeilvoError
from ceilvo.files import write_atomic
from ceilvo.types import State

if TYPE_CHECKING:
    from ceilvo.daemon.app.screen import Screen

log = logging.getLogger("ceilvo")

_TICK_S = 0.05
"""Period of the main thread; chosen: a change of state is in systemd's status this soon (docs/faults.md)."""
_SILENT_FRAMES = 3.0
"""Periods of used frames without one that make a slow camera silent; chosen: two lost in a row are not news."""
_SILENT_PERIOD_S = 0.1
"""Between estimates of a silent camera; chosen: often enough to be seen."""
_STOP_S = 1.0
"""Patience with each thread at the end; chosen: SIGTERM to exit within 2 s, with the recorder's part."""
_TRIM_NS = 60 * 10**9
"""Between returns of free memory to the system; chosen: so seldom it costs nothing."""
_FIRST_TRIM_NS = 5 * 10**9
"""The first time after the start; chosen: the first frame has made its look-ups then, which takes 5 MB for a while."""
_SILENT = "the camera gives no frames"
_MAP_FULL = "the map is full: nothing new is learnt; raise filter.max_landmarks, or reset the map"


@dataclass(frozen=True)
class Plan:
    """What to run.

    Attributes:
        camera: not opened.
        truth: map_from_base (3,) at a stamp, where a simulator knows it.
        room_m: x_min, y_min, x_max, y_max for the screen's plot.
        seconds: end this long after the first frame; None = run until stopped.
        summary_file: where to write the run's figures as JSON.
        screen: makes the live screen.
        record: write a recording to this file.
    """

    config: Config
    calibration: Calibration
    camera: Camera
    truth: Truth | None = None
    room_m: tuple[float, float, float, float] | None = None
    seconds: float | None = None
    summary_file: Path | None = None
    screen: Callable[[], AbstractContextManager[Screen | None]] = nullcontext
    record: Path | None = None


class Daemon:
    """One robot's localisation, wired and running."""

    def __init__(self, plan: Plan, notifier: Notifier, clock: Callable[[], int] = time.monotonic_ns) -> None:
        config = plan.config
        self._plan, self._config, self._notifier, self._clock = plan, config, notifier, clock
        self._stop = threading.Event()
        self._crashes: queue.SimpleQueue[BaseException] = queue.SimpleQueue()
        self._first_frame_ns: int | None = None
        self._map_full = False
        self._camera_reason = "camera not opened yet"
        self._store = store_of(config)
        self._recording = recording_of(
            config, plan.calibration, self._store.folder, plan.record, clock, self._on_recorder_stop
        )
        self._hearing = hearing = Hearing(config, self._port, clock, self._crash, plan.calibration)
        self._base = hearing.base
        listener = no_listener if self._recording is None else self._recording.input
        given = hearing.wheels, listener, self._store.session, hearing.between, hearing.shown
        rng = np.random.default_rng(config.service.seed)
        self._estimator = Estimator(Pipeline(plan.calibration, config, rng), clock, *given)
        self._estimator.know(hearing.known)
        period_s, tell = config.service.state_period_s, lambda *said: self._outputs.event(*said)
        self._keeper = Keeper(self._estimator, self._store, period_s, tell)
        answers = handlers(config, plan.calibration, self._estimator, self._store, self._keeper.save, hearing.ahead)
        wires = wires_of(config, plan.calibration, answers, hearing)
        self._bus, self._wires = wires.bus, wires.others
        name, fixed, recording = config.robot.name, plan.calibration, self._recording
        links = (self._base, self._bus)
        places, ahead = (self._wires, self._store.map_of), (hearing.ahead, config.zenoh.predict_ms)
        self._outputs: Outputs = Outputs(name, fixed, self._estimator, *links, clock, recording, *places, *ahead)
        self._fleet = Membership(config, self._store.folder, lambda: self._estimator.last, self._outputs.event)
        self._capture = CaptureLoop(plan.camera, config.camera, clock, self._on_capture, self._crash)
        parts, seed = (self._estimator, self._capture, *links, plan.truth, clock), config.service.seed
        self._telemetry = Telemetry(*parts, seed, plan.calibration.driving_nis, self._store, self._wires)
        self._thread = threading.Thread(target=self._estimate, name="estimator", daemon=True)

    @property
    def events(self) -> tuple[str, ...]:
        """The latest ones, newest last."""
        return tuple(self._outputs.events)

    def run(self) -> dict[str, Any]:
        """Run until stopped, the recording ends or `seconds` are over; returns the summary.

        Raises:
            Exception: what took the process down; a CeilvoError carries the exit code.
        """
        with ExitStack() as ending:
            self._own(ending)
            ending.callback(self._outputs.close)
            ending.callback(self._store.close)
            ending.enter_context(self._fleet.kept_up())
            stored = load(self._config, self._store, self._outputs.event)
            if stored is not None:
                begin_on(self._estimator, stored)
                self._outputs.event("map", stored.said)
            ending.enter_context(stop_on_signals(self._stop))
            ending.enter_context(watch_threads(self._crash))
            if self._recording is not None:
                ending.callback(lambda recording: recording.stop(crashed=not self._crashes.empty()), self._recording)
                self._recording.start()
            for wire in self._wires:
                ending.callback(wire.close)
                wire.open()
            if self._bus is not None:
                ending.callback(self._bus.close)
                self._bus.open()
            ending.callback(self._end)
            self._capture.start()
            ending.callback(self._hearing.stop)
            self._hearing.start()
            self._thread.start()
            self._notifier.ready("waiting for the camera")
            with self._plan.screen() as screen:
                self._supervise(screen)
            summary = self._telemetry.summary()
        summary |= self._recorder_counters()
        if not self._crashes.empty():
            raise self._crashes.get()
        return summary

    def _own(self, ending: ExitStack) -> None:
        """Nobody else keeps a map in the same folder, or answers to the same name where both can be found."""
        if self._store.folder is not None:
            ending.enter_context(owner_of_folder(self._store.folder))
        if self._config.zenoh.enabled and self._config.zenoh.multicast:
            ending.enter_context(owner_of_name(f"{self._config.zenoh.prefix}/{self._config.robot.name}"))
        refuse_namesake(self._config.zenoh, self._config.robot.name)

    def stop(self) -> None:
        """Ask for an orderly end; from any thread."""
        self._stop.set()

    # -- main thread

    def _supervise(self, screen: Screen | None) -> None:
        """Everything slow and periodic, until the end is asked for."""
        health = self._clock()
        trim = health + _FIRST_TRIM_NS
        reported: State | None = None
        while not self._stop.wait(_TICK_S):
            now, last = self._clock(), self._estimator.last
            if not self._crashes.empty() or self._is_over(now):
                break
            if last is not None and last.state is not reported:
                reported = last.state
                self._report_status(reported)
            if now >= health:
                health = now + int(1e9 * self._config.zenoh.health_period_s)
                self._report_health()
            self._keeper.keep(now)
            if now >= trim:
                trim = now + _TRIM_NS
                give_back_memory()
            if screen is not None:
                title, events, room = f"ceilvo {self._config.robot.name}", self.events, self._plan.room_m
                screen.update(lambda: self._telemetry.snapshot(title, self._camera_reason, room, events))  # noqa: B023

    def _is_over(self, now_ns: int) -> bool:
        if self._capture.finished and not self._thread.is_alive():
            return True
        seconds, first = self._plan.seconds, self._first_frame_ns
        return seconds is not None and first is not None and now_ns - first >= int(1e9 * seconds)

    def _end(self) -> None:
        """Stop, flush, persist; a last telegram reports it to the base."""
        self._notifier.stopping("stopping")
        self._stop.set()
        self._capture.stop(_STOP_S)
        if self._thread.ident is not None:
            self._thread.join(_STOP_S)
        self._keeper.save()
        self._report_health(State.STOPPED)
        if self._base is not None:
            self._base.stop()

    def _report_health(self, state: State | None = None) -> None:
        if state is None:
            last = self._estimator.last
            state = State.INIT if last is None else last.state
        self._report_status(state)
        counters = {**self._telemetry.counters(), **self._recorder_counters(), **self._fleet.counters()}
        self._outputs.health(state, self._telemetry.uptime_s, counters)
        if not self._map_full and self._estimator.counters()["map_full"]:
            self._map_full = True
            self._outputs.event("map", _MAP_FULL, logging.WARNING)

    def _report_status(self, state: State) -> None:
        self._notifier.status(self._telemetry.status_line(state, self._camera_reason))

    def _recorder_counters(self) -> dict[str, object]:
        return {} if self._recording is None else {"recorder": asdict(self._recording.counters())}

    def _port(self) -> Base:
        port = late_modbus(self._config.base)
        return port if self._recording is None else RecordedBase(port, self._recording)

    # -- other threads

    def _crash(self, error: BaseException) -> None:
        self._crashes.put(error)

    def _on_recorder_stop(self, why: str) -> None:
        """Called in the recorder's thread."""
        self._outputs.event("recorder", f"recording stopped: {why}; localisation goes on", logging.WARNING)

    def _on_capture(self, event: CaptureEvent) -> None:
        """Called in the capture thread; a calibration that does not fit the opened camera ends the process."""
        info = self._capture.info
        if event.kind == "opened" and info is not None:
            check_fits(self._plan.calibration, info.name, info.camera_id, info.width_px, info.height_px)
        if event.kind in ("lost", "bad_frame"):
            self._camera_reason = event.text
        elif event.kind == "opened":
            self._camera_reason = _SILENT
        level = logging.WARNING if event.kind in ("lost", "slow", "rate") else logging.INFO
        self._outputs.event(f"camera_{event.kind}", f"camera {event.kind}: {event.text}", level)

    def _estimate(self) -> None:
        try:
            while not self._stop.is_set() and self._step():
                self._notifier.watchdog()
        except Exception as e:
            self._crash(e)

    def _step(self) -> bool:
        """One frame, or one look at a camera that is silent; False at the end of a recording."""
        frame = self._capture.take(self._patience_s())
        if frame is None:
            if self._capture.finished:
                return False
            info = self._capture.info
            estimate = self._estimator.silence(self._camera_reason) if info is None or info.live else None
            if estimate is not None:
                self._outputs.publish(estimate)
            return True
        if self._first_frame_ns is None:
            self._first_frame_ns = self._clock()
        if self._capture.counters().connected:
            self._camera_reason = _SILENT
        before, info = self._estimator.stamp_fault, self._capture.info
        estimate = self._estimator.frame(frame, live=info is None or info.live)
        if self._estimator.stamp_fault not in ("", before):
            self._outputs.event("stamps", self._estimator.stamp_fault, logging.WARNING)
        if estimate is not None:
            self._outputs.publish(estimate)
            self._telemetry.count(estimate)
        return True

    def _patience_s(self) -> float:
        """How long a frame may be late before that is news; once it is, the news is repeated often."""
        last = self._estimator.last
        if last is not None and last.motion.failure == self._camera_reason:
            return _SILENT_PERIOD_S
        return max(self._config.states.dead_reckoning_s, _SILENT_FRAMES * self._capture.rate.used_period_s)


def plan_real(
    config: Config, calibration: Calibration, seconds: float | None, summary_file: Path | None, record: Path | None
) -> Plan:
    """A plan for the configured camera; a recording in its place keeps its own pace."""
    camera = make_camera(config.camera, calibration.camera.readout_s)
    if config.camera.source != "v4l2":
        camera = PacedCamera(camera)
    return Plan(config, calibration, camera, seconds=seconds, summary_file=summary_file, record=record)


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
    if plan.seconds is not None or plan.summary_file is not None or plan.record is not None:
        sys.stdout.write(format_summary(summary))
    return 0
