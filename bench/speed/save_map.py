"""Time of a save into a database of maps, and what a landmark takes there: python -m ceilvo.bench.speed.save_map"""

from __future__ import annotations

import argparse
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

import numpy as np

from ceilvo.config import Config
from ceilvo.config.arguments import from_up
from ceilvo.daemon.map.database.copies import keep_copy, open_map
from ceilvo.daemon.pipeline import Pipeline
from ceilvo.sim.world import World, WorldSpec
from ceilvo.types import Frame, Landmarks

_T = TypeVar("_T")

SIDE_M = 100.0
"""Of the hall; chosen: ten landmarks a square metre where there are 100,000."""
STRIP_M = 2.0
"""The robot maps it strip by strip; chosen: as wide as a view."""
CHANGED, NEW = 600, 100
"""Of a minute of driving."""
SEED = 1
PAUSE_S = 0.015
"""Between steps; chosen: half of a camera's period."""
SPAN_S = 6.0
"""Of each figure of steps; chosen."""


def hall(count: int, rng: np.random.Generator) -> Landmarks:
    """Landmarks in the order in which a robot meets them that drives up and down."""
    xy = rng.uniform(0.0, SIDE_M, (count, 2))
    strip = xy[:, 0] // STRIP_M
    xy = xy[np.lexsort((xy[:, 1] * np.where(strip % 2, -1.0, 1.0), strip))]
    cov = np.tile(1e-4 * np.eye(2), (count, 1, 1))
    sightings = rng.integers(1, 50, count)
    return Landmarks(np.arange(count), xy, cov, rng.integers(0, 9, count), sightings, sightings + 3)


def driven(m: Landmarks, rng: np.random.Generator, anywhere: bool) -> Landmarks:
    """The map a minute later: the landmarks around a place, or some anywhere, have moved by a millimetre."""
    around = rng.uniform(0.0, SIDE_M, 2)
    off = np.hypot(*(m.xy_map_m - around).T)
    which = rng.choice(len(m), CHANGED, replace=False) if anywhere else np.argsort(off)[:CHANGED]
    xy, cov, sightings, expected = m.xy_map_m.copy(), m.cov_m2.copy(), m.sightings.copy(), m.expected.copy()
    xy[which] += rng.normal(0.0, 1e-3, (CHANGED, 2))
    cov[which] *= 0.99
    sightings[which] += 1
    expected[which] += 1
    return Landmarks(
        np.arange(len(m) + NEW),
        np.vstack([xy, around + rng.normal(0.0, 2.0, (NEW, 2))]),
        np.concatenate([cov, np.tile(1e-3 * np.eye(2), (NEW, 1, 1))]),
        np.append(m.crossing_type, np.full(NEW, 4)),
        np.append(sightings, np.ones(NEW, np.int64)),
        np.append(expected, np.ones(NEW, np.int64)),
    )


class Steps:
    """Another thread that estimates a standing robot's pose from one picture, again and again, as the daemon does."""

    def __init__(self) -> None:
        world = World(WorldSpec(seed=SEED))
        gray = world.renderer.render(world.initial_pose, np.random.default_rng(SEED))
        self._pipeline = Pipeline(world.calibration, Config(), np.random.default_rng(SEED))
        self._gray, self._took_ms, self._seq = gray, list[float](), 0
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run)

    def __enter__(self) -> Steps:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join()

    def _run(self) -> None:
        while not self._stop.wait(PAUSE_S):
            self._seq += 1
            start = time.perf_counter()
            self._pipeline.step(Frame(self._seq, self._seq * 33_000_000, self._gray))
            self._took_ms.append(1e3 * (time.perf_counter() - start))

    def during(self, what: str, do: Callable[[], object]) -> None:
        """Print what steps take while something is done over and over for SPAN_S."""
        self._took_ms.clear()
        end = time.perf_counter() + SPAN_S
        while time.perf_counter() < end:
            do()
        ms = np.array(self._took_ms)
        print(f"steps {what}: median {np.median(ms):.1f} ms, p99 {np.quantile(ms, 0.99):.1f} ms of {len(ms)}")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--landmarks", type=from_up(CHANGED), default=100_000, metavar="N", help="in the map (100000)")
    parser.add_argument("--saves", type=from_up(1), default=40, metavar="N", help="of each kind (40)")
    options = parser.parse_args()
    rng = np.random.default_rng(SEED)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "map.db"
        m = hall(options.landmarks, rng)
        with open_map(path, create=True) as db:
            _timed("first save", lambda: db.save(m, 0.1, "bench"))
        print(f"{path.stat().st_size / len(m):.0f} bytes a landmark")
        db = _timed("open and verify", lambda: open_map(path))
        _timed("good copy", lambda: keep_copy(db))
        for name, anywhere in (("in one region", False), ("anywhere", True)):
            wall, cpu = [], []
            for _ in range(options.saves):
                m = driven(m, rng, anywhere)
                t, c = time.perf_counter(), time.process_time()
                db.save(m, 0.1, "bench")
                wall.append(1e3 * (time.perf_counter() - t))
                cpu.append(1e3 * (time.process_time() - c))
            print(
                f"save of {CHANGED} changed {name} and {NEW} new of {len(m)}: median {np.median(wall):.1f} ms, "
                f"most {max(wall):.1f} ms; of the processor {np.median(cpu):.1f} ms"
            )
        with Steps() as steps:
            steps.during("alone", lambda: time.sleep(0.1))
            steps.during("beside saves without a pause", lambda: db.save(driven(m, rng, False), 0.1, "bench"))
            steps.during("beside good copies without a pause", lambda: keep_copy(db))
        db.close()
    return 0


def _timed(name: str, do: Callable[[], _T]) -> _T:
    start = time.perf_counter()
    out = do()
    print(f"{name}: {time.perf_counter() - start:.2f} s")
    return out


if __name__ == "__main__":
    sys.exit(main())
