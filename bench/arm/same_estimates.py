"""Are estimates on another computer those of this one? From pixels on, and of the golden drives from crossings on.

Only the beginning of each drive is compared, for an emulated computer is some fifty times slower.

python -m ceilvo.bench.arm.same_estimates make FOLDER              on x86-64: a drive's frames and estimates
python -m ceilvo.bench.arm.same_estimates compare GOLDEN FOLDER    on the other one; GOLDEN is tests/golden/pipeline
"""

from __future__ import annotations

import argparse
import platform
import sys
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ceilvo.calibration_file import read_calibration, write_calibration
from ceilvo.config import Config
from ceilvo.daemon.pipeline import Pipeline
from ceilvo.daemon.vision.kernel import COMPILED
from ceilvo.sim.motion import LapSpec, TiltSpec
from ceilvo.sim.world import World, WorldSpec
from ceilvo.types import Frame

BAR = 1e-6
"""m and rad, of poses; chosen: a thousandth of what the eye errs by."""
RATE_HZ = 30.0
"""Of the drive; the default camera's."""
_SEED, _FRAMES = 4400, 120
_COMPARED, _GOLDEN = 40, 60
"""Frames from pixels on, and of each golden drive, that are compared; chosen: the map is made and used in both."""
_POSE = slice(0, 3)
"""Columns of the golden drives' figures; the others are covariances, motions and counts."""


def make(folder: Path) -> None:
    """Frames of a rocking robot (N, H, W), the calibration, and the poses (N, 3) that come of them here."""
    folder.mkdir(parents=True, exist_ok=True)
    world = World(WorldSpec(seed=_SEED, lap=LapSpec(room_m=4.0), tilt=TiltSpec(amplitude_rad=0.02)))
    frames = np.stack([world.frame_at(k / RATE_HZ) for k in range(_FRAMES)])
    write_calibration(folder / "calibration.yaml", world.calibration, force=True)
    np.savez_compressed(folder / "drive.npz", frames=frames, poses=_poses(folder, frames))
    print(f"{folder}: {_FRAMES} frames on {platform.machine()}")


def _poses(folder: Path, frames: NDArray[np.uint8]) -> NDArray[np.float64]:
    pipeline = Pipeline(read_calibration(folder / "calibration.yaml"), Config(), np.random.default_rng(_SEED))
    stamps = (round(1e9 * (1.0 + k / RATE_HZ)) for k in range(len(frames)))
    return np.array([pipeline.step(Frame(k, t, f)).pose for k, (t, f) in enumerate(zip(stamps, frames, strict=True))])


def compare(golden: Path, folder: Path) -> int:
    """Exit status: 0 where all poses are the same within the bar."""
    print(f"{platform.machine()}, Python {platform.python_version()}, kernel {'compiled' if COMPILED else 'NumPy'}")
    with np.load(folder / "drive.npz") as f:
        frames, before = f["frames"][:_COMPARED], f["poses"][:_COMPARED]
    worst = [_say("from pixels on", _poses(folder, frames), before)]
    sys.path.insert(0, str(golden))
    drives: Any = __import__("golden_drives")
    for name, methods in drives.METHODS.items():
        for method in methods:
            figures = drives.table(islice(drives.estimates(drives.load(name, method)), _GOLDEN))[0]
            with np.load(golden / f"{name}.{method}.npz", allow_pickle=False) as f:
                worst.append(_say(f"{name}, {method}", figures[:, _POSE], f["figures"][:_GOLDEN, _POSE]))
    print(f"{'ok' if max(worst) <= BAR else 'FAILED'}: all poses within {max(worst):.1e} (bar {BAR:g} m, rad)")
    return 0 if max(worst) <= BAR else 1


def _say(name: str, poses: NDArray[np.float64], before: NDArray[np.float64]) -> float:
    off = np.abs(poses - before)
    equal = np.mean(np.all(off == 0.0, axis=1))
    said = f"{name:26} {len(poses):4} frames: within {off.max():.1e}, {100.0 * equal:.1f} % equal to the bit"
    print(said, flush=True)
    return float(off.max())


def main() -> int:
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = p.add_subparsers(dest="command", required=True)
    commands.add_parser("make").add_argument("folder", type=Path)
    c = commands.add_parser("compare")
    c.add_argument("golden", type=Path)
    c.add_argument("folder", type=Path)
    a = p.parse_args()
    if a.command == "compare":
        return compare(a.golden, a.folder)
    make(a.folder)
    return 0


if __name__ == "__main__":
    sys.exit(main())
