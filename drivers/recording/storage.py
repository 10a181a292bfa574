"""Where a recorder writes: one file, or a ring of files of which those around a fault are kept.

<folder>/ring/flight-000123.mcap                    the last minutes; the oldest are deleted
<folder>/kept/000120-state-lost/flight-000120.mcap  what was in the ring when a fault came, and a little after
"""

from __future__ import annotations

import errno
import re
import shutil
from dataclasses import dataclass
from pathlib import Path

from ceilvo.config import Recorder as RecorderConfig
from ceilvo.drivers.recording.mcap_file import Head, McapFile, Message
from ceilvo.files import write_atomic

_PREFIX = "flight-"
_NS = 1e-9
"""Seconds in a nanosecond."""
_GRACE_S = 2.0
"""By which a segment or a kept fault may run late before it is closed in between."""
_SEGMENTS = 8
"""Of the ring; the oldest one is deleted as a whole."""
_MIN_SEGMENT_S = 5.0  # a new one starts with the whole state of the pipeline, which may be megabytes
_MAX_SEGMENT_S = 60.0  # chosen: of a long ring, too, the oldest goes minute by minute
_MAX_AFTER = 6
"""Times the usual time after a fault that faults in a row may prolong one file."""
_ROOM_CHECK_S = 1.0
"""Between two looks at the disk's room."""
_NAME_CHARS = 40
"""Of a fault in a file's name."""
_BOOT_ID = Path("/proc/sys/kernel/random/boot_id")


def check_room(folder: Path, reserve_bytes: int) -> None:
    """Raises OSError when recording would take the room that map and state need."""
    free = shutil.disk_usage(folder).free
    if free < reserve_bytes:
        raise OSError(errno.ENOSPC, f"{free / 1e6:.0f} MB left, {reserve_bytes / 1e6:.0f} MB are not for recordings")


class SingleFile:
    """A recorder.Storage: one file from start to end."""

    retries = False
    due = False

    def __init__(self, path: Path, head: Head, stamp_ns: int, reserve_bytes: int) -> None:
        """Raises OSError when the file cannot be made, or is there already."""
        self._file = McapFile(path, head, stamp_ns, start="fresh")
        self._reserve_bytes = reserve_bytes
        self._checked_ns = stamp_ns

    def write(self, message: Message) -> None:
        self._file.write(message)

    def begin(self, now_ns: int) -> None:
        """It has but one file."""

    def fault(self, reason: str, now_ns: int) -> None:
        """All is kept anyway."""

    def tick(self, now_ns: int) -> None:
        self._file.tick(now_ns)
        if (now_ns - self._checked_ns) * _NS >= _ROOM_CHECK_S:
            self._checked_ns = now_ns
            check_room(self._file.path.parent, self._reserve_bytes)

    def close(self) -> None:
        self._file.close()

    def abandon(self) -> None:
        self._file.abandon()

    def bytes_written(self) -> int:
        return self._file.path.stat().st_size


@dataclass(frozen=True, slots=True)
class _Segment:
    path: Path
    bytes: int
    seconds: float


