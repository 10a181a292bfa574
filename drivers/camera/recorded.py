"""Recordings as cameras: image folders, raw frames, video files. Deterministic, and they wait until they are read.

    folder with frames.csv     header `stamp_ns,file`, one line a frame, images in any type that OpenCV reads
    folder of *.raw.gz         gzip of N x H x W bytes, files in order of name; nominal stamps
    folder of images           in order of name; nominal stamps
    video file                 anything that OpenCV's FFmpeg reads; the file's own times

Nominal stamps count from one frame period, so that no stamp is zero. Whatever is wrong with a recording is a
FileFormatError: trying again does not help.
"""

from __future__ import annotations

import csv
import gzip
import io
import reprlib
import zlib
from collections.abc import Iterable, Iterator
from pathlib import Path

import cv2
import numpy as np

from ceilvo.drivers.pictures import Gray, decoded
from ceilvo.drivers.ports import CameraInfo
from ceilvo.errors import CameraError, FileFormatError
from ceilvo.files import write_atomic
from ceilvo.types import Frame

INDEX = "frames.csv"
COLUMNS = ("stamp_ns", "file")
IMAGE_SUFFIXES = frozenset({".bmp", ".jpeg", ".jpg", ".pgm", ".png", ".ppm", ".tif", ".tiff", ".webp"})
RAW_SUFFIX = ".raw.gz"
DEFAULT_RATE_HZ = 30.0
"""Of a video that does not say, and of folders without times."""
_RATES_HZ = (0.01, 1e5)
"""Of a video; chosen: from a picture in two minutes to the fastest cameras. What says otherwise says nothing."""
_LATEST_MSEC = 1e12
"""Of a video's frame: 30 years; chosen, it fits into 64 bits of nanoseconds."""

Shot = tuple[int, Gray, str]
"""stamp_ns, image, and where it is from, for messages."""


class _Recording:
    """What folders and videos share: the first frame is read at open() so that its size is known."""

    def __init__(self, path: Path | str) -> None:
        self.path = Path(path)
        self._shots: Iterator[Shot] | None = None
        self._first: Shot | None = None
        self._shape: tuple[int, int] = (0, 0)
        self._seq = 0

    def open(self) -> CameraInfo:
        self.close()
        shots, rate_hz, notes = self._begin()
        self._first = next(shots, None)
        if self._first is None:
            raise FileFormatError(f"{self.path}: no frame in it")
        self._shots = shots
        self._shape = (self._first[1].shape[0], self._first[1].shape[1])
        h, w = self._shape
        return CameraInfo(str(self.path), "", w, h, rate_hz, live=False, notes=notes)

    def read(self) -> Frame | None:
        shot = self._next()
        if shot is None:
            return None
        stamp_ns, gray, where = shot
        if gray.shape != self._shape:
            h, w = self._shape
            raise FileFormatError(f"{where}: image of {gray.shape[1]}x{gray.shape[0]}, expected {w}x{h} like the first")
        frame = Frame(self._seq, stamp_ns, gray)
        self._seq += 1
        return frame

    def close(self) -> None:
        self._shots, self._first, self._seq = None, None, 0

    def _begin(self) -> tuple[Iterator[Shot], float, tuple[str, ...]]:
        raise NotImplementedError

    def _next(self) -> Shot | None:
        if self._shots is None:
            raise CameraError(f"{self.path}: recording is not open")
        first, self._first = self._first, None
        return first if first is not None else next(self._shots, None)


