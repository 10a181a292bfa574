"""The binding of the compiled loops: what does not fit is refused, and other threads run meanwhile."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import cv2
import numpy as np
import pytest

from ceilvo.daemon.vision import kernel
from ceilvo.daemon.vision.kernel.arguments import Arm, Grids, Look, Step, Widths

pytestmark = pytest.mark.skipif(not kernel.COMPILED, reason="ceilvo was installed without a compiler")
LOOPS = (
    *("level_points", "follow", "split", "vote", "project", "assign", "settle", "spread", "extents", "crowd"),
    *("slope_quartiles", "peaks", "direction"),
    *("align", "fit", "picture", "join", "arms"),
)
ANY_LENGTH = {
    *(("follow", 2), ("settle", 7), ("spread", 2), ("crowd", 0), ("align", 4), ("align", 8), ("picture", 6)),
    *(("slope_quartiles", 0), ("follow", 0), ("slope_quartiles", 1), ("direction", 0)),
    *(("arms", 2), ("arms", 4)),
}
"""Loops and arguments: lines, edges and positions, of which there may be any number."""


def calls(height: int, width: int, points: int) -> dict[str, tuple[Any, ...]]:
    """Arguments that fit, for every loop: a picture of noise, and so many points.

    Results are small, because NumPy lets go of the GIL while it fetches 1 kB of zeros or more.
    """
    rng = np.random.default_rng(0)
    dx, dy = rng.integers(-900, 900, (2, height, width)).astype(np.int16)
    framed = rng.integers(0, 256, (height + 2, width + 2)).astype(np.uint8)
    cells = np.stack(np.meshgrid(np.arange(0, width + 2, 2), np.arange(0, height + 2, 2)), -1).astype(np.float32)
    grids = Grids(cells, cells, (0.0, 0.0), 2.0)  # level pixels are raw ones
    lines = np.tile([1.0, 0.0, 0.5 * width, 0.0, height], (1 + points // 1000, 1))
    x, y = rng.uniform(-0.7, 0.7, (2, points)).astype(np.float32)
    ends = (0, points // 4, points // 2, points // 2, points)
    uv, line = np.column_stack([x, y]), np.zeros(points, np.int32)
    return {
        "level_points": (np.full(dx.shape, 255, np.uint8), dx, dy, cells, np.zeros(dx.shape, np.uint16), 65535),
        "follow": (framed, grids, lines, np.zeros(2), 100.0, Look(2.0, 2.0, 50.0, 0.5, False)),
        "split": (uv, np.abs(x) * 360, 0.0, 10.0, 1.0),
        "vote": (x, y, ends, (0.0, 1.5), 10.0, 10),
        "peaks": (np.ones((4, points), np.int64), 9.0),
        "direction": (np.abs(x) * 360, 4.0, 1),
        "project": (x, y, ends[2], 0.1, np.zeros(2)),
        "assign": (x, y, x, y, ends, np.zeros(4), np.arange(4), 0.1),
        "settle": (x, y, line, ends[2], 0.1, np.zeros(2), 100.0, np.zeros(3)),
        "spread": (x, line, np.zeros(3), 100.0, 1),
        "extents": (x, line, 3),
        "slope_quartiles": (framed, np.zeros(points, np.int64)),
        "crowd": (uv[:3000], 0.1),
        "align": (x, y, line, ends[2], np.zeros(3), 0.1, 100.0, np.ones(5), np.full(3, 9.0), np.ones(25)),
        "fit": (x, y, line, ends[2], 3, 0.1, np.zeros(2), Step(100.0, 9.0, 0.1, 1e-3, 1.0, False)),
        "picture": (x, y, line, ends[2], 0.1, 100.0, np.arange(3)),
        "join": (
            np.arange(float(points)),
            x.astype(float),
            line.astype(int),
            line.astype(int),
            *(np.zeros(points),) * 2,
            0.0,
            Widths(2, 6, 1),
        ),
        "arms": (uv, line.astype(int), line[:3], np.array([1.0, 0.0]), np.zeros(20), Arm(0.5, 0.1, 0.1, 2.0)),
    }


@pytest.mark.parametrize("name", LOOPS)
def test_an_array_of_another_shape_type_or_layout_is_refused(name: str) -> None:
    loop, good = getattr(kernel, name), calls(8, 10, 40)[name]
    loop(*good)
    for i, argument in enumerate(good):
        if not isinstance(argument, np.ndarray):
            continue
        wrong: list[tuple[type[Exception], str, Any]] = [
            (ValueError, "Buffer dtype mismatch", argument.astype(np.complex64)),
            (ValueError, "wrong number of dimensions", argument[None]),
            (TypeError, "must not be None", None),
            (TypeError, "bytes-like object is required", argument.tolist()),
        ]
        if (name, i) not in ANY_LENGTH:
            wrong.append((ValueError, "expected", argument[: len(argument) // 2]))
        if argument.dtype != np.float64:  # two or three numbers need not stand side by side
            wrong.append((ValueError, "ndarray is not C-contiguous", np.repeat(argument, 2, axis=-1)[..., ::2]))
        for error, match, bad in wrong:
            with pytest.raises(error, match=match):
                loop(*good[:i], bad, *good[i + 1 :])


def test_look_ups_of_another_shape_or_type_are_refused() -> None:
    framed, grids, *rest = calls(8, 10, 40)["follow"]
    for key in ("lookup", "raw_of_level"):
        table = getattr(grids, key)
        for error, match, bad in (
            (ValueError, "Buffer dtype mismatch", table.astype(np.float64)),
            (ValueError, "wrong number of dimensions", table[0]),
            (ValueError, "has 3 items, expected 2", np.zeros((*table.shape[:2], 3), np.float32)),
            (TypeError, "a look-up is None", None),
        ):
            with pytest.raises(error, match=match):
                kernel.follow(framed, grids._replace(**{key: bad}), *rest)


def test_indices_beyond_their_array_are_refused() -> None:
    good = calls(8, 10, 40)
    x, y, line, half, _, *step = good["fit"]
    points, lines, *rest = good["arms"]
    for match, loop, arguments in (
        ("line 7 of 3", kernel.fit, (x, y, line + 7, half, 3, *step)),
        ("line -1 of 3", kernel.settle, (*good["settle"][:2], line - 1, *good["settle"][3:])),
        ("line 3 of 3", kernel.extents, (x, line + 3, 3)),
        ("line 4 of 3", kernel.spread, (x, line + 4, *good["spread"][2:])),
        ("line 3 of 3", kernel.align, (x, y, line + 3, *good["align"][3:])),
        ("line 3 of 3", kernel.picture, (x, y, line + 3, *good["picture"][3:])),
        ("line 5 of 3", kernel.arms, (points, lines + 5, *rest)),
        ("pixel 80 of 80", kernel.slope_quartiles, (good["slope_quartiles"][0], np.array([80]))),
        ("expected 1 at least", kernel.spread, (*good["spread"][:4], 0)),
        ("expected one at least, an odd number", kernel.align, (*good["align"][:9], np.ones(4))),
        ("99 of 40 points belong to axis 0", kernel.project, (x, y, 99, 0.0, np.zeros(2))),
        ("expected 1 at least", kernel.vote, (*good["vote"], 0)),
        ("expected 3 at least, and more than 0", kernel.peaks, (good["peaks"][0], 0.0)),
        ("expected points, and 1 at least", kernel.direction, (x[:0], 4.0, 1)),
        ("expected points, and 1 at least", kernel.direction, (x, 4.0, 0)),
        ("expected 32767 at most", kernel.assign, (*good["assign"][:5], np.zeros(40_000), np.zeros(40_000, int), 0.1)),
    ):
        with pytest.raises(ValueError, match=match):
            loop(*arguments)
    for ends in ((0, 2, 4, 6, 99), (0, 4, 2, 6, 8), (1, 2, 3, 4, 5)):
        with pytest.raises(ValueError, match="groups bounded by"):
            kernel.vote(x, y, ends, *good["vote"][3:])
    for groups in ((1, 1, 1, 4), (-1, 1, 1, 1), (2**62, 0, 0, 0)):
        with pytest.raises(ValueError, match="expected 0 to 3"):
            kernel.assign(*good["assign"][:6], np.array(groups), 0.1)


@contextmanager
def gil_kept_until_released() -> Iterator[None]:
    """A thread that holds the GIL is not asked for it for a minute."""
    before = sys.getswitchinterval()
    sys.setswitchinterval(60.0)
    try:
        yield
    finally:
        sys.setswitchinterval(before)


@contextmanager
def counting() -> Iterator[list[int]]:
    """How far a thread has counted in Python, up to now."""
    count, stop = [0], threading.Event()

    def run() -> None:
        while not stop.is_set():
            count[0] += 1
            time.sleep(0)  # lets go of the GIL

    thread = threading.Thread(target=run)
    thread.start()
    try:
        yield count
    finally:
        stop.set()
        thread.join()


@pytest.mark.parametrize("name", LOOPS)
def test_another_thread_counts_meanwhile(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Were the GIL held while a loop is at work, it could not, however long that takes."""
    loop, arguments = getattr(kernel, name), calls(500, 600, 300_000)[name]  # each takes a millisecond or more
    monkeypatch.setattr(cv2, "countNonZero", np.size)  # it lets go of the GIL itself; the mask is full
    with gil_kept_until_released(), counting() as count:
        for _ in range(1000):  # a busy machine may have no processor for the thread for a while
            before = count[0]
            loop(*arguments)
            if count[0] > before:
                return
    pytest.fail(f"{name} holds the GIL")
