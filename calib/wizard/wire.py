"""Between the wizard's process and the server that started it: JSON lines in, framed messages out.

out: kind (1 byte: J = JSON, P = JPEG to look at, C = PNG to click in), length (4 bytes, big-endian), payload
in:  a JSON object a line, its "do" says what; the end of the input ends the process
"""

from __future__ import annotations

import json
import os
import queue
import struct
import threading
from collections.abc import Callable
from typing import Any, BinaryIO

import cv2
import numpy as np
from numpy.typing import NDArray

from ceilvo.json_values import json_value

_HEAD = struct.Struct(">cI")
_SHOWN_PX = 640
"""Width of a picture to look at, at the most."""
_QUALITY = 80
"""Of its JPEG; chosen: blur is still seen."""


class Wire:
    """Messages may be sent from any thread; commands are for one."""

    def __init__(self, out: BinaryIO, commands: BinaryIO, on_end: Callable[[], object] = lambda: os._exit(0)) -> None:
        """on_end: when the server has gone; all that counts is on disk."""
        self._out, self._commands, self._on_end = out, commands, on_end
        self._lock = threading.Lock()
        self._inbox: queue.SimpleQueue[dict[str, Any]] = queue.SimpleQueue()
        threading.Thread(target=self._read, name="commands", daemon=True).start()

    def say(self, kind: str, **fields: object) -> None:
        self._send(b"J", json.dumps(json_value({"topic": kind, "data": fields}), allow_nan=False).encode())

    def show(self, gray: NDArray[np.uint8]) -> None:
        """A picture (H, W) to look at, made smaller where it is large."""
        h, w = gray.shape
        if w > _SHOWN_PX:
            gray = np.asarray(cv2.resize(gray, (_SHOWN_PX, round(h * _SHOWN_PX / w)), interpolation=cv2.INTER_AREA))
        ok, data = cv2.imencode(".jpg", gray, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])
        if ok:
            self._send(b"P", data.tobytes())

    def show_to_click(self, gray: NDArray[np.uint8]) -> None:
        """A picture (H, W) as it is."""
        self._send(b"C", cv2.imencode(".png", gray)[1].tobytes())

    def command(self, wait: bool) -> dict[str, Any] | None:
        """The next one; None where none has come and there is no waiting."""
        try:
            return self._inbox.get(block=wait)
        except queue.Empty:
            return None

    def _send(self, kind: bytes, payload: bytes) -> None:
        with self._lock:
            self._out.write(_HEAD.pack(kind, len(payload)) + payload)
            self._out.flush()

    def _read(self) -> None:
        for line in self._commands:
            try:
                command = json.loads(line)
            except (ValueError, RecursionError):
                continue
            if isinstance(command, dict):
                self._inbox.put(command)
        self._on_end()
