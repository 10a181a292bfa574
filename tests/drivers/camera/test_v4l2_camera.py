"""V4l2Camera against a device with faults: what it opens with, sets, gives and refuses."""

from __future__ import annotations

import dataclasses
import math

import cv2
import numpy as np
import pytest

from ceilvo import config
from ceilvo.drivers.camera.mock_v4l2 import MockV4l2Device
from ceilvo.drivers.camera.v4l2_camera import PROBE_FRAMES, V4l2Camera
from ceilvo.errors import BadFrameError, CameraError

W, H = 64, 48


def settings(**changes: object) -> config.Camera:
    return dataclasses.replace(config.Camera(width_px=W, height_px=H, pixel_format="YUYV"), **changes)


# --- opening


@pytest.mark.parametrize("fmt", ["GREY", "YUYV", "MJPG", "UYVY", "Y10", "Y12P"])
@pytest.mark.parametrize("padding", [0, 16])
def test_frames_are_the_scene_stamped_at_capture(fmt: str, padding: int) -> None:
    device = MockV4l2Device(padding=padding)
    camera = V4l2Camera(settings(pixel_format=fmt), device)
    info = camera.open()
    assert (info.width_px, info.height_px, info.rate_hz, info.live) == (W, H, 30.0, True)
    assert info.camera_id == "mock serial 1"
    assert info.notes == ()
    for seq in range(3):
        frame = camera.read()
        assert frame is not None
        truth = device.picture(device.frames, W, H)
        assert np.abs(frame.gray.astype(int) - truth).max() <= (20 if fmt == "MJPG" else 0)
        assert frame.seq == seq
        assert frame.stamp_ns == round(device.clock_ns / 1000) * 1000


@pytest.mark.parametrize("readout_s", [0.02, -0.02])
def test_a_frame_read_row_by_row_is_of_its_middle_row(readout_s: float) -> None:
    device = MockV4l2Device()
    camera = V4l2Camera(settings(), device, readout_s)
    camera.open()
    frame = camera.read()
    assert frame is not None
    assert frame.stamp_ns == round(device.clock_ns / 1000) * 1000 + 10_000_000


def test_raw_buffers_are_asked_for() -> None:
    device = MockV4l2Device()
    V4l2Camera(settings(), device).open()
    assert (cv2.CAP_PROP_CONVERT_RGB, 0) in device.captures[0].sets


def test_another_format_than_asked_is_an_error() -> None:
    device = MockV4l2Device(formats=("BGR3", "YUYV"))
    with pytest.raises(
        CameraError, match=r"gives BGR3 64x48, asked for MJPG 64x48; .*v4l2-ctl -d /dev/video7 --list-formats-ext"
    ):
        V4l2Camera(settings(pixel_format="MJPG"), device).open()
    assert device.captures[0].released


def test_another_size_than_asked_is_an_error() -> None:
    with pytest.raises(CameraError, match="gives YUYV 64x48, asked for YUYV 640x480"):
        V4l2Camera(settings(width_px=640, height_px=480), MockV4l2Device()).open()


def test_a_busy_device_is_an_error() -> None:
    with pytest.raises(CameraError, match="fuser -v /dev/video7"):
        V4l2Camera(settings(), MockV4l2Device(busy=True)).open()


def test_an_absent_device_is_an_error() -> None:
    with pytest.raises(CameraError, match="no such device"):
        V4l2Camera(settings(), MockV4l2Device(present=False)).open()


def test_a_device_that_opens_but_stays_silent_is_found_at_open() -> None:
    device = MockV4l2Device(silent=True)
    with pytest.raises(CameraError, match=r"no frame within 1 s \(camera.read_timeout_s\)"):
        V4l2Camera(settings(), device).open()
    assert device.captures[0].released


def test_another_rate_is_a_note() -> None:
    info = V4l2Camera(settings(rate_hz=60.0), MockV4l2Device(rate_hz=25.0)).open()
    assert info.rate_hz == 25.0
    assert info.notes == ("25 frames per second instead of 60",)


def test_an_unknown_rate_is_a_note() -> None:
    info = V4l2Camera(settings(), MockV4l2Device(tells_rate=False)).open()
    assert info.rate_hz == 30.0
    assert info.notes == ("the driver does not tell its frame rate",)


# --- exposure and gain


