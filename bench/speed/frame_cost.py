"""What a frame costs, stage by stage, as ratios to bare Canny; two versions of ceilvo by turns, frame after frame.

python -m ceilvo.bench.speed.frame_cost base tilt office --office FOLDER --before SITE

SITE holds the other version, installed with `pip install --no-deps --target SITE CHECKOUT`. Each version is a process
of its own. FOLDER is a drive of pictures (frames.csv with stamp_ns and file, calibration.yaml), recorded elsewhere.
"""

from __future__ import annotations

import argparse
import csv
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from ceilvo.bench.speed import frame_worker
from ceilvo.bench.vision.conditions import FULL, conditions
from ceilvo.calibration_file import read_calibration, write_calibration
from ceilvo.types import Array

STAGES = ("edges", "lines", "crossings", "odometry", "filter", "rest")
AS_THE_SERVICE = {
    "OPENBLAS_NUM_THREADS": "1",
    "MALLOC_MMAP_THRESHOLD_": "33554432",
    "MALLOC_TRIM_THRESHOLD_": "268435456",
}
"""Of systemd/ceilvod.service."""
_WARM = 20
"""Frames that do not count: look-ups are made, caches filled, and the robot is INIT."""


def main() -> int:
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("scenes", nargs="+", metavar="SCENE", help="a condition of the vision bench, or office")
    p.add_argument("--frames", type=int, default=170)
    p.add_argument("--office", type=Path)
    p.add_argument("--before", type=Path, metavar="SITE")
    p.add_argument("--whole", action="store_true", help="look at every frame whole")
    p.add_argument("--keep", type=Path, help="folder for rendered frames, to be used again")
    a = p.parse_args()
    sites: dict[str, Path | None] = {"now": None} if a.before is None else {"before": a.before, "now": None}
    with tempfile.TemporaryDirectory() as temporary:
        for scene in a.scenes:
            folder = (a.keep or Path(temporary)) / scene
            count = _pictures(folder, a.office) if scene == "office" else _rendered(folder, scene, a.frames)
            _say(scene, by_turns(folder, count, sites, FULL if a.whole else ()), a.whole)
    return 0


def _rendered(folder: Path, scene: str, frames: int) -> int:
    """The first frames of a condition of the vision bench; how many."""
    if not (folder / "frames.npy").exists():
        condition = next(c for c in conditions() if c.name == scene)
        world = condition.world()
        times_s = np.arange(frames) / condition.fps
        pictures = np.stack([world.frame_at(t) for t in times_s])
        _save(folder, pictures, 1_000_000_000 + np.rint(1e9 * times_s).astype(np.int64))
        write_calibration(folder / "calibration.yaml", condition.calibration, force=True)
    return frames


def _pictures(folder: Path, source: Path | None) -> int:
    """A recorded drive; how many frames."""
    if source is None:
        raise SystemExit("office: --office FOLDER is missing")
    with (source / "frames.csv").open() as f:
        rows = list(csv.DictReader(f))
    if not (folder / "frames.npy").exists():
        pictures = [cv2.imread(str(source / r["file"]), cv2.IMREAD_GRAYSCALE) for r in rows]
        _save(
            folder, np.stack([np.asarray(g, np.uint8) for g in pictures]), np.array([int(r["stamp_ns"]) for r in rows])
        )
        write_calibration(folder / "calibration.yaml", read_calibration(source / "calibration.yaml"), force=True)
    return len(rows)


def _save(folder: Path, pictures: Any, stamps: Any) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    np.save(folder / "frames.npy", pictures)
    np.save(folder / "stamps.npy", stamps)


def by_turns(folder: Path, count: int, sites: dict[str, Path | None], overrides: tuple[str, ...]) -> dict[str, Any]:
    """What every version said of each frame, by its name."""
    command = [sys.executable, str(Path(frame_worker.__file__)), str(folder), *overrides]
    environment = os.environ | AS_THE_SERVICE
    workers = {
        name: subprocess.Popen(
            command,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env=environment if site is None else environment | {"PYTHONPATH": str(site)},
        )
        for name, site in sites.items()
    }
    said: dict[str, list[Any]] = {name: [] for name in sites}
    for k in range(count):
        for name in list(workers) if k % 2 else list(workers)[::-1]:
            w = workers[name]
            assert w.stdin is not None and w.stdout is not None
            w.stdin.write(f"{k}\n")
            w.stdin.flush()
            line = w.stdout.readline()
            if not line:
                raise SystemExit(f"{name}: ended with {w.wait()} at frame {k}")
            said[name].append(json.loads(line))
    for w in workers.values():
        w.communicate()
    return said


def _say(scene: str, said: dict[str, list[Any]], whole: bool) -> None:
    look = "whole look" if whole else "edge tracking"
    print(f"{scene}, {look}: median ms of " + ", ".join(STAGES) + " | step, p99 | mean | over Canny, p99")
    for name, frames in said.items():
        ms = {s: 1e3 * np.array([f["s"].get(s, 0.0) for f in frames[_WARM:]]) for s in ("canny", *STAGES)}
        total, canny = np.sum([ms[s] for s in STAGES], axis=0), float(np.median(ms["canny"]))
        p99 = float(np.quantile(total, 0.99))
        stages = " ".join(f"{np.median(ms[s]):5.2f}" for s in STAGES)
        print(
            f"  {name:6} {stages} | {np.median(total):5.2f} {p99:5.2f} | {np.mean(total):5.2f} | "
            f"{np.median(total) / canny:5.2f} {p99 / canny:5.2f}  (Canny {canny:.2f})"
        )
    if "before" in said:
        before, now = (_poses(said[name]) for name in ("before", "now"))
        states = sum(b["state"] != n["state"] for b, n in zip(said["before"], said["now"], strict=True))
        off = float(np.max(np.abs(now - before)))
        print(f"  poses differ by {off:.1e} m, rad at most; {states} of {len(now)} states differ")


def _poses(frames: list[Any]) -> Array:
    return np.array([f["pose"] for f in frames])


if __name__ == "__main__":
    sys.exit(main())
