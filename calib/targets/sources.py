"""Where pictures come from: a camera, a folder, a video, or the virtual bench; all give the same pictures."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from ceilvo.config import Camera as CameraConfig
from ceilvo.drivers.camera.recorded import IMAGE_SUFFIXES, INDEX
from ceilvo.drivers.camera.selection import make_camera, source_camera
from ceilvo.drivers.pictures import Gray, decoded
from ceilvo.drivers.ports import Camera
from ceilvo.errors import BadFrameError, CameraError, FileFormatError
from ceilvo.types import Frame

Array = NDArray[np.float64]


_PERIOD_NS = 33_333_333
"""Between pictures of a folder without times; only their order counts."""
_BAD_FRAMES = 30
"""In a row, that a camera is given: one second."""


@dataclass(frozen=True)
class Picture:
    """One picture.

    Attributes:
        name: for messages, unique within a source that can be read again.
        gray: (H, W), empty when it could not be read.
        problem: why it could not be read, "" when it could.
        wheels: (3,) cumulative odom_from_base of the wheels when it was taken, None = not known.
        label: which part of an experiment it belongs to ("spin", "run", a place), "" = none.
    """

    name: str
    stamp_ns: int
    gray: Gray
    problem: str = ""
    wheels: Array | None = None
    label: str = ""


@dataclass(frozen=True)
class SourceInfo:
    """What is known about a source before its first picture is used; filmed: its pictures follow one another in time,
    so that neighbours are alike."""

    name: str
    camera_id: str
    live: bool
    notes: tuple[str, ...] = field(default=())
    filmed: bool = False


class Source(Protocol):
    """Pictures in order; closing is the context's business."""

    info: SourceInfo

    def __iter__(self) -> Iterator[Picture]: ...


class FolderSource:
    """Images of a folder in order of name, each by itself: one that cannot be read does not end the others."""

    def __init__(self, folder: Path) -> None:
        files = sorted(p for p in folder.iterdir() if p.suffix.lower() in IMAGE_SUFFIXES)
        if not files:
            raise FileFormatError(f"{folder}: found no images, expected .png, .jpg or the like")
        self._files = files
        self.info = SourceInfo(str(folder), "", live=False)

    def __iter__(self) -> Iterator[Picture]:
        for i, path in enumerate(self._files):
            gray = _read_gray(path)
            problem = "" if gray.size else "no image that OpenCV can read"
            yield Picture(path.name, (i + 1) * _PERIOD_NS, gray, problem)


def _read_gray(path: Path) -> Gray:
    try:
        image = decoded(path.read_bytes())
    except OSError:
        image = None
    return np.zeros((0, 0), np.uint8) if image is None else image


class CameraSource:
    """Frames of any driver."""

    def __init__(self, camera: Camera) -> None:
        self._camera = camera
        info = camera.open()
        self.info = SourceInfo(info.name, info.camera_id, info.live, info.notes, filmed=True)

    def __iter__(self) -> Iterator[Picture]:
        while (frame := self._read()) is not None:
            yield Picture(f"frame {frame.seq}", frame.stamp_ns, frame.gray)

    def _read(self) -> Frame | None:
        for _ in range(_BAD_FRAMES):
            try:
                return self._camera.read()
            except BadFrameError:
                continue
        raise CameraError(
            f"{self.info.name}: {_BAD_FRAMES} frames in a row could not be used; check the cable and the format"
        )

    def close(self) -> None:
        self._camera.close()


@contextmanager
def open_source(images: Path | None, settings: CameraConfig | None) -> Iterator[Source]:
    """A folder or video when named, else the configured camera.

    Raises:
        CameraError, FileFormatError: nothing there, busy, or not readable.
    """
    if images is not None and images.is_dir() and not (images / INDEX).exists() and _has_images(images):
        yield FolderSource(images)
        return
    camera = source_camera(images) if images is not None else make_camera(settings or CameraConfig())
    source = CameraSource(camera)
    try:
        yield source
    finally:
        source.close()


def _has_images(folder: Path) -> bool:
    return any(p.suffix.lower() in IMAGE_SUFFIXES for p in folder.iterdir())


class ListSource:
    """Pictures that were made by somebody else, for the virtual bench and tests."""

    def __init__(self, name: str, pictures: Iterator[Picture], camera_id: str = "") -> None:
        self._pictures = pictures
        self.info = SourceInfo(name, camera_id, live=False)

    def __iter__(self) -> Iterator[Picture]:
        return self._pictures
