"""Every way to spoil a robot's files, and which files are spoilt in which ways."""

from __future__ import annotations

import base64
import contextlib
import json
import os
import random
import re
import shutil
import sqlite3
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from kept_maps import as_version_1
from map_texts import edited, signed
from map_writer import estimate, landmarks
from robot_site import (
    AXIS_RAD,
    CALIBRATION,
    CONFIG,
    CONFIG_FILES,
    DATABASES,
    EARLIER,
    FLIGHT,
    GOOD,
    KEPT,
    MAP,
    MAPS,
    MARK,
    OLDEST,
    OWNER,
    POSE,
    STATE_FILES,
    Site,
    load_any,
    write_map,
)

from ceilvo.calibration_file import write_calibration
from ceilvo.daemon.map.database.schema import SCHEMA_VERSION
from ceilvo.daemon.map.map_file import load_map, save_state
from ceilvo.sim.rig import simulated_calibration
from ceilvo.types import Landmarks, State

SEED = 14

Damage = Callable[[Site, str], bool]
"""Spoils site.path(name); False where that cannot be done to such a file."""


def _rng(name: str, salt: int = 0) -> random.Random:
    return random.Random(zlib.crc32(f"{SEED} {name} {salt}".encode()))


def _remove(path: Path) -> None:
    if path.is_dir():
        shutil.rmtree(path)
    else:
        path.unlink()


def _cut(share: float) -> Damage:
    """All but the end; of the last cut two bytes are missing."""

    def damage(site: Site, name: str) -> bool:
        raw = b"" if site.path(name).is_dir() else site.path(name).read_bytes()
        if len(raw) > 4:
            site.path(name).write_bytes(raw[: min(int(share * len(raw)), len(raw) - 2)])
        return len(raw) > 4

    return damage


def _flip(salt: int) -> Damage:
    def damage(site: Site, name: str) -> bool:
        if site.path(name).is_dir():
            return False
        raw, rng = bytearray(site.path(name).read_bytes()), _rng(name, salt)
        raw[rng.randrange(len(raw))] ^= 1 << rng.randrange(8)
        site.path(name).write_bytes(raw)
        return True

    return damage


def _bytes(content: Callable[[random.Random], bytes]) -> Damage:
    def damage(site: Site, name: str) -> bool:
        _remove(site.path(name))
        site.path(name).write_bytes(content(_rng(name)))
        site.path(name).chmod(0o640)  # what is spoilt is the content: a token that all may read is refused for that
        return True

    return damage


def _swap(other: str) -> Damage:
    def damage(site: Site, name: str) -> bool:
        a, b = site.path(name), site.path(other)
        if name == other or name not in (*KEPT, *CONFIG_FILES) or not (a.exists() and b.exists()):
            return False
        aside = a.with_name("aside")
        a.rename(aside)
        b.rename(a)
        aside.rename(b)
        return True

    return damage


def _number(value: float) -> Damage:
    """A value with the checksum signed again: a map's or a pose's; without it a focal length, a rate."""

    def damage(site: Site, name: str) -> bool:
        path = site.path(name)
        if name in DATABASES:
            with contextlib.closing(sqlite3.connect(path)) as db:
                db.execute("UPDATE landmarks SET x = ? WHERE id = 5", (value,))
                db.commit()
        elif name in MAPS:
            document = json.loads(path.read_text())
            xy = np.frombuffer(base64.b64decode(document["content"]["landmarks"]["xy_map_m"]), "<f8").copy()
            xy[10] = value
            document["content"]["landmarks"]["xy_map_m"] = base64.b64encode(xy.tobytes()).decode()
            path.write_text(signed(document))
        elif name == POSE:
            path.write_text(edited(path.read_text(), lambda d: d["content"]["pose_map_from_base"].update(x_m=value)))
        elif name in (CONFIG, CALIBRATION):
            shown = {"nan": ".nan", "inf": ".inf"}.get(str(value), repr(value))
            key = "fx_px" if name == CALIBRATION else "rate_hz"
            path.write_text(re.sub(rf"^( *{key}: ).*$", rf"\g<1>{shown}", path.read_text(), count=1, flags=re.M))
        else:
            return False
        return True

    return damage


def _huge_doubt(value: float) -> Damage:
    """Covariances at the limit of what a file may say."""

    def damage(site: Site, name: str) -> bool:
        path = site.path(name)
        if name in MAPS:
            own = load_any(path)
            assert own is not None
            cov = np.tile(value * np.eye(2), (len(own.landmarks), 1, 1))
            write_map(path, replace(own.landmarks, cov_m2=cov), AXIS_RAD)
        elif name == POSE:
            save_state(path, np.array([1.6, 1.0, 0.0]), value * np.eye(3), State.TRACKING, 2**62)
        return name in (*MAPS, POSE)

    return damage


def _version(change: int) -> Damage:
    def damage(site: Site, name: str) -> bool:
        path = site.path(name)
        if name in DATABASES:
            with contextlib.closing(sqlite3.connect(path)) as db:
                db.execute(f"PRAGMA user_version = {SCHEMA_VERSION + change}")
        elif name in (*MAPS, POSE):
            document = json.loads(path.read_text())
            path.write_text(signed({**document, "version": document["version"] + change}))
        elif name == CALIBRATION:
            path.write_text(path.read_text().replace("version: 1", f"version: {1 + change}"))
        return name in (*MAPS, POSE, CALIBRATION)

    return damage


