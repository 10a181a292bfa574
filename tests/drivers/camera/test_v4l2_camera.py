"""V4l2Camera against byte layouts made by hand and against a device with faults."""

from __future__ import annotations

import dataclasses
import math
import os
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ceilvo import config
from ceilvo.drivers.camera.mock_v4l2 import MockV4l2Device
from ceilvo.drivers.camera.v4l2_camera import PROBE_FRAMES, V4l2Camera, luma, stamp_ns_from_msec
from ceilvo.drivers.camera.v4l2_device import LinuxDevice
from ceilvo.errors import BadFrameError, CameraError

W, H = 64, 48


def settings(**changes: object) -> config.Camera:
    return dataclasses.replace(config.Camera(width_px=W, height_px=H, pixel_format="YUYV"), **changes)


def ramp(w: int, h: int) -> np.ndarray:
    return (np.arange(w * h, dtype=np.uint32) * 7 % 256).astype(np.uint8).reshape(h, w)


# --- bytes to brightness


def test_yuyv_bytes_written_out_by_hand() -> None:
    # two lines of two pixels: Y0 U Y1 V
    raw = np.array([10, 200, 20, 201, 30, 202, 40, 203], np.uint8)
    assert luma(raw, "YUYV", 2, 2).tolist() == [[10, 20], [30, 40]]


def test_grey_bytes_written_out_by_hand() -> None:
    assert luma(np.array([[1, 2, 3, 4, 5, 6]], np.uint8), "GREY", 3, 2).tolist() == [[1, 2, 3], [4, 5, 6]]


def test_padded_lines_are_cut() -> None:
    grey = np.array([1, 2, 99, 3, 4, 99], np.uint8)
    yuyv = np.array([1, 0, 2, 0, 99, 99, 3, 0, 4, 0, 99, 99], np.uint8)
    assert luma(grey, "GREY", 2, 2).tolist() == [[1, 2], [3, 4]]
    assert luma(yuyv, "YUYV", 2, 2).tolist() == [[1, 2], [3, 4]]


@given(w=st.integers(1, 20).map(lambda k: 2 * k), h=st.integers(1, 20), pad=st.integers(0, 9), flat=st.booleans())
def test_yuyv_agrees_with_opencv_in_every_layout(w: int, h: int, pad: int, flat: bool) -> None:
    pairs = np.stack([ramp(w, h), 255 - ramp(w, h)], axis=-1)
    truth = cv2.cvtColor(pairs, cv2.COLOR_YUV2GRAY_YUYV)
    raw = pairs
    if pad or flat:
        raw = np.pad(pairs.reshape(h, -1), ((0, 0), (0, pad)), constant_values=7).reshape(1, -1)
    assert np.array_equal(luma(raw, "YUYV", w, h), truth)


def test_luma_keeps_nothing_of_the_buffer_it_came_from() -> None:
    for fmt, raw in (("GREY", ramp(W, H)), ("YUYV", np.stack([ramp(W, H)] * 2, axis=-1))):
        image = luma(raw, fmt, W, H)
        assert image.flags.c_contiguous
        assert not np.shares_memory(image, raw)


def test_jpeg_grey_colour_and_padded() -> None:
    smooth = np.tile(np.linspace(20, 230, W).astype(np.uint8), (H, 1))
    for image in (smooth, cv2.cvtColor(smooth, cv2.COLOR_GRAY2BGR)):
        raw = np.concatenate([cv2.imencode(".jpg", image)[1].reshape(-1), np.zeros(300, np.uint8)])
        got = luma(raw.reshape(1, -1), "MJPG", W, H)
        assert got.shape == (H, W)
        assert np.abs(got.astype(int) - smooth).max() <= 4


@pytest.mark.parametrize(
    ("fmt", "raw", "says"),
    [
        ("GREY", np.zeros(W * H - 1, np.uint8), "cut short"),
        ("YUYV", np.zeros(W * H, np.uint8), "expected 6144"),
        ("GREY", np.zeros(0, np.uint8), "0 bytes"),
        ("MJPG", np.zeros(500, np.uint8), "no whole JPEG"),
        ("MJPG", np.zeros(0, np.uint8), "no whole JPEG"),
        ("MJPG", cv2.imencode(".jpg", ramp(W, H))[1][:-800], "no whole JPEG"),
        ("MJPG", cv2.imencode(".jpg", ramp(32, H))[1], "32x48, expected 64x48"),
    ],
)
def test_unusable_bytes(fmt: str, raw: np.ndarray, says: str) -> None:
    with pytest.raises(BadFrameError, match=says):
        luma(raw, fmt, W, H)


# --- stamps

NOW = 5_000_000_000_000


def test_stamp_is_exact_to_the_microsecond() -> None:
    # CAP_PROP_POS_MSEC of OpenCV: 1000 * tv_sec + tv_usec / 1000.0
    for sec, usec in ((4999, 999_999), (4999, 1), (4998, 123_457)):
        assert stamp_ns_from_msec(1000 * sec + usec / 1000.0, NOW, 0) == sec * 10**9 + usec * 1000