def test_exposure_and_gain_are_locked_in_the_drivers_units() -> None:
    device = MockV4l2Device()
    info = V4l2Camera(settings(exposure_us=10_000.0, gain=32.0), device).open()
    assert device.controls == {cv2.CAP_PROP_AUTO_EXPOSURE: 1, cv2.CAP_PROP_EXPOSURE: 100, cv2.CAP_PROP_GAIN: 32}
    assert info.notes == ()


def test_exposure_and_gain_are_set_while_it_runs() -> None:
    device = MockV4l2Device()
    camera = V4l2Camera(settings(exposure_us=10_000.0, gain=20.0), device)
    with pytest.raises(CameraError, match="not open"):
        camera.adjust(5000.0, 1.0)
    camera.open()
    camera.adjust(5000.0, 30.0)
    assert (device.controls[cv2.CAP_PROP_EXPOSURE], device.controls[cv2.CAP_PROP_GAIN]) == (50, 30)
    assert camera.read() is not None
    camera.adjust(None, None)
    assert device.controls[cv2.CAP_PROP_AUTO_EXPOSURE] == 3
    assert device.controls[cv2.CAP_PROP_GAIN] == 30, "left alone"
    device.limits[cv2.CAP_PROP_GAIN] = (0, 40)
    with pytest.raises(CameraError, match=r"camera.gain: gives 40, asked for 60"):
        camera.adjust(None, 60.0)


def test_exposure_is_locked_again_when_the_stream_has_started() -> None:
    class Forgetful(MockV4l2Device):
        def grab(self, capture: object, timeout_s: float) -> bool:
            if self.frames == 0:
                self.controls[cv2.CAP_PROP_AUTO_EXPOSURE] = 3
                self.controls[cv2.CAP_PROP_EXPOSURE] = 157
            return super().grab(capture, timeout_s)

    device = Forgetful()
    V4l2Camera(settings(exposure_us=20_000.0), device).open()
    assert device.controls[cv2.CAP_PROP_AUTO_EXPOSURE] == 1
    assert device.controls[cv2.CAP_PROP_EXPOSURE] == 200


def test_exposure_left_out_turns_a_manual_camera_back_to_automatic_and_leaves_gain_alone() -> None:
    device = MockV4l2Device()
    device.controls[cv2.CAP_PROP_AUTO_EXPOSURE] = 1
    V4l2Camera(settings(), device).open()
    assert device.controls == {cv2.CAP_PROP_AUTO_EXPOSURE: 3, cv2.CAP_PROP_EXPOSURE: 157, cv2.CAP_PROP_GAIN: 16}


def test_a_camera_without_controls_is_fine_when_none_is_asked_for() -> None:
    assert V4l2Camera(settings(), MockV4l2Device(controls={})).open().notes == ()


def test_exposure_that_the_camera_rounds_is_a_note() -> None:
    device = MockV4l2Device(limits={cv2.CAP_PROP_EXPOSURE: (104, 5000)})
    info = V4l2Camera(settings(exposure_us=10_000.0), device).open()
    assert info.notes == ("exposure 10400 us instead of 10000 us",)


@pytest.mark.parametrize(
    ("changes", "controls", "limits", "says"),
    [
        ({"exposure_us": 10_000.0}, {}, {}, "exposure_us: has no such control, asked for 10000"),
        (
            {"exposure_us": 10_000.0},
            {cv2.CAP_PROP_EXPOSURE: 1},
            {cv2.CAP_PROP_EXPOSURE: (3, 50)},
            "exposure_us: gives 5000, asked for 10000",
        ),
        ({"gain": 8.0}, {}, {}, "gain: has no such control"),
        ({"gain": 8.0}, {cv2.CAP_PROP_GAIN: 1}, {cv2.CAP_PROP_GAIN: (0, 4)}, "gain: gives 4, asked for 8"),
    ],
)
def test_exposure_or_gain_that_cannot_be_had(
    changes: dict[str, float], controls: dict[int, float], limits: dict[int, tuple[float, float]], says: str
) -> None:
    with pytest.raises(CameraError, match=says + r".*--list-ctrls"):
        V4l2Camera(settings(**changes), MockV4l2Device(controls=controls, limits=limits)).open()


# --- streaming


