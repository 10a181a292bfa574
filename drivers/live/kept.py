"""What a running robot says on Zenoh, kept as an MCAP file that Foxglove opens."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from pathlib import Path

from ceilvo.config import Zenoh
from ceilvo.drivers.live.foxglove_server import follow
from ceilvo.drivers.recording.mcap_file import Channel, Head, McapFile, Message
from ceilvo.errors import FileFormatError


def keep(
    config: Zenoh, robot: str, path: Path, stop: threading.Event, on_ready: Callable[[], None] = lambda: None
) -> None:
    """Write until `stop` is set.

    Raises:
        FileFormatError: the file is there already, or the disk refuses.
        BusError: Zenoh cannot be used as configured.
    """
    head = Head({"robot": robot, "source": "zenoh"}, {}, time.time_ns() - time.monotonic_ns())
    try:
        file = McapFile(path, head, time.monotonic_ns())
    except OSError as e:
        raise FileFormatError(f"{path}: cannot be written ({e.strerror}); name a new file") from e

    def log_to(channel: Channel, data: bytes, unix_ns: int) -> None:
        file.write(Message(channel, unix_ns - head.unix_minus_monotonic_ns, lambda _: data))

    try:
        follow(config, robot, log_to, stop, on_ready, lambda: file.tick(time.monotonic_ns()), file.close)
    except OSError as e:
        raise FileFormatError(f"{path}: cannot be written ({e.strerror}); make room") from e
    finally:
        file.abandon()
