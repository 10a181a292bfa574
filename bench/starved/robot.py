"""The daemon of a starved computer: a camera that plays drawn pictures, on one core.

python -m ceilvo.bench.starved.robot SEED T0_NS CORE RATE_HZ TOLD_HZ FOLDER CONFIG
"""

from __future__ import annotations

import logging
import os
import sys
from dataclasses import replace
from pathlib import Path

from ceilvo.bench.starved.drawn_lap import DrawnLap
from ceilvo.config.reader import load_config
from ceilvo.daemon.app.process import Plan, run
from ceilvo.daemon.cli import leave
from ceilvo.drivers.ports import CameraInfo
from ceilvo.sim.camera import SimCamera


class ToldCamera(SimCamera):
    """Gives another rate than it says."""

    told_hz = 0.0

    def open(self) -> CameraInfo:
        return replace(super().open(), rate_hz=self.told_hz)


def main() -> int:
    seed, t0_ns, core, rate_hz = (int(v) for v in sys.argv[1:5])
    os.sched_setaffinity(0, {core})
    config = load_config(Path(sys.argv[7]), [])
    logging.basicConfig(level="INFO", format="%(asctime)s %(levelname)-7s %(message)s")
    logging.getLogger("pymodbus").setLevel(logging.CRITICAL)
    world = DrawnLap(seed, rate_hz, Path(sys.argv[6]))
    world.start(t0_ns)
    camera = ToldCamera(world, rate_hz)
    camera.told_hz = float(sys.argv[5])
    return run(Plan(config, world.calibration, camera))


if __name__ == "__main__":
    leave(main())
