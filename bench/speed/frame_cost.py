"""What a frame costs, stage by stage, as ratios to bare Canny, with bars; two versions of ceilvo by turns if there are.

python -m ceilvo.bench.speed.frame_cost [base tilt office] [--look both] [--office FOLDER] [--before SITE]

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
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from rich.console import Console

from ceilvo.bench.data import data_path
from ceilvo.bench.results.bars import Bar, as_json, table
from ceilvo.bench.speed import frame_worker
from ceilvo.bench.vision.conditions import FULL, TIMES, WHOLE_TIMES, conditions
from ceilvo.calibration_file import read_calibration, write_calibration
from ceilvo.files import write_atomic
from ceilvo.json_values import json_value
from ceilvo.types import Array

STAGES = ("edges", "lines", "crossings", "odometry", "filter", "rest")
AS_THE_SERVICE = {
    "OPENBLAS_NUM_THREADS": "1",
    "MALLOC_MMAP_THRESHOLD_": "33554432",
    "MALLOC_TRIM_THRESHOLD_": "268435456",
}
"""Of systemd/ceilvod.service."""
OFFICE = "office"
SCENES = ("base", "tilt", OFFICE)
"""Under bars, the issue's."""
LOOKS: dict[str, tuple[str, ...]] = {"edge tracking": (), "whole look": FULL}
"""How frames are looked at, and what sets it: near predicted edges but for every tenth frame, or every frame whole."""
MOST = {
    "edge tracking": {"median": TIMES["time_median"].value, "p99": TIMES["time_p99"].value},
    "whole look": {"median": WHOLE_TIMES["time_median"].value},
}
"""Times bare Canny that a step may take, the filter's part included; the issue's."""
_WARM = 20
"""Frames that do not count: look-ups are made, caches filled, and the robot is INIT."""


def main(arguments: Sequence[str] | None = None) -> int:
    """0 whether or not the bars are met: they are in the table and in the JSON."""
    a = _parser().parse_args(arguments)
    office = a.office or data_path("office_rendered")
    scenes = a.scenes or [s for s in SCENES if s != OFFICE or office.is_dir()]
    if not a.scenes and OFFICE not in scenes:
        print(f"{OFFICE} is left out: {office} is missing; set CEILVO_DATA or --office")
    looks = list(LOOKS) if a.look == "both" else [k for k in LOOKS if k.startswith(a.look)]
    sites: dict[str, Path | None] = {"now": None} if a.before is None else {"before": a.before, "now": None}
    bars = []
    with tempfile.TemporaryDirectory() as temporary:
        for scene in scenes:
            folder = (a.keep or Path(temporary)) / scene
            count = _pictures(folder, office) if scene == OFFICE else _rendered(folder, scene, a.frames)
            for look in looks:
                said = by_turns(folder, count, sites, LOOKS[look])
                _say(scene, said, look)
                bars += barred(scene, look, said["now"])
    Console().print(table(bars, "Times bare Canny"))
    a.json.parent.mkdir(parents=True, exist_ok=True)
    write_atomic(a.json, json.dumps(json_value(as_json(bars)), indent=1) + "\n")
    return 0


def _parser() -> argparse.ArgumentParser:
    p = argparse.ArgumentParser(
        prog="python -m ceilvo.bench.speed.frame_cost",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    p.add_argument(
        "scenes",
        nargs="*",
        metavar="SCENE",
        help=f"a condition of the vision bench, or {OFFICE} (default: {', '.join(SCENES)}, the latter where it is)",
    )
    p.add_argument("--frames", type=int, default=170, help="of each rendered scene (default: %(default)s)")
    p.add_argument("--office", type=Path, metavar="FOLDER", help="default: office_rendered in the data folder")
    p.add_argument("--before", type=Path, metavar="SITE")
    p.add_argument(
        "--look",
        choices=("edge", "whole", "both"),
        default="edge",
        help="near predicted edges, or at all of each frame",
    )
    p.add_argument("--keep", type=Path, help="folder for rendered frames, to be used again")
    p.add_argument("--json", type=Path, default=Path("build/bench/frame_cost.json"), metavar="FILE")
    return p


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


def _pictures(folder: Path, source: Path) -> int:
    """A recorded drive; how many frames."""
    if not source.is_dir():
        raise SystemExit(f"{OFFICE}: {source} is missing; set CEILVO_DATA or --office")
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


def _ms(frames: list[Any]) -> dict[str, Array]:
    """(N,) of bare Canny, of every stage, and of the whole step, from the first frame on that counts."""
    ms = {s: 1e3 * np.array([f["s"].get(s, 0.0) for f in frames[_WARM:]]) for s in ("canny", *STAGES)}
    return {**ms, "step": np.asarray(np.sum([ms[s] for s in STAGES], axis=0))}


def barred(scene: str, look: str, frames: list[Any]) -> list[Bar]:
    """A scene's steps over the median of bare Canny on the same frames, with the bars of that look."""
    ms = _ms(frames)
    canny_ms = float(np.median(ms["canny"]))
    found = {"median": float(np.median(ms["step"])), "p99": float(np.quantile(ms["step"], 0.99))}
    return [
        Bar(f"{scene}, {look}, {which}", found[which] / canny_ms, f"{found[which] / canny_ms:.2f}", high=most)
        for which, most in MOST[look].items()
    ]


def _say(scene: str, said: dict[str, list[Any]], look: str) -> None:
    print(f"{scene}, {look}: median ms of " + ", ".join(STAGES) + " | step, p99 | mean | over Canny, p99")
    for name, frames in said.items():
        ms = _ms(frames)
        total, canny = ms["step"], float(np.median(ms["canny"]))
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
