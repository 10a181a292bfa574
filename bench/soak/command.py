"""Hours of a running daemon with faults on a schedule: does it grow, slow down, lose its way or fail to come back?

python -m ceilvo.bench.soak --hours 2

Beside the verdict (soak.json, soak.png) stay all poses and looks at /proc (soak.npz, columns as in parts.py), the
daemon's log, and the recorder's folder, from which `ceilvod replay` does again what led to a wrong pose.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import astuple, dataclass, replace
from pathlib import Path

import numpy as np

from ceilvo.bench.soak.fault_plan import Stroke, current, floods, strokes
from ceilvo.bench.soak.floods import FLOODS, Flooder
from ceilvo.bench.soak.parts import Heard, Listener, Usage, Watcher, free_port, set_base_fault, usage
from ceilvo.bench.soak.verdict import judge
from ceilvo.config import Config
from ceilvo.config.rendering import render_config
from ceilvo.drivers.base.mock_base import ReceivedTelegram
from ceilvo.files import write_atomic
from ceilvo.sim.base import SimBase
from ceilvo.sim.world import World, WorldSpec

_TICK_S = 0.05  # chosen: as long as a frame at 20 Hz
_USAGE_PERIOD_S = 5.0  # between two looks at /proc; chosen: 720 an hour, for the slope of memory
_NICE = -5  # of the unit (systemd/ceilvod.service), to what is beside it
_START_S = 20.0  # until the world moves; chosen: the daemon is up by then on a busy computer, too


def main(arguments: Sequence[str] | None = None) -> int:
    p = argparse.ArgumentParser(prog="soak", description=__doc__)
    p.add_argument("--hours", type=float, default=1.0)
    p.add_argument("--seed", type=int, default=7)
    p.add_argument("--rate-hz", type=float, default=20.0, help="of the camera")
    p.add_argument("--floods", default=",".join(FLOODS), help="some of them, or none: --floods= (default: %(default)s)")
    p.add_argument("--out", type=Path, default=Path("build/bench"))
    a = p.parse_args(arguments)
    a.out.mkdir(parents=True, exist_ok=True)
    names = [n for n in a.floods.split(",") if n]
    if unknown := sorted(set(names) - set(FLOODS)):
        p.error(f"--floods: no such flood: {', '.join(unknown)}; there are {', '.join(FLOODS)}")
    soak = Soak(a.seed, 3600.0 * a.hours, a.rate_hz, a.out)
    soak.floods = floods(3600.0 * a.hours, names)
    code = soak.run()
    result = judge(soak.heard, soak.usage, [*soak.plan, *soak.floods], soak.world, soak.t0_ns, code, soak.struck)
    write_atomic(a.out / "soak.json", json.dumps(result, indent=2) + "\n")
    np.savez_compressed(
        a.out / "soak.npz",
        t0_ns=soak.t0_ns,
        poses=np.array(soak.heard.poses, np.float64),
        usage=np.array([astuple(u) for u in soak.usage], np.float64),
    )
    for line in result["lines"]:
        print(line)
    try:
        from ceilvo.bench.soak.plots import draw
    except ImportError:
        print("no plot: matplotlib is missing")
    else:
        print(draw(soak.heard, soak.usage, [*soak.plan, *soak.floods], soak.world, soak.t0_ns, a.out / "soak.png"))
    return 0 if result["ok"] else 1


@dataclass(frozen=True, slots=True)
class Running:
    """What is struck, or strikes, while the robot drives."""

    daemon: subprocess.Popen[bytes]
    base: SimBase
    flooder: Flooder
    watcher: Watcher


class Soak:
    """One run; afterwards the attributes have what was measured."""

    def __init__(
        self, seed: int, seconds: float, rate_hz: float, out: Path, name: str = "soak", base_rate_hz: float = 20.0
    ) -> None:
        self._seed, self._seconds, self._rate_hz, self._out = seed, seconds, rate_hz, out
        self._name, self._base_rate_hz = name, base_rate_hz
        self.telegrams: list[ReceivedTelegram] = []
        self.plan: list[Stroke] = strokes(seconds)
        self.world = World(WorldSpec(seed=seed))
        self.start_s = _START_S
        self.usage: list[Usage] = []
        self.heard = Heard()
        self.floods: list[Stroke] = []
        self.struck: dict[str, int] = {}
        self.t0_ns = 0
        self._state = out / f"{name}-state"

    def run(self) -> int:
        """Returns the daemon's exit code."""
        port, router_port = free_port(), free_port()
        with ExitStack() as ending:
            link = self._out / f"{self._name}-base"
            base = SimBase(port_link=link, odometry=self._odometry)
            base.start()
            ending.callback(base.stop)
            self.t0_ns = self.world.start(time.monotonic_ns() + round(1e9 * self.start_s))
            daemon = self._spawn(port, router_port, link)
            ending.callback(_end, daemon)
            listener = Listener(port)
            ending.callback(listener.close)
            self.heard = listener.heard
            watcher = Watcher(port)
            ending.callback(watcher.close)
            flooder = Flooder({"": f"tcp/127.0.0.1:{port}", "router": f"tcp/127.0.0.1:{router_port}"})
            ending.callback(flooder.close)
            self._supervise(Running(daemon, base, flooder, watcher))
            flooder.close()
            self.struck = flooder.struck
            self.telegrams = list(base.telegrams)
            daemon.send_signal(signal.SIGTERM)
            return daemon.wait(20.0)

    def _odometry(self, t_s: float) -> tuple[float, float, float]:
        x, y, theta = self.world.wheel_odometry_at(self.world.seconds(round(1e9 * t_s)))
        return float(x), float(y), float(theta)

    def _spawn(self, port: int, router_port: int, link: Path) -> subprocess.Popen[bytes]:
        self._state.mkdir(exist_ok=True)
        for old in self._state.iterdir():
            shutil.rmtree(old) if old.is_dir() else old.unlink()
        file = self._out / f"{self._name}.yaml"
        file.write_text(render_config(self._config(port, router_port, link)))
        args = [str(a) for a in self._command(file)]
        environment = os.environ | {"OPENBLAS_NUM_THREADS": "1", "PYTHONFAULTHANDLER": "1"}
        environment |= {"MALLOC_MMAP_THRESHOLD_": "33554432", "MALLOC_TRIM_THRESHOLD_": "268435456"}
        with (self._out / f"{self._name}.log").open("wb") as log:
            daemon = subprocess.Popen([sys.executable, "-m", *args], stdout=log, stderr=log, env=environment)
        with contextlib.suppress(PermissionError):
            os.setpriority(os.PRIO_PROCESS, daemon.pid, os.getpriority(os.PRIO_PROCESS, 0) + _NICE)
        return daemon

    def _command(self, file: Path) -> Sequence[object]:
        """The daemon's module and its arguments."""
        return ["ceilvo.bench.soak.robot", self._seed, self.t0_ns, self._seconds, file]

    def _config(self, port: int, router_port: int, link: Path) -> Config:
        x, y, theta = (float(v) for v in self.world.initial_pose)
        c, lens = Config(), self.world.calibration.camera
        return replace(
            c,
            camera=replace(c.camera, width_px=lens.width_px, height_px=lens.height_px, rate_hz=self._rate_hz),
            filter=replace(
                c.filter, initial_pose_x_m=x, initial_pose_y_m=y, initial_pose_theta_deg=float(np.degrees(theta))
            ),
            base=replace(c.base, port=str(link), rate_hz=self._base_rate_hz),
            zenoh=replace(
                c.zenoh,
                listen=(f"tcp/127.0.0.1:{port}",),
                connect=(f"tcp/127.0.0.1:{router_port}",),
                multicast=False,
                health_period_s=0.2,
            ),
            service=replace(c.service, state_dir=str(self._state), state_period_s=1.0),
        )

    def _supervise(self, running: Running) -> None:
        plan = [*self.plan, *self.floods]
        reported = {"base": "", "zenoh": "", "process": "", "flood": ""}
        next_usage_s = 0.0
        while running.daemon.poll() is None and self._now_s() < self._seconds:
            t_s = self._now_s()
            for part in reported:
                name = current(plan, t_s, part)
                if name != reported[part]:
                    self._change(part, reported[part], name, running)
                    reported[part] = name
            if t_s >= next_usage_s and reported["process"] != "stopped":
                next_usage_s = max(t_s, 0.0) + _USAGE_PERIOD_S
                self.usage.append(usage(running.daemon.pid, t_s))
            time.sleep(_TICK_S)

    def _now_s(self) -> float:
        return 1e-9 * (time.monotonic_ns() - self.t0_ns)

    def _change(self, part: str, old: str, new: str, running: Running) -> None:
        aside = self._state.with_name(f"{self._state.name}-aside")
        if part == "base":
            set_base_fault(running.base, new)
        elif part == "flood":
            running.flooder.change(new)
        elif "subscriber hangs" in (old, new):
            running.watcher.hang(new != "")
        elif "state directory gone" in (old, new):
            (self._state.replace(aside) if new else aside.replace(self._state))
        elif "stopped" in (old, new):
            running.daemon.send_signal(signal.SIGSTOP if new else signal.SIGCONT)


def _end(daemon: subprocess.Popen[bytes]) -> None:
    if daemon.poll() is None:
        daemon.send_signal(signal.SIGCONT)
        daemon.kill()
        daemon.wait()