def opened(device: MockV4l2Device, **changes: object) -> V4l2Camera:
    camera = V4l2Camera(settings(**changes), device)
    camera.open()
    return camera


def test_silence_is_a_camera_error_within_the_timeout() -> None:
    device = MockV4l2Device()
    camera = opened(device, read_timeout_s=0.25)
    device.silent = True
    before = device.clock_ns
    with pytest.raises(CameraError, match=r"no frame within 0.25 s") as caught:
        camera.read()
    assert not isinstance(caught.value, BadFrameError)
    assert abs(device.clock_ns - before - 250_000_000) < 1_000_000


def test_a_wait_cut_short_by_signals_is_no_timeout() -> None:
    device = MockV4l2Device()
    camera = opened(device)
    device.wakes = 3
    assert camera.read() is not None


def test_a_vanished_device_is_a_camera_error() -> None:
    device = MockV4l2Device()
    camera = opened(device)
    device.lost = True
    with pytest.raises(CameraError, match="lost while streaming") as caught:
        camera.read()
    assert not isinstance(caught.value, BadFrameError)


def test_a_frame_cut_short_is_a_bad_frame_and_the_next_one_is_good() -> None:
    for fmt in ("GREY", "YUYV", "MJPG"):
        device = MockV4l2Device()
        camera = opened(device, pixel_format=fmt)
        device.cut = 40
        with pytest.raises(BadFrameError, match=r"camera /dev/video0 \(/dev/video7\): frame of"):
            camera.read()
        device.cut = 0
        assert camera.read() is not None


def test_an_empty_buffer_is_a_bad_frame() -> None:
    device = MockV4l2Device()
    camera = opened(device)
    device.empty = True
    with pytest.raises(BadFrameError, match="empty buffer"):
        camera.read()


@pytest.mark.parametrize(
    "wrong", [lambda ns: 0.0, lambda ns: math.nan, lambda ns: ns / 1e6 + 200, lambda ns: ns / 1e6 - 100]
)
def test_a_single_wrong_stamp_is_a_bad_frame(wrong: object) -> None:
    device = MockV4l2Device()
    camera = opened(device)
    good = device.stamp_msec
    device.stamp_msec = wrong  # type: ignore[assignment]
    with pytest.raises(BadFrameError, match="stamp"):
        camera.read()
    device.stamp_msec = good
    assert camera.read() is not None
    assert camera.read_time_stamps == 0


@pytest.mark.parametrize(
    "wrong", [lambda ns: 0.0, lambda ns: 1.7e12 + ns / 1e6, lambda ns: (ns - 999_000_000_000) / 1e6]
)
def test_a_driver_without_monotonic_stamps_gets_the_time_of_reading(wrong: object) -> None:
    device = MockV4l2Device(stamp_msec=wrong)  # type: ignore[arg-type]
    camera = V4l2Camera(settings(), device)
    info = camera.open()
    assert device.frames == PROBE_FRAMES + 1
    assert len(info.notes) == 1
    assert "time of reading" in info.notes[0]
    stamps = [frame.stamp_ns for frame in (camera.read() for _ in range(4)) if frame is not None]
    assert len(stamps) == 4
    assert abs(stamps[-1] - device.now_ns()) == 0
    assert camera.read_time_stamps == 5


def test_a_first_frame_with_a_zero_stamp_does_not_condemn_the_driver() -> None:
    device = MockV4l2Device()
    device.stamp_msec = lambda ns: 0.0 if device.frames == 1 else ns / 1e6
    assert V4l2Camera(settings(), device).open().notes == ()


def test_a_device_that_only_gives_rubbish_is_an_error_at_open() -> None:
    device = MockV4l2Device(cut=40)
    with pytest.raises(CameraError, match="and so were the 5 before") as caught:
        V4l2Camera(settings(), device).open()
    assert not isinstance(caught.value, BadFrameError)


def test_numbers_go_on_after_replugging() -> None:
    device = MockV4l2Device()
    camera = opened(device)
    assert [f.seq for f in (camera.read(), camera.read()) if f] == [0, 1]
    device.lost = True
    with pytest.raises(CameraError):
        camera.read()
    camera.close()
    device.lost = False
    camera.open()
    frame = camera.read()
    assert frame is not None
    assert frame.seq == 2
    assert [c.released for c in device.captures] == [True, False]
