"""A real camera: V4L2 through OpenCV, grey frames stamped by the driver."""

from __future__ import annotations

import contextlib
import math
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from ceilvo.config import Camera as CameraConfig
from ceilvo.drivers.camera.pixel_formats import fourcc, luma
from ceilvo.drivers.camera.v4l2_device import Capture, Device, LinuxDevice
from ceilvo.drivers.ports import CameraInfo
from ceilvo.errors import BadFrameError, CameraError
from ceilvo.types import Frame

MAX_FUTURE_NS = 50_000_000
"""Some drivers stamp the end of an exposure that is still running; more than this is a wrong clock."""
MAX_AGE_NS = 2_000_000_000
"""A buffer older than this was not stamped with CLOCK_MONOTONIC."""
_LATEST_MSEC = 1e13
"""300 years, later than any clock; beyond it a stamp is rubbish, and might be more than a number holds."""
PROBE_FRAMES = 5
"""Frames that open() looks at before it gives up on the driver's stamps."""

_BUFFERS = 4  # OpenCV's own default, so no extra stream reset; the capture loop keeps the queue empty
_AUTO_EXPOSURE_MANUAL = 1  # V4L2_EXPOSURE_MANUAL
_AUTO_EXPOSURE_AUTO = (3, 0)  # V4L2_EXPOSURE_APERTURE_PRIORITY (USB cameras), V4L2_EXPOSURE_AUTO
_EXPOSURE_UNIT_US = 100.0  # V4L2_CID_EXPOSURE_ABSOLUTE
_EXPOSURE_TOLERANCE = 0.1
"""Share of the time asked for; chosen: devices round to steps of their own, more is another exposure."""

_RATE_TOLERANCE = 0.01
"""Of the rate asked for, within which a device's answer is the same: 29.97 Hz is 30."""


def stamp_ns_from_msec(pos_msec: float, now_ns: int, last_ns: int) -> int:
    """CLOCK_MONOTONIC stamp from CAP_PROP_POS_MSEC, the buffer's time in ms with microseconds after the point.

    Raises:
        BadFrameError: not a number, zero, beyond all time, in the future, of another clock, or not after the last one.
    """
    if not 0 < pos_msec < _LATEST_MSEC:
        raise BadFrameError(f"buffer stamp {pos_msec} ms, expected the monotonic time of capture")
    stamp = round(pos_msec * 1000) * 1000
    ahead = stamp - now_ns
    if not -MAX_AGE_NS <= ahead <= MAX_FUTURE_NS:
        raise BadFrameError(
            f"buffer stamp {pos_msec:.3f} ms is {ahead / 1e6:+.1f} ms from now, "
            f"expected within {-MAX_AGE_NS / 1e6:+.0f} and {MAX_FUTURE_NS / 1e6:+.0f} ms"
        )
    if stamp <= last_ns:
        raise BadFrameError(f"buffer stamp {pos_msec:.3f} ms is not after the last one, {last_ns / 1e6:.3f} ms")
    return stamp