class FolderCamera(_Recording):
    """Frames of a folder: frames.csv, else *.raw.gz, else images.

    Args:
        width_px, height_px: size of raw frames, which do not tell it themselves; unused otherwise.
        rate_hz: nominal rate where there is no frames.csv.
    """

    def __init__(
        self,
        path: Path | str,
        *,
        width_px: int | None = None,
        height_px: int | None = None,
        rate_hz: float = DEFAULT_RATE_HZ,
    ) -> None:
        super().__init__(path)
        self._size = (width_px, height_px)
        self._rate_hz = rate_hz

    def _begin(self) -> tuple[Iterator[Shot], float, tuple[str, ...]]:
        folder = self.path
        if not folder.is_dir():
            raise FileFormatError(f"{folder}: no such folder")
        if (folder / INDEX).is_file():
            rows = _read_index(folder / INDEX)
            return _indexed_shots(rows), _mean_rate_hz([stamp for stamp, _, _ in rows], self._rate_hz), ()
        nominal = f"no {INDEX} in {folder}: stamps assume {self._rate_hz:g} frames per second"
        if raws := sorted(folder.glob(f"*{RAW_SUFFIX}")):
            return self._raw_shots(raws), self._rate_hz, (nominal,)
        images = sorted(p for p in folder.iterdir() if p.suffix.lower() in IMAGE_SUFFIXES)
        if not images:
            raise FileFormatError(f"{folder}: neither {INDEX} nor *{RAW_SUFFIX} nor images in it")
        shots = ((_nominal_ns(i, self._rate_hz), _read_image(p, str(p)), str(p)) for i, p in enumerate(images))
        return shots, self._rate_hz, (nominal,)

    def _raw_shots(self, files: list[Path]) -> Iterator[Shot]:
        w, h = self._size
        if w is None or h is None:
            raise FileFormatError(f"{files[0]}: raw frames need width_px and height_px")
        frames = (shot for f in files for shot in _read_raw(f, w, h))
        return ((_nominal_ns(i, self._rate_hz), gray, where) for i, (gray, where) in enumerate(frames))


class VideoCamera(_Recording):
    """Frames of a video file, stamped with the file's own times; rate_hz serves where the file does not tell."""

    def __init__(self, path: Path | str, *, rate_hz: float = DEFAULT_RATE_HZ) -> None:
        super().__init__(path)
        self._rate_hz = rate_hz
        self._capture: cv2.VideoCapture | None = None

    def close(self) -> None:
        super().close()
        if self._capture is not None:
            self._capture.release()
            self._capture = None

    def _begin(self) -> tuple[Iterator[Shot], float, tuple[str, ...]]:
        if not self.path.is_file():
            raise FileFormatError(f"{self.path}: no such video file")
        capture = cv2.VideoCapture(str(self.path), cv2.CAP_FFMPEG)
        if not capture.isOpened():
            raise FileFormatError(f"{self.path}: no video that OpenCV can read; 'ffprobe {self.path}' tells what it is")
        self._capture = capture
        rate_hz, notes = capture.get(cv2.CAP_PROP_FPS), ()
        if not _RATES_HZ[0] <= rate_hz <= _RATES_HZ[1]:
            rate_hz = self._rate_hz
            return self._video_shots(capture, rate_hz), rate_hz, (f"{self.path} tells no rate: {rate_hz:g} assumed",)
        return self._video_shots(capture, rate_hz), rate_hz, notes

    def _video_shots(self, capture: cv2.VideoCapture, rate_hz: float) -> Iterator[Shot]:
        period_ns = round(1e9 / rate_hz)
        last_ns = 0
        while True:
            ok, image = capture.read()
            if not ok:
                return
            pos_msec = capture.get(cv2.CAP_PROP_POS_MSEC)
            stamp_ns = period_ns + (round(pos_msec * 1e6) if abs(pos_msec) < _LATEST_MSEC else 0)
            if stamp_ns <= last_ns:  # a container without times, or with broken ones
                stamp_ns = last_ns + period_ns
            last_ns = stamp_ns
            yield stamp_ns, _gray(image), str(self.path)


def write_folder(folder: Path | str, frames: Iterable[Frame], image_format: str = "png") -> int:
    """Write frames as a folder that FolderCamera reads back, and return how many.

    frames.csv comes last, so an interrupted recording has images but no index. image_format is a suffix that OpenCV
    writes; png, pgm and bmp keep the pixels exactly.

    Raises:
        FileFormatError: the folder holds a recording already, a stamp does not increase, or the format is unknown.
    """
    folder = Path(folder)
    if not cv2.haveImageWriter(f"x.{image_format}"):
        raise FileFormatError(f"image format {image_format!r}: OpenCV cannot write it, expected for example png")
    if (folder / INDEX).exists():
        raise FileFormatError(f"{folder / INDEX} exists; choose another folder, or delete it")
    folder.mkdir(parents=True, exist_ok=True)
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(COLUMNS)
    count, last_ns = 0, -1
    for frame in frames:
        if frame.stamp_ns <= last_ns:
            raise FileFormatError(f"{folder}: frame {count}: stamp {frame.stamp_ns} ns is not after {last_ns} ns")
        name = f"{count:06d}.{image_format}"
        (folder / name).write_bytes(cv2.imencode(f".{image_format}", frame.gray)[1].tobytes())
        writer.writerow((frame.stamp_ns, name))
        count, last_ns = count + 1, frame.stamp_ns
    write_atomic(folder / INDEX, text.getvalue())
    return count