class Ring:
    """A recorder.Storage in bounded room.

    A process that was killed leaves its ring; the next one keeps it as a fault, unless the computer was switched off
    in between.
    """

    retries = True

    def __init__(self, folder: Path, settings: RecorderConfig, head: Head, boot_id: str | None = None) -> None:
        self._ring, self._kept = folder / "ring", folder / "kept"
        self._cfg, self._head = settings, head
        self._boot_id = _text(_BOOT_ID) if boot_id is None else boot_id
        self._segments: list[_Segment] = []
        self._file: McapFile | None = None
        self._start = "fresh"
        self._number = 0
        self._ready = self._marked = False
        self._keeping: Path | None = None
        self._keep_until_ns = self._keep_limit_ns = 0
        self._checked_ns = self._now_ns = 0
        self._closed_bytes = 0
        self._segment_s = min(max(60.0 * settings.minutes / _SEGMENTS, 1.0), _MAX_SEGMENT_S)

    @property
    def due(self) -> bool:
        if self._file is None:
            return False
        full = self._file.size * _SEGMENTS > self._cfg.ring_bytes and self._age_s() >= _MIN_SEGMENT_S
        return full or self._age_s() >= self._segment_s or self._kept_enough()

    def write(self, message: Message) -> None:
        if self._file is None:
            self._open(self._now_ns)
        assert self._file is not None
        self._file.write(message)

    def begin(self, now_ns: int) -> None:
        self._end_segment()
        if self._keeping is not None and now_ns >= self._keep_until_ns:
            self._keeping = None
        self._trim()
        self._open(now_ns)

    def fault(self, reason: str, now_ns: int) -> None:
        after_ns = int(self._cfg.after_fault_s / _NS)
        if self._keeping is None:
            self._make_ready()
            files = [s.path for s in self._segments] + ([] if self._file is None else [self._file.path])
            first = files[0].stem if files else _name(self._number)
            self._keeping = self._kept / f"{first.removeprefix(_PREFIX)}-{_slug(reason)}"
            self._keeping.mkdir(parents=True, exist_ok=True)
            self._keep_limit_ns = now_ns + _MAX_AFTER * after_ns
            for segment in self._segments:
                segment.path.replace(self._keeping / segment.path.name)
            self._segments = []
        self._keep_until_ns = min(now_ns + after_ns, self._keep_limit_ns)

    def tick(self, now_ns: int) -> None:
        self._now_ns = now_ns
        self._make_ready()
        if self._file is not None:
            self._file.tick(now_ns)
        if self.due and self._overdue():
            self._start = "unknown"
            self.begin(now_ns)
        if (now_ns - self._checked_ns) * _NS >= _ROOM_CHECK_S:
            self._checked_ns = now_ns
            self._trim()
            self._make_room()

    def close(self) -> None:
        self._end_segment()
        (self._ring / "run").unlink(missing_ok=True)

    def abandon(self) -> None:
        """What is on the disk is looked at anew when it is tried again: it may be another disk by then."""
        if self._file is not None:
            self._file.abandon()
        self._file, self._start, self._keeping = None, "unknown", None
        self._segments, self._ready = [], False

    def bytes_written(self) -> int:
        return self._closed_bytes + (0 if self._file is None else self._file.size)

    def _age_s(self) -> float:
        return 0.0 if self._file is None else _NS * (self._now_ns - self._file.started_ns)

    def _kept_enough(self) -> bool:
        return self._keeping is not None and self._now_ns >= self._keep_until_ns

    def _overdue(self) -> bool:
        """Nobody says where a replay could start (nothing is estimated): go on without."""
        kept_s = _NS * (self._now_ns - self._keep_until_ns) if self._keeping is not None else 0.0
        return max(self._age_s() - self._segment_s, kept_s) > _GRACE_S

    def _make_ready(self) -> None:
        """Folders, and what an earlier run left."""
        if self._ready:
            return
        for folder in (self._ring.parent, self._ring, self._kept):  # not their parent: it may be a disk that is gone
            folder.mkdir(exist_ok=True)
        found = sorted(self._ring.glob(f"{_PREFIX}*.mcap"))
        self._segments = [_Segment(p, _size(p), self._segment_s) for p in found if p.is_file()]
        numbers = [int(m[1]) for p in (*found, *self._kept.glob("*/*.mcap")) if (m := re.search(r"(\d+)$", p.stem))]
        self._number = max(self._number, max(numbers, default=-1) + 1)
        self._ready = True
        mark = self._ring / "run"
        if not self._marked and self._segments and self._boot_id and _text(mark) == self._boot_id:
            self.fault("the process died", self._now_ns)
            self._keeping = None
        write_atomic(mark, self._boot_id + "\n")
        self._marked = True

    def _open(self, stamp_ns: int) -> None:
        self._make_ready()
        self._file = McapFile(self._ring / f"{_name(self._number)}.mcap", self._head, stamp_ns, start=self._start)
        self._number += 1
        self._start = "joined"

    def _end_segment(self) -> None:
        file = self._file
        if file is None:
            return
        seconds = self._age_s()
        file.close()
        self._file = None
        size = _size(file.path)
        self._closed_bytes += size
        if self._keeping is not None:
            file.path.replace(self._keeping / file.path.name)
        else:
            self._segments.append(_Segment(file.path, size, seconds))

    def _trim(self) -> None:
        current = 0 if self._file is None else self._file.size
        while self._segments and (
            current + sum(s.bytes for s in self._segments) > self._cfg.ring_bytes
            or sum(s.seconds for s in self._segments[1:]) >= 60.0 * self._cfg.minutes
        ):
            self._drop_oldest()
        folders = sorted(p for p in self._kept.glob("*") if p.is_dir()) if self._ready else []
        sizes = {p: sum(_size(f) for f in p.glob("*")) for p in folders}
        for folder in folders:
            if sum(sizes.values()) > self._cfg.kept_bytes and folder != self._keeping:
                shutil.rmtree(folder)
                del sizes[folder]

    def _make_room(self) -> None:
        while True:
            try:
                return check_room(self._ring, self._cfg.reserve_bytes)
            except OSError:
                if not self._segments:
                    raise
                self._drop_oldest()

    def _drop_oldest(self) -> None:
        self._segments.pop(0).path.unlink(missing_ok=True)


def _name(number: int) -> str:
    return f"{_PREFIX}{number:06d}"


def _slug(text: str) -> str:
    return re.sub(r"[^a-z0-9]+", "-", text.lower()).strip("-")[:_NAME_CHARS] or "fault"


def _size(path: Path) -> int:
    return path.stat().st_size


def _text(path: Path) -> str:
    try:
        return path.read_text(errors="replace").strip()
    except OSError:
        return ""