def test_a_stamp_a_little_ahead_is_taken() -> None:
    assert stamp_ns_from_msec((NOW + 40_000_000) / 1e6, NOW, 0) == NOW + 40_000_000


@pytest.mark.parametrize(
    ("pos_msec", "says"),
    [
        (0.0, "stamp 0"),
        (-1.0, "stamp -1"),
        (math.nan, "nan"),
        (math.inf, "inf"),
        (NOW / 1e6 + 51, r"\+51.0 ms from now"),
        (NOW / 1e6 - 2001, r"-2001.0 ms from now"),
        (1.7e12, "from now"),  # the time of day
        (NOW / 1e6 - 20, "not after the last"),
        (NOW / 1e6 - 10, "not after the last"),
    ],
)
def test_unusable_stamps(pos_msec: float, says: str) -> None:
    with pytest.raises(BadFrameError, match=says):
        stamp_ns_from_msec(pos_msec, NOW, NOW - 10_000_000)


# --- opening


@pytest.mark.parametrize("fmt", ["GREY", "YUYV", "MJPG"])
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


# --- the machine's side


def test_a_missing_device_says_what_is_there(tmp_path: Path) -> None:
    by_id = tmp_path / "dev" / "v4l" / "by-id"
    by_id.mkdir(parents=True)
    (by_id / "usb-ACME_cam-video-index0").symlink_to("/nowhere/video3")
    linux = LinuxDevice(tmp_path / "dev", tmp_path / "sys")
    with pytest.raises(CameraError, match=r"no such device; present: .*usb-ACME_cam-video-index0"):
        linux.resolve(str(tmp_path / "dev" / "video0"))
    with pytest.raises(CameraError, match=r"points to /nowhere/video3, which is gone"):
        linux.resolve(str(by_id / "usb-ACME_cam-video-index0"))


def test_no_camera_at_all(tmp_path: Path) -> None:
    with pytest.raises(CameraError, match="present: no camera at all"):
        LinuxDevice(tmp_path, tmp_path).resolve("/dev/video99")


def test_a_file_is_no_device(tmp_path: Path) -> None:
    (tmp_path / "video0").write_bytes(b"")
    with pytest.raises(CameraError, match="is no device node"):
        LinuxDevice(tmp_path, tmp_path).resolve(str(tmp_path / "video0"))


def test_a_stable_name_is_followed_to_its_node(tmp_path: Path) -> None:
    link = tmp_path / "usb-ACME_cam-video-index0"
    link.symlink_to("/dev/null")
    assert LinuxDevice().resolve(str(link)) == "/dev/null"
    link.unlink()
    link.symlink_to("/dev/zero")  # replugged: another node
    assert LinuxDevice().resolve(str(link)) == "/dev/zero"


def test_no_permission(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "access", lambda *_: False)
    with pytest.raises(CameraError, match="group 'video'"):
        LinuxDevice().resolve("/dev/null")


def test_identity_prefers_the_stable_name(tmp_path: Path) -> None:
    by_id = tmp_path / "dev" / "v4l" / "by-id"
    by_id.mkdir(parents=True)
    (tmp_path / "dev" / "video2").write_bytes(b"")
    (by_id / "usb-ACME_cam_0042-video-index0").symlink_to("../../video2")
    linux = LinuxDevice(tmp_path / "dev", tmp_path / "sys")
    assert linux.identity(str(tmp_path / "dev" / "video2")) == "usb-ACME_cam_0042-video-index0"


def test_identity_from_sysfs(tmp_path: Path) -> None:
    usb = tmp_path / "sys" / "devices" / "usb1" / "1-2"
    (usb / "1-2:1.0").mkdir(parents=True)
    (usb / "serial").write_text("0042\n")
    entry = tmp_path / "sys" / "class" / "video4linux" / "video2"
    entry.mkdir(parents=True)
    (entry / "name").write_text("ACME cam\n")
    linux = LinuxDevice(tmp_path / "dev", tmp_path / "sys")
    assert linux.identity("/dev/video2") == "ACME cam"
    (entry / "device").symlink_to(usb / "1-2:1.0")
    assert linux.identity("/dev/video2") == "ACME cam 0042"
    assert linux.identity("/dev/video3") == ""


def test_opening_bounds_opencvs_own_wait(monkeypatch: pytest.MonkeyPatch) -> None:
    key = "OPENCV_VIDEOIO_V4L_SELECT_TIMEOUT"
    monkeypatch.delenv(key, raising=False)
    seen: list[tuple[object, ...]] = []

    def fake_capture(*args: object) -> None:
        seen.append((*args, os.environ[key]))

    monkeypatch.setattr(cv2, "VideoCapture", fake_capture)
    LinuxDevice().open("/dev/video0", 1.2)
    LinuxDevice().open("/dev/video0", 5.0)
    monkeypatch.delenv(key)
    assert seen == [("/dev/video0", cv2.CAP_V4L2, "2"), ("/dev/video0", cv2.CAP_V4L2, "2")]
