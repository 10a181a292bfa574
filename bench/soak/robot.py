"""The daemon of a soak: a simulated robot whose camera has the faults of the plan; base and subscribers are elsewhere.

python -m ceilvo.bench.soak.robot SEED T0_NS SECONDS CONFIG
"""

from __future__ import annotations

import logging
import sys
import time
from pathlib import Path

from ceilvo.bench.soak.fault_plan import current, strokes
from ceilvo.bench.soak.faulty_camera import FaultyCamera
from ceilvo.config.reader import load_config
from ceilvo.daemon.app.process import Plan, run
from ceilvo.daemon.cli import leave
from ceilvo.sim.camera import SimCamera
from ceilvo.sim.world import World, WorldSpec


def main() -> int:
    seed, t0_ns, seconds = int(sys.argv[1]), int(sys.argv[2]), float(sys.argv[3])
    config = load_config(Path(sys.argv[4]), [])
    logging.basicConfig(level="INFO", format="%(asctime)s %(levelname)-7s %(message)s")
    logging.getLogger("pymodbus").setLevel(logging.CRITICAL)
    world = World(WorldSpec(seed=seed))
    world.start(t0_ns)
    plan = strokes(seconds)

    def fault() -> str:
        return current(plan, 1e-9 * (time.monotonic_ns() - t0_ns), "camera")

    return run(Plan(config, world.calibration, FaultyCamera(SimCamera(world, config.camera.rate_hz), fault)))


if __name__ == "__main__":
    leave(main())
