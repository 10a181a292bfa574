"""Pictures of the running pipeline, drawn by a process of their own.

Drawing one is 20 ms of Python, which the estimator would wait for in the same process. The other process begins with
the first picture and ends when nobody has asked for a while, or with the daemon however that ends.
"""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import threading
from multiprocessing.connection import Connection, Pipe
from pathlib import Path

import cv2
import numpy as np

from ceilvo.calibration import Calibration
from ceilvo.daemon.replay.drawing.innovations import draw_innovations, within_reach
from ceilvo.daemon.replay.drawing.overlay import Image, draw_overlay
from ceilvo.daemon.vision.finder.crossing_finder import View
from ceilvo.drivers.pictures import jpeg
from ceilvo.errors import CeilvoError
from ceilvo.types import Array, Landmarks

_IDLE_S = 30.0
"""Chosen: a page that is loaded again finds the process still there."""
_ANSWER_S = 20.0
"""Patience with a picture, the process' own start included, which takes seconds on a busy computer; chosen."""
_OOM = Path("/proc/self/oom_score_adj")
"""Where memory runs out the kernel ends this process, not the daemon; 500 is halfway to "first"."""
_END_S = 0.3
"""Patience with its end; chosen."""


_Question = tuple[View, Landmarks, Array | None]


class Pictures:
    """Thread-safe."""

    def __init__(self, calibration: Calibration, idle_s: float = _IDLE_S) -> None:
        """idle_s: the process ends when nobody has asked for so long."""
        self._calibration, self._idle_s = calibration, idle_s
        self._lock = threading.Lock()
        self._process: subprocess.Popen[bytes] | None = None
        self._pipe: Connection | None = None

    @property
    def pid(self) -> int | None:
        """Of the process, while there is one."""
        process = self._process
        return None if process is None or process.poll() is not None else process.pid

    def jpeg(self, view: View, landmarks: Landmarks, predicted: Array | None) -> bytes:
        """The picture with all that was found in it; waits for it.

        Args:
            predicted: (3,) map_from_base before the view was taken into account; None: no innovations are drawn.

        Raises:
            CeilvoError: it could not be drawn.
        """
        if predicted is not None and view.crossings is not None:
            landmarks = landmarks.of(within_reach(view.crossings, landmarks, predicted))
        else:
            landmarks, predicted = landmarks.of(np.zeros(len(landmarks), np.bool_)), None
        with self._lock:
            try:
                return self._answer((view, landmarks, predicted))
            except (OSError, EOFError):
                self._end()  # it had been idle for long, or was killed
            try:
                return self._answer((view, landmarks, predicted))
            except (OSError, EOFError) as e:
                self._end()
                raise CeilvoError(f"picture: the process that draws ended twice: {e or 'it said nothing'}") from e

    def close(self) -> None:
        """Idempotent; the next picture starts the process again."""
        with self._lock:
            self._end()

    def _answer(self, question: _Question) -> bytes:
        if self._process is None or self._process.poll() is not None:
            self._end()
            self._begin()
        assert self._pipe is not None
        self._pipe.send(question)
        if not self._pipe.poll(_ANSWER_S):
            self._end()
            raise CeilvoError(f"picture: not drawn within {_ANSWER_S:g} s, expected much less; is the computer busy?")
        return self._pipe.recv_bytes()

    def _begin(self) -> None:
        self._pipe, theirs = Pipe()
        with theirs:
            words = [sys.executable, "-m", __name__, str(theirs.fileno()), f"{self._idle_s:g}"]
            self._process = subprocess.Popen(words, stdin=subprocess.DEVNULL, pass_fds=[theirs.fileno()])
        self._pipe.send(self._calibration)

    def _end(self) -> None:
        if self._pipe is not None:
            self._pipe.close()
        if self._process is not None:
            try:
                self._process.wait(_END_S)
            except subprocess.TimeoutExpired:
                self._process.kill()
                self._process.wait()
        self._process = self._pipe = None


def drawn(view: View, landmarks: Landmarks, predicted: Array | None, calibration: Calibration) -> Image:
    """(H, W, 3) BGR; see Pictures.jpeg()."""
    image = draw_overlay(view.frame.gray, view.lines, view.crossings, calibration.level_view)
    if predicted is not None and view.crossings is not None:
        draw_innovations(image, view.crossings, landmarks, predicted, calibration)
    return image


def main() -> None:
    """The process: answers until nobody asks."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the daemon says when it ends
    with contextlib.suppress(OSError):  # where that is not allowed it draws all the same
        _OOM.write_text("500")
        os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0))  # the daemon's unit does not allow this
    cv2.setNumThreads(1)
    with Connection(int(sys.argv[1])) as pipe:
        try:
            calibration: Calibration = pipe.recv()
            while pipe.poll(float(sys.argv[2])):
                view, landmarks, predicted = pipe.recv()
                pipe.send_bytes(jpeg(drawn(view, landmarks, predicted, calibration)))
        except (EOFError, OSError):
            pass  # the daemon has ended


if __name__ == "__main__":
    main()
