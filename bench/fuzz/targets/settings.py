"""What people write for the daemon: configuration, calibration, token, Zenoh's own file, environment."""

from __future__ import annotations

import os

import numpy as np

from ceilvo.bench.fuzz.engine.target import Target, file, folder
from ceilvo.calib.commands.calibration_file import describe
from ceilvo.calibration_file import read_calibration, sign_calibration, write_calibration
from ceilvo.config import Config, Zenoh
from ceilvo.config.checks import cross_check
from ceilvo.config.reader import load_config, replace
from ceilvo.config.rendering import render_config
from ceilvo.daemon.map.kept.store import Store
from ceilvo.daemon.pipeline import Pipeline
from ceilvo.drivers.bus.command_guard import CommandGuard
from ceilvo.drivers.bus.zenoh_session import session_config, watcher_config
from ceilvo.drivers.host.systemd_notify import Notifier
from ceilvo.sim.rig import simulated_calibration, simulated_camera
from ceilvo.types import Frame

_LARGEST_PX = 640 * 480
"""Of a camera whose first frame is looked at as well: larger ones take longer, as they should."""


def _config(data: bytes) -> None:
    cross_check(load_config(file("config.yaml", data)), None, "config.yaml")


def _overrides(data: bytes) -> None:
    """`--set`, one a line."""
    replace(Config(), data.decode("utf-8", "surrogateescape").split("\n"))


def _calibration(data: bytes) -> None:
    read_calibration(file("calibration.yaml", data))


def _signed_calibration(data: bytes) -> None:
    """`calib sign`, `calib show` and the first frame of a daemon that believes the file."""
    path = file("signed.yaml", data)
    sign_calibration(path)
    calibration = read_calibration(path)
    describe(calibration)
    camera = calibration.camera
    if camera.width_px * camera.height_px <= _LARGEST_PX:
        pipeline = Pipeline(calibration, Config(), np.random.default_rng(1))
        gray = np.random.default_rng(2).integers(0, 256, (camera.height_px, camera.width_px), np.uint8)
        pipeline.step(Frame(0, 1, gray))


def _calibrations() -> tuple[bytes, ...]:
    out = []
    for kind in ("pinhole", "fisheye"):
        path = folder() / f"seed-{kind}.yaml"
        write_calibration(path, simulated_calibration(simulated_camera(kind, 160, 120)), force=True)
        out.append(path.read_bytes())
    return tuple(out)


def _token(data: bytes) -> None:
    """Two parts: the file, and what a command brings."""
    token, _, brought = data.partition(b"\n\n")
    path = file("token", token)
    path.chmod(0o600)
    CommandGuard.of(Zenoh(command_token_file=str(path))).admit("reset", brought)


def _zenoh_file(data: bytes) -> None:
    settings = Zenoh(config_file=str(file("zenoh.json5", data)))
    session_config(settings)
    watcher_config(settings)


def _environment(data: bytes) -> None:
    """NAME=VALUE a line, as systemd gives them."""
    lines = data.replace(b"\0", b"").decode("utf-8", "surrogateescape").split("\n")
    given = dict(line.partition("=")[::2] for line in lines)
    with Notifier({**given, "WATCHDOG_PID": given.get("WATCHDOG_PID") or str(os.getpid())}) as notifier:
        notifier.ready(given.get("STATUS", ""))
        notifier.watchdog()
    Store.choose(given.get("STATE_DIRECTORY", "").split(":")[0], 3).load()


_ZENOH = b"""{
  mode: "peer", // comment
  listen: { endpoints: ["tcp/127.0.0.1:0"] },
  connect: { endpoints: { peer: ["tcp/127.0.0.1:7447"] } },
  transport: { link: { rx: { max_message_size: 1048576 } } },
}
"""

TARGETS = {
    "config": Target(
        _config, lambda: (render_config(Config()).encode(), b"robot: {name: r}\ncamera: {rate_hz: 15, gain: null}\n")
    ),
    "overrides": Target(
        _overrides, lambda: (b"camera.rate_hz=15", b'filter.method=pf\nzenoh.listen=["tcp/127.0.0.1:7447"]')
    ),
    "calibration": Target(_calibration, _calibrations),
    "signed_calibration": Target(_signed_calibration, _calibrations),
    "token": Target(_token, lambda: (b"0123456789abcdef\n\n0123456789abcdef",)),
    "zenoh_file": Target(_zenoh_file, lambda: (_ZENOH,)),
    "environment": Target(
        _environment,
        lambda: (b"WATCHDOG_USEC=4000000\nNOTIFY_SOCKET=@ceilvo-fuzz\nSTATUS=x\nSTATE_DIRECTORY=/nonexistent/a:/b",),
    ),
}
