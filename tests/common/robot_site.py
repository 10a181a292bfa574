"""A robot's folder as some runs leave it, and what of its own map is found there."""

from __future__ import annotations

import os
import shutil
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from kept_maps import load_database, write_database
from map_writer import estimate, landmarks

from ceilvo.config import Config
from ceilvo.config.rendering import render_config
from ceilvo.daemon.map.database.faults import MAGIC
from ceilvo.daemon.map.map_file import StoredMap, load_map, save_map, save_state
from ceilvo.errors import FileFormatError
from ceilvo.sim.rig import simulated_camera
from ceilvo.types import Landmarks, State

OWN = 300
"""Landmarks of the robot's map; the maps of its earlier runs have 10 less each."""
AXIS_RAD = 0.25
LENS = simulated_camera(width_px=320, height_px=240)
SAME_M = 0.05
"""A landmark so near where it was is the same: runs go on learning; chosen, far less than between two landmarks."""
KNOWN_M2 = 1.0
"""A landmark that is known less well is not known: a map may say so, and the next view puts it elsewhere."""
MAP, GOOD, EARLIER, OLDEST = "map.db", "map.db.good", "map.db.1", "map.db.2"
OLD, SMALLER, POSE = "map.json", "map.smaller.json", "state.json"
COMMANDS, OWNER = "commands.jsonl", ".owner"
RECORDER, MARK, FLIGHT = "recorder", "recorder/ring/run", "recorder/ring/flight-000000.mcap"
KEPT = (MAP, GOOD, EARLIER, OLDEST, OLD, SMALLER, POSE, COMMANDS, OWNER)
STATE_FILES = (*KEPT, RECORDER, MARK, FLIGHT)
CONFIG, CALIBRATION, ZENOH, TOKEN = "config.yaml", "calibration.yaml", "zenoh.json5", "token"
CONFIG_FILES = (CONFIG, CALIBRATION, ZENOH, TOKEN)
DATABASES = (MAP, GOOD, EARLIER, OLDEST)
MAPS = (*DATABASES, OLD, SMALLER)


@dataclass(frozen=True)
class Site:
    """A robot's folder: configuration, and the state directory in it."""

    root: Path

    @property
    def state(self) -> Path:
        return self.root / "state"

    def path(self, name: str) -> Path:
        return (self.root if name in CONFIG_FILES else self.state) / name

    def contents(self) -> dict[str, bytes]:
        """Of every file below the state directory that can be read."""
        found = {}
        for folder, _, names in os.walk(self.state):
            for name in names:
                path = Path(folder, name)
                if path.is_file() and not path.is_symlink() and os.access(path, os.R_OK):
                    found[path.relative_to(self.state).as_posix()] = path.read_bytes()
        return found

    def own_landmarks(self) -> int:
        """The most of the robot's own landmarks that any one file has, whatever its name."""
        return max((own_of(self.state / name) for name in self.contents()), default=0)


def own_of(path: Path) -> int:
    """How many of the robot's own landmarks a map file has, where they were learnt; 0 where it is no map."""
    try:
        stored = load_any(path)
    except FileFormatError:
        return 0
    return 0 if stored is None else own_among(stored.landmarks)


def load_any(path: Path) -> StoredMap | None:
    """A map in a database, with its log, or in JSON; looking at it changes nothing."""
    if not is_database(path):
        return load_map(path)
    with tempfile.TemporaryDirectory() as folder:
        for end in ("", "-wal"):
            if path.with_name(path.name + end).exists():
                shutil.copyfile(path.with_name(path.name + end), Path(folder) / f"map.db{end}")
        return load_database(Path(folder) / "map.db")


def is_database(path: Path) -> bool:
    if not path.is_file() or not os.access(path, os.R_OK):
        return False
    with path.open("rb") as f:
        return f.read(len(MAGIC)) == MAGIC


def own_among(found: Landmarks) -> int:
    own, found = landmarks(OWN), found.of(np.max(found.cov_m2, axis=(1, 2), initial=0.0) < KNOWN_M2)
    _, mine, theirs = np.intersect1d(own.ids, found.ids, return_indices=True)
    off_m = np.hypot(*(own.xy_map_m[mine] - found.xy_map_m[theirs]).T)
    return int(np.count_nonzero(off_m < SAME_M))


def write_map(path: Path, own: Landmarks, map_axis_rad: float) -> None:
    (write_database if path.name in DATABASES else save_map)(path, own, map_axis_rad)


def make_site(root: Path, frames: Path, generations: bool = True) -> Site:
    """A robot that has its files from some runs; without generations it had but one."""
    site = Site(root)
    (site.state / MARK).parent.mkdir(parents=True)
    counts = {MAP: OWN, GOOD: OWN - 5}
    if generations:
        counts |= {EARLIER: OWN - 10, OLDEST: OWN - 20, OLD: OWN - 30, SMALLER: 100}
    for name, count in counts.items():
        write_map(site.path(name), landmarks(count), AXIS_RAD)
        os.utime(site.path(name), (1e9 - 1e5 * (OWN - count), 1e9 - 1e5 * (OWN - count)))
    save_state(site.path(POSE), np.array([1.6, 1.0, 0.0]), estimate(1).cov, State.TRACKING, 7)
    site.path(COMMANDS).write_text('{"unix_ns": 1, "command": "save_map", "who": "owner"}\n')
    site.path(OWNER).write_text("812\n")
    site.path(MARK).write_text(Path("/proc/sys/kernel/random/boot_id").read_text())
    site.path(FLIGHT).write_bytes(b"\x89MCAP0\r\n" + bytes(200))
    shutil.copy(frames / CALIBRATION, site.path(CALIBRATION))
    c = Config()
    c = replace(
        c,
        camera=replace(c.camera, source="folder", path=str(frames), width_px=LENS.width_px, height_px=LENS.height_px),
        base=replace(c.base, enabled=False),
        zenoh=replace(c.zenoh, enabled=False),
        filter=replace(c.filter, birth_sightings=1),
        service=replace(c.service, state_dir=str(site.state)),
    )
    site.path(CONFIG).write_text(render_config(c))
    site.path(ZENOH).write_text('{mode: "peer", listen: {endpoints: []}, scouting: {multicast: {enabled: false}}}\n')
    site.path(TOKEN).write_bytes(b"0123456789abcdef" * 2 + b"\n")
    site.path(TOKEN).chmod(0o600)
    return site