class V4l2Camera:
    """Camera of drivers.ports on a V4L2 device.

    open() streams until one good frame came, so a device that opens but stays silent is found there. The stamp is the
    buffer's own; a driver whose stamps are not CLOCK_MONOTONIC in PROBE_FRAMES frames running gets the time of reading
    instead, which a note in CameraInfo says and `read_time_stamps` counts.
    """

    def __init__(self, settings: CameraConfig, device: Device | None = None, readout_s: float = 0.0) -> None:
        """readout_s: of a rolling shutter, as in CameraModel; a stamp is then moved on to the middle row's time."""
        self._cfg = settings
        self._to_middle_ns = round(0.5e9 * abs(readout_s))
        self._device: Device = device or LinuxDevice()
        self._capture: Capture | None = None
        self._name = settings.device
        self._seq = 0
        self._last_ns = 0
        self._driver_stamps = True
        self.read_time_stamps = 0

    def open(self) -> CameraInfo:
        self.close()
        try:
            return self._open()
        except BaseException:
            self.close()
            raise

    def read(self) -> Frame | None:
        gray, stamp = self._frame(self._cfg.read_timeout_s)
        frame = Frame(self._seq, stamp + (self._to_middle_ns if self._driver_stamps else 0), gray)
        self._seq += 1
        return frame

    def adjust(self, exposure_us: float | None, gain: float | None) -> None:
        """Set exposure and gain while it runs, as the configuration's keys do; for who chooses them.

        Raises:
            CameraError: the camera is not open, has no such control, or gives another value.
        """
        if self._capture is None:
            raise CameraError(f"camera {self._name}: not open")
        self._cfg = replace(self._cfg, exposure_us=exposure_us, gain=gain)
        self._lock_exposure(self._capture, self._device.resolve(self._cfg.device))

    def close(self) -> None:
        capture, self._capture = self._capture, None
        if capture is not None:
            with contextlib.suppress(cv2.error):
                capture.release()

    def _open(self) -> CameraInfo:
        cfg = self._cfg
        node = self._device.resolve(cfg.device)
        self._name = cfg.device if node == cfg.device else f"{cfg.device} ({node})"
        capture = self._device.open(node, cfg.read_timeout_s)
        if not capture.isOpened():
            raise CameraError(
                f"camera {self._name}: cannot be opened for capture; in use by another program ('fuser -v {node}'), "
                f"or not a capture device ('v4l2-ctl -d {node} --all'), or one with rare formats only (docs/cameras.md)"
            )
        self._capture = capture
        self._ask(capture, node)
        notes = self._lock_exposure(capture, node)
        notes += self._probe_stamps()
        self._lock_exposure(capture, node)  # some cameras forget it when the stream starts
        rate_hz, rate_notes = self._rate(capture)
        return CameraInfo(
            self._name,
            self._device.identity(node),
            cfg.width_px,
            cfg.height_px,
            rate_hz,
            live=True,
            notes=tuple(notes + rate_notes),
        )

    def _ask(self, capture: Capture, node: str) -> None:
        """Format, size and rate; a driver may silently give something else, so look at what it gave."""
        cfg = self._cfg
        asked = (cfg.pixel_format, cfg.width_px, cfg.height_px)
        capture.set(cv2.CAP_PROP_FOURCC, fourcc(cfg.pixel_format))
        capture.set(cv2.CAP_PROP_FRAME_WIDTH, cfg.width_px)
        capture.set(cv2.CAP_PROP_FRAME_HEIGHT, cfg.height_px)
        capture.set(cv2.CAP_PROP_FPS, round(cfg.rate_hz))
        capture.set(cv2.CAP_PROP_BUFFERSIZE, _BUFFERS)
        capture.set(cv2.CAP_PROP_CONVERT_RGB, 0)
        got = (
            _fourcc_text(capture.get(cv2.CAP_PROP_FOURCC)),
            round(capture.get(cv2.CAP_PROP_FRAME_WIDTH)),
            round(capture.get(cv2.CAP_PROP_FRAME_HEIGHT)),
        )
        if got != asked:
            raise CameraError(
                f"camera {self._name}: gives {got[0]} {got[1]}x{got[2]}, asked for {asked[0]} {asked[1]}x{asked[2]}; "
                f"choose one that 'v4l2-ctl -d {node} --list-formats-ext' lists"
            )

    def _lock_exposure(self, capture: Capture, node: str) -> list[str]:
        cfg = self._cfg
        notes = []
        if cfg.exposure_us is None:
            if capture.get(cv2.CAP_PROP_AUTO_EXPOSURE) == _AUTO_EXPOSURE_MANUAL:
                any(capture.set(cv2.CAP_PROP_AUTO_EXPOSURE, mode) for mode in _AUTO_EXPOSURE_AUTO)
        else:
            capture.set(cv2.CAP_PROP_AUTO_EXPOSURE, _AUTO_EXPOSURE_MANUAL)
            want = max(1, round(cfg.exposure_us / _EXPOSURE_UNIT_US))
            got = _set_and_get(capture, cv2.CAP_PROP_EXPOSURE, want)
            if abs(got - want) > _EXPOSURE_TOLERANCE * want:
                raise self._control_error(node, "exposure_us", got * _EXPOSURE_UNIT_US, cfg.exposure_us)
            if got != want:
                notes.append(f"exposure {got * _EXPOSURE_UNIT_US:.0f} us instead of {cfg.exposure_us:.0f} us")
        if cfg.gain is not None:
            got = _set_and_get(capture, cv2.CAP_PROP_GAIN, round(cfg.gain))
            if got != round(cfg.gain):
                raise self._control_error(node, "gain", got, cfg.gain)
        return notes

    def _control_error(self, node: str, key: str, got: float, asked: float) -> CameraError:
        what = "has no such control" if got < 0 else f"gives {got:g}"
        return CameraError(
            f"camera {self._name}: camera.{key}: {what}, asked for {asked:g}; "
            f"see 'v4l2-ctl -d {node} --list-ctrls', or set it to null"
        )

    def _probe_stamps(self) -> list[str]:
        """Stream until a good frame; after PROBE_FRAMES bad ones find out whether only their stamps are to blame."""
        self._driver_stamps = True
        problem = ""
        for _ in range(PROBE_FRAMES):
            try:
                self._frame(self._cfg.read_timeout_s)
                return []
            except BadFrameError as exc:
                problem = str(exc)
        self._driver_stamps = False
        try:
            self._frame(self._cfg.read_timeout_s)
        except BadFrameError as exc:
            raise CameraError(f"{exc}, and so were the {PROBE_FRAMES} before it") from exc
        return [f"stamps are the time of reading, because the driver's are not usable: {problem}"]

    def _frame(self, timeout_s: float) -> tuple[NDArray[np.uint8], int]:
        """The next frame and its stamp; remembers the stamp."""
        capture = self._capture
        if capture is None:
            raise CameraError(f"camera {self._name}: not open")
        self._grab(capture, timeout_s)
        now_ns = self._device.now_ns()
        pos_msec = capture.get(cv2.CAP_PROP_POS_MSEC)
        try:
            gray = self._retrieve(capture)
            stamp = self._stamp(pos_msec, now_ns)
        except BadFrameError as exc:
            raise BadFrameError(f"camera {self._name}: {exc}") from exc
        self._last_ns = stamp
        return gray, stamp

    def _stamp(self, pos_msec: float, now_ns: int) -> int:
        if self._driver_stamps:
            return stamp_ns_from_msec(pos_msec, now_ns, self._last_ns)
        self.read_time_stamps += 1
        return max(now_ns, self._last_ns + 1)

    def _grab(self, capture: Capture, timeout_s: float) -> None:
        deadline_ns = self._device.now_ns() + round(timeout_s * 1e9)
        try:
            while not self._device.grab(capture, max(0.0, (deadline_ns - self._device.now_ns()) / 1e9)):
                if self._device.now_ns() >= deadline_ns:  # a signal ends the wait early
                    raise CameraError(f"camera {self._name}: no frame within {timeout_s:g} s (camera.read_timeout_s)")
        except cv2.error as exc:
            raise CameraError(f"camera {self._name}: lost while streaming; unplugged, or its driver failed") from exc

    def _retrieve(self, capture: Capture) -> NDArray[np.uint8]:
        cfg = self._cfg
        try:
            ok, raw = capture.retrieve()
        except cv2.error as exc:
            raise BadFrameError(f"OpenCV cannot take the buffer: {exc.err}") from exc
        if not ok or raw is None:
            raise BadFrameError("empty buffer")
        return luma(raw, cfg.pixel_format, cfg.width_px, cfg.height_px)

    def _rate(self, capture: Capture) -> tuple[float, list[str]]:
        got, asked = capture.get(cv2.CAP_PROP_FPS), self._cfg.rate_hz
        if not math.isfinite(got) or got <= 0:
            return asked, ["the driver does not tell its frame rate"]
        if abs(got - asked) > _RATE_TOLERANCE * asked:
            return got, [f"{got:g} frames per second instead of {asked:g}"]
        return got, []


def _set_and_get(capture: Capture, prop: int, value: float) -> float:
    capture.set(prop, value)
    return capture.get(prop)


def _fourcc_text(code: float) -> str:
    raw = int(code) & 0xFFFFFFFF
    return raw.to_bytes(4, "little").decode("latin-1").strip()
