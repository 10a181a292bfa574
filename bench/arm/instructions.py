"""Instructions that a frame takes, counted by valgrind, and what computers would need for them: computed, not measured.

python -m ceilvo.bench.arm.instructions FOLDER      FOLDER is of same_estimates' make; some minutes

The same drive is run twice, with so many frames more, and the difference divided by them: start and imports fall out.
"""

from __future__ import annotations

import argparse
import os
import re
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from ceilvo.bench.arm.same_estimates import RATE_HZ
from ceilvo.calibration_file import read_calibration
from ceilvo.config import Config
from ceilvo.daemon.pipeline import Pipeline
from ceilvo.types import Frame

_FEW, _MANY = 30, 120
"""Frames of the two runs; the first has all that is done once."""
_WIDER = 2.0
"""At most so many instructions more on ARM: its vectors have 128 bits where those counted here have up to 256."""


@dataclass(frozen=True)
class Computer:
    """Instructions a second of one core.

    Attributes:
        per_cycle: chosen, low: what cores of this kind reach on code that is not all vectors.
    """

    name: str
    clock_ghz: float
    per_cycle: float


COMPUTERS = (
    Computer("Raspberry Pi 4 (Cortex-A72)", 1.5, 1.0),
    Computer("Raspberry Pi 5 (Cortex-A76)", 2.4, 1.6),
    Computer("Jetson Nano (Cortex-A57)", 1.43, 0.9),
    Computer("Jetson Orin Nano (Cortex-A78AE)", 1.5, 1.8),
)
"""Clocks as their makers give them."""


def drive(folder: Path, frames: int) -> float:
    """The first frames of the drive through a pipeline; seconds for all of them."""
    cv2.setNumThreads(1)
    with np.load(folder / "drive.npz") as f:
        pictures = f["frames"]
    pipeline = Pipeline(read_calibration(folder / "calibration.yaml"), Config(), np.random.default_rng(1))
    begin_s = time.perf_counter()
    for k in range(frames):
        pipeline.step(Frame(k, round(1e9 * (1.0 + k / RATE_HZ)), pictures[k]))
    return time.perf_counter() - begin_s


def counted(folder: Path, frames: int) -> int:
    """Instructions of a whole process that drives so many frames."""
    command = [
        "valgrind",
        "--tool=callgrind",
        "--callgrind-out-file=/dev/null",
        sys.executable,
        "-m",
        "ceilvo.bench.arm.instructions",
    ]
    command += [str(folder), "--frames", str(frames)]
    environment = os.environ | {"OPENBLAS_NUM_THREADS": "1", "PYTHONHASHSEED": "0"}
    done = subprocess.run(command, capture_output=True, text=True, check=True, env=environment)
    found = re.search(r"Collected : (\d+)", done.stderr)
    if found is None:
        raise SystemExit(f"valgrind printed no count: {done.stderr[-300:]}")
    return int(found[1])


def main() -> int:
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("folder", type=Path)
    p.add_argument("--frames", type=int, help="only drive so many frames: what is run under valgrind")
    a = p.parse_args()
    if a.frames is not None:
        drive(a.folder, a.frames)
        return 0
    each = (counted(a.folder, _MANY) - counted(a.folder, _FEW)) / (_MANY - _FEW)
    here_s = (drive(a.folder, _MANY) - drive(a.folder, _FEW)) / (_MANY - _FEW)
    print(f"{each / 1e6:.1f} million instructions a frame; here {1e3 * here_s:.1f} ms, {each / here_s / 1e9:.2f} a ns")
    print("computed, not measured: computer | ms a frame | share of one core at 30 Hz")
    for c in COMPUTERS:
        low_s = each / (1e9 * c.clock_ghz * c.per_cycle)
        low, high = (f"{1e3 * s:.0f}" for s in (low_s, _WIDER * low_s))
        print(f"{c.name} | {low} to {high} | {100 * 30 * low_s:.0f} to {100 * 30 * _WIDER * low_s:.0f} %")
    return 0


if __name__ == "__main__":
    sys.exit(main())