def _older(site: Site, name: str) -> bool:
    """As an older ceilvo wrote it; calibrations have had one version only."""
    if name in DATABASES:
        as_version_1(site.path(name))
        return True
    if name not in MAPS:
        return False
    own = load_map(site.path(name))
    assert own is not None
    site.path(name).write_text(version_1(own.landmarks))
    return True


def version_1(own: Landmarks) -> str:
    """A map as version 1 wrote it: lists of numbers, and no count of how often landmarks were expected."""
    table: dict[str, Any] = {
        "id": own.ids.tolist(),
        "xy_map_m": own.xy_map_m.tolist(),
        "cov_xx_xy_yy_m2": own.cov_m2.reshape(-1, 4)[:, [0, 1, 3]].tolist(),
        "kind": own.crossing_type.tolist(),
        "sightings": own.sightings.tolist(),
    }
    content = {"map_axis_rad": AXIS_RAD, "landmarks": table}
    return signed({"format": "ceilvo-map", "version": 1, "sha256": "", "content": content})


def _another_robots(site: Site, name: str) -> bool:
    path = site.path(name)
    if name in MAPS:
        theirs = landmarks(120)
        write_map(path, replace(theirs, xy_map_m=theirs.xy_map_m + 0.17), 0.6)
    elif name == POSE:
        save_state(path, np.array([40.0, -30.0, 2.0]), estimate(1).cov, State.TRACKING, 5)
    elif name == CALIBRATION:
        theirs_lens = simulated_calibration()
        write_calibration(path, replace(theirs_lens, camera_id=""), force=True)
    elif name == OWNER:
        path.write_text("1\n")
    else:
        return False
    return True


def _gone(site: Site, name: str) -> bool:
    _remove(site.path(name))
    return True


def _folder(filled: bool) -> Damage:
    def damage(site: Site, name: str) -> bool:
        path = site.path(name)
        _remove(path)
        path.mkdir()
        if filled:
            (path / "notes.txt").write_text("mine\n")
        return True

    return damage


def _link(to: Callable[[Site, str], Path]) -> Damage:
    def damage(site: Site, name: str) -> bool:
        _remove(site.path(name))
        site.path(name).symlink_to(to(site, name))
        return True

    return damage


def _pipe(site: Site, name: str) -> bool:
    _remove(site.path(name))
    os.mkfifo(site.path(name))
    return name not in (MARK, FLIGHT)


def _unreadable(site: Site, name: str) -> bool:
    site.path(name).chmod(0o000)
    return os.geteuid() != 0


DAMAGES: dict[str, Damage] = {
    "empty": _bytes(lambda rng: b""),
    **{f"cut at {share:.0%}": _cut(share) for share in (0.02, 0.5, 0.9, 1.0)},
    **{f"bit flipped, {n}": _flip(n) for n in range(8)},
    "not a number, signed": _number(float("nan")),
    "infinite, signed": _number(float("inf")),
    "far away, signed": _number(1e6),
    "huge doubt, signed": _huge_doubt(1e12),
    "no doubt, signed": _huge_doubt(0.0),
    **{f"swapped with {other}": _swap(other) for other in (*KEPT, CONFIG, CALIBRATION)},
    "older version": _older,
    "newer version": _version(1),
    "impossible version": _version(-9),
    "another robot's": _another_robots,
    "junk": _bytes(lambda rng: rng.randbytes(5000)),
    "text of another kind": _bytes(lambda rng: b"<!DOCTYPE html>\n<title>502 Bad Gateway</title>\n"),
    "zeros": _bytes(lambda rng: bytes(4096)),
    "gone": _gone,
    "a folder": _folder(filled=False),
    "a folder with a file": _folder(filled=True),
    "a link to itself": _link(lambda site, name: site.path(name)),
    "a link to nothing": _link(lambda site, name: site.root / "nothing"),
    "a link to the map": _link(lambda site, name: site.path(OLDEST)),
    "a pipe": _pipe,
    "unreadable": _unreadable,
}


@dataclass(frozen=True)
class Case:
    """Damages of one robot's files, one after the other."""

    spoilt: tuple[tuple[str, str], ...]
    generations: bool = True

    def __str__(self) -> str:
        young = "" if self.generations else " (first run)"
        return " and ".join(f"{name} {damage}" for name, damage in self.spoilt) + young

    @property
    def names(self) -> set[str]:
        """The files; both of those that were swapped."""
        others = {d.removeprefix("swapped with ") for _, d in self.spoilt if d.startswith("swapped with ")}
        return {name for name, _ in self.spoilt} | others

    def spoil(self, site: Site) -> bool:
        """False where it cannot be done."""
        return all(DAMAGES[damage](site, name) for name, damage in self.spoilt)


PAIRS = ((MAP, GOOD), (MAP, POSE), (GOOD, POSE), (MAP, OWNER), (MAP, EARLIER))
IN_PAIRS = ("empty", "cut at 50%", "bit flipped, 0", "not a number, signed", "newer version", "another robot's", "junk")
IN_PAIRS = (*IN_PAIRS, "gone", "a folder with a file", "a link to itself", "a link to nothing", "a pipe")


def cases() -> Iterator[Case]:
    """One file damaged, of a robot with and without generations; two files damaged at once."""
    for name in (*STATE_FILES, *CONFIG_FILES):
        yield from (Case(((name, damage),)) for damage in DAMAGES)
    for name in (MAP, POSE):
        yield from (Case(((name, damage),), generations=False) for damage in DAMAGES)
    for first, second in PAIRS:
        yield from (Case(((first, a), (second, b))) for a in IN_PAIRS for b in IN_PAIRS)
    for damage in IN_PAIRS:
        yield from (Case(tuple((name, damage) for name in DATABASES[:k])) for k in (3, 4))
