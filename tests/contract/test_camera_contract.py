"""What every camera must do, run on every camera there is."""

from __future__ import annotations

import gzip
import os
from pathlib import Path

import cv2
import numpy as np
import pytest

from ceilvo import config
from ceilvo.drivers.camera.mock_camera import MockCamera, moving_square
from ceilvo.drivers.camera.mock_v4l2 import MockV4l2Device
from ceilvo.drivers.camera.recorded import FolderCamera, VideoCamera, write_folder
from ceilvo.drivers.camera.v4l2_camera import V4l2Camera
from ceilvo.drivers.ports import Camera, CameraInfo
from ceilvo.errors import CameraError
from ceilvo.types import Frame

W, H, FRAMES = 64, 48, 12


def no_wait(_seconds: float) -> None:
    pass


class CameraContract:
    """Subclasses make a camera that has more than 6 frames."""

    def make(self, tmp_path: Path) -> Camera:
        raise NotImplementedError

    @pytest.fixture
    def camera(self, tmp_path: Path) -> Camera:
        return self.make(tmp_path)

    def read(self, camera: Camera, count: int) -> list[Frame]:
        frames = []
        for _ in range(count):
            frame = camera.read()
            assert frame is not None
            frames.append(frame)
        return frames

    def test_info_tells_what_frames_are(self, camera: Camera) -> None:
        info = camera.open()
        assert isinstance(info, CameraInfo)
        assert info.name
        assert info.rate_hz > 0
        for frame in self.read(camera, 3):
            assert frame.gray.shape == (info.height_px, info.width_px)
            assert frame.gray.dtype == np.uint8
            assert frame.gray.ndim == 2
        camera.close()

    def test_sequence_and_stamps_increase_strictly(self, camera: Camera) -> None:
        camera.open()
        frames = self.read(camera, 6)
        camera.close()
        assert all(isinstance(f.seq, int) and isinstance(f.stamp_ns, int) for f in frames)
        assert all(f.stamp_ns > 0 for f in frames)
        assert (np.diff([f.seq for f in frames]) > 0).all()
        assert (np.diff([f.stamp_ns for f in frames]) > 0).all()

    def test_a_frame_stays_as_it_was_while_more_are_read(self, camera: Camera) -> None:
        camera.open()
        first = self.read(camera, 1)[0]
        before = first.gray.copy()
        self.read(camera, 5)
        camera.close()
        assert np.array_equal(first.gray, before)

    def test_reading_before_open_and_after_close_is_a_camera_error(self, camera: Camera) -> None:
        with pytest.raises(CameraError):
            camera.read()
        camera.open()
        self.read(camera, 1)
        camera.close()
        with pytest.raises(CameraError):
            camera.read()

    def test_close_is_idempotent_and_allowed_before_open(self, camera: Camera) -> None:
        camera.close()
        camera.open()
        camera.close()
        camera.close()

    def test_opens_again(self, camera: Camera) -> None:
        first_info = camera.open()
        before = self.read(camera, 3)
        camera.close()
        again = camera.open()
        after = self.read(camera, 3)
        camera.close()
        assert (again.width_px, again.height_px, again.camera_id) == (
            first_info.width_px,
            first_info.height_px,
            first_info.camera_id,
        )
        if again.live:
            assert after[0].seq > before[-1].seq
            assert after[0].stamp_ns > before[-1].stamp_ns
        else:
            assert [f.seq for f in after] == [f.seq for f in before]
            assert [f.stamp_ns for f in after] == [f.stamp_ns for f in before]
            assert all(np.array_equal(a.gray, b.gray) for a, b in zip(after, before, strict=True))

    def test_a_recording_ends_and_stays_at_its_end(self, camera: Camera) -> None:
        if camera.open().live:
            camera.close()
            pytest.skip("a live camera never ends")
        count = 0
        while camera.read() is not None:
            count += 1
        assert count > 6
        assert camera.read() is None
        camera.close()


def shots(count: int = FRAMES) -> list[Frame]:
    return [Frame(i, 5_000_000_000 + i * 40_000_000, moving_square(i, W, H)) for i in range(count)]


class TestFolder(CameraContract):
    def make(self, tmp_path: Path) -> Camera:
        write_folder(tmp_path, shots())
        return FolderCamera(tmp_path)


class TestPlainImages(CameraContract):
    def make(self, tmp_path: Path) -> Camera:
        for f in shots():
            cv2.imwrite(str(tmp_path / f"{f.seq:03d}.pgm"), f.gray)
        return FolderCamera(tmp_path, rate_hz=20.0)


class TestRawFrames(CameraContract):
    def make(self, tmp_path: Path) -> Camera:
        for part in range(2):
            data = b"".join(f.gray.tobytes() for f in shots()[part::2])
            (tmp_path / f"part{part}.raw.gz").write_bytes(gzip.compress(data, 1))
        return FolderCamera(tmp_path, width_px=W, height_px=H)


class TestVideo(CameraContract):
    def make(self, tmp_path: Path) -> Camera:
        path = tmp_path / "v.avi"
        writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 15.0, (W, H))
        for f in shots():
            writer.write(cv2.cvtColor(f.gray, cv2.COLOR_GRAY2BGR))
        writer.release()
        return VideoCamera(path)


class TestMock(CameraContract):
    def make(self, tmp_path: Path) -> Camera:
        return MockCamera(width_px=W, height_px=H, wait=no_wait)


class TestMockRecording(CameraContract):
    def make(self, tmp_path: Path) -> Camera:
        from ceilvo.drivers.camera.mock_camera import Good

        return MockCamera([Good(FRAMES)], live=False, wait=no_wait)


@pytest.mark.parametrize("pixel_format", ["GREY", "YUYV", "MJPG", "UYVY", "Y10", "Y12P"])
@pytest.mark.parametrize("flat", [False, True], ids=["shaped", "flat"])
class TestV4l2OnMock(CameraContract):
    @pytest.fixture
    def camera(self, pixel_format: str, flat: bool) -> Camera:
        settings = config.Camera(pixel_format=pixel_format, width_px=W, height_px=H)
        return V4l2Camera(settings, MockV4l2Device(flat=flat))


class TestSimulated(CameraContract):
    def make(self, tmp_path: Path) -> Camera:
        camera = pytest.importorskip("ceilvo.sim.camera")
        world = pytest.importorskip("ceilvo.sim.world")
        made: Camera = camera.SimCamera(world.World(world.WorldSpec()), 30.0, realtime=False, duration_s=0.25)
        return made


class TestV4l2OnDevice(CameraContract):
    """CEILVO_TEST_CAMERA names the device and, after a comma each, format, width and height."""

    def make(self, tmp_path: Path) -> Camera:
        device, *rest = os.environ.get("CEILVO_TEST_CAMERA", "/dev/video0").split(",")
        if not Path(device).exists():
            pytest.skip(f"no {device} on this machine; the virtual robot's test has one")
        pixel_format, width, height = rest or ("YUYV", "640", "480")
        return V4l2Camera(
            config.Camera(device=device, pixel_format=pixel_format, width_px=int(width), height_px=int(height))
        )