Row = tuple[int, Path, str]
_STAMPS, _STAMP_DIGITS = 1 << 63, 19
"""The first stamp that no 64 bits hold, and its digits: more are not even turned into a number."""


def _read_index(index: Path) -> list[Row]:
    """(stamp_ns, image file, where) of every row, all checked before the first image is read."""
    try:
        text = index.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as exc:
        raise FileFormatError(f"{index}: cannot be read: {exc}") from exc
    reader = csv.DictReader(io.StringIO(text, newline=""), skipinitialspace=True)
    rows: list[Row] = []
    try:
        missing = [c for c in COLUMNS if c not in (reader.fieldnames or ())]
        if missing:
            found = reprlib.repr(reader.fieldnames) if reader.fieldnames else "nothing"
            raise FileFormatError(
                f"{index}: column {missing[0]!r} is missing, found {found}; the first line must be {','.join(COLUMNS)}"
            )
        for record in reader:
            rows.append(_index_row(index, f"{index} line {reader.line_num}", record, rows[-1][0] if rows else -1))
    except csv.Error as exc:
        raise FileFormatError(f"{index} line {reader.line_num + 1}: {exc}; expected a stamp and a file name") from exc
    return rows


def _index_row(index: Path, where: str, record: dict[str, str | None], last_ns: int) -> Row:
    stamp, name = record["stamp_ns"], record["file"]
    digits = stamp if stamp and stamp.isascii() and stamp.isdigit() and len(stamp) <= _STAMP_DIGITS else ""
    stamp_ns = int(digits) if digits else _STAMPS
    if stamp_ns >= _STAMPS:
        raise FileFormatError(f"{where}: stamp_ns {reprlib.repr(stamp)}, expected whole nanoseconds below 2^63")
    if stamp_ns <= last_ns:
        raise FileFormatError(f"{where}: stamp_ns {stamp_ns} is not after the one before, {last_ns}")
    path = index.parent / (name or "")
    try:
        there = bool(name) and path.is_file()
    except (OSError, ValueError):  # longer than a name may be, or with a zero byte
        there = False
    if not there:
        raise FileFormatError(f"{where}: file {reprlib.repr(name)} does not exist in {index.parent}")
    return stamp_ns, path, where


def _indexed_shots(rows: list[Row]) -> Iterator[Shot]:
    return ((stamp_ns, _read_image(path, where), where) for stamp_ns, path, where in rows)


def _read_image(path: Path, where: str) -> Gray:
    try:
        data = path.read_bytes()
    except OSError as exc:
        raise FileFormatError(f"{where}: {path} cannot be read: {exc}") from exc
    image = decoded(data)
    if image is None:
        raise FileFormatError(f"{where}: {path.name} is no image that OpenCV can read ({len(data)} bytes)")
    return image


def _read_raw(path: Path, width_px: int, height_px: int) -> Iterator[tuple[Gray, str]]:
    size = width_px * height_px
    count = 0
    try:
        with gzip.open(path, "rb") as f:
            while data := f.read(size):
                if len(data) < size:
                    raise FileFormatError(
                        f"{path}: frame {count} has {len(data)} bytes, expected {size} ({width_px}x{height_px}); "
                        "cut short, or width_px and height_px are not its own"
                    )
                yield np.frombuffer(data, np.uint8).reshape(height_px, width_px), f"{path} frame {count}"
                count += 1
    except (OSError, EOFError, zlib.error) as exc:
        raise FileFormatError(f"{path}: frame {count}: damaged gzip file: {exc}") from exc


def _gray(image: cv2.typing.MatLike) -> Gray:
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY) if image.ndim == 3 else image, np.uint8)


def _nominal_ns(index: int, rate_hz: float) -> int:
    return round((index + 1) * 1e9 / rate_hz)


def _mean_rate_hz(stamps_ns: list[int], default_hz: float) -> float:
    if len(stamps_ns) < 2:
        return default_hz
    return (len(stamps_ns) - 1) * 1e9 / (stamps_ns[-1] - stamps_ns[0])
