"""The machine's side of a V4L2 camera: device nodes, stable names, rights, and OpenCV's own wait."""

from __future__ import annotations

import os
from pathlib import Path

import cv2
import pytest

from ceilvo.drivers.camera.v4l2_device import LinuxDevice
from ceilvo.errors import CameraError


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
