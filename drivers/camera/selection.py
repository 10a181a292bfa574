"""Which camera a configuration or a path means."""

from __future__ import annotations

from pathlib import Path

from ceilvo.config import Camera as CameraConfig
from ceilvo.drivers.camera.recorded import DEFAULT_RATE_HZ, RAW_SUFFIX, FolderCamera, VideoCamera
from ceilvo.drivers.camera.v4l2_camera import V4l2Camera
from ceilvo.drivers.ports import Camera
from ceilvo.errors import ConfigError, FileFormatError


def make_camera(settings: CameraConfig, readout_s: float = 0.0) -> Camera:
    """The camera that camera.source asks for, not opened.

    Args:
        readout_s: of its rolling shutter, as calibrated.

    Raises:
        ConfigError: source is folder or video and camera.path is empty.
    """
    if settings.source == "v4l2":
        return V4l2Camera(settings, readout_s=readout_s)
    if not settings.path:
        raise ConfigError(f"camera.path: empty, but camera.source is {settings.source!r}; name the {settings.source}")
    if settings.source == "folder":
        return FolderCamera(
            settings.path, width_px=settings.width_px, height_px=settings.height_px, rate_hz=settings.rate_hz
        )
    return VideoCamera(settings.path, rate_hz=settings.rate_hz)


def source_camera(
    path: Path | str,
    width_px: int | None = None,
    height_px: int | None = None,
    rate_hz: float = DEFAULT_RATE_HZ,
) -> Camera:
    """The recording at a path, not opened: a folder, or else a video file; sizes serve raw frames only.

    Raises:
        FileFormatError: nothing is there, or a single file of raw frames, which its folder should be named for.
    """
    path = Path(path)
    if path.is_dir():
        return FolderCamera(path, width_px=width_px, height_px=height_px, rate_hz=rate_hz)
    if path.name.endswith((RAW_SUFFIX, ".csv")):
        raise FileFormatError(f"{path}: name the folder that it is in, {path.parent}")
    if not path.exists():
        raise FileFormatError(f"{path}: no such folder or video file")
    return VideoCamera(path, rate_hz=rate_hz)
