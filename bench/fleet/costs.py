"""Bytes and times of a fleet's maps on one processor, by the size of the map: python -m ceilvo.bench.fleet.costs"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TypeVar

import numpy as np

from ceilvo.bench.fleet.robots import AXIS_RAD, SERVICE, key_of
from ceilvo.bench.fleet.world import Building, Region, driven
from ceilvo.config import Mapd
from ceilvo.config.arguments import from_up
from ceilvo.daemon.fleet.learnt import Told, gained, parts
from ceilvo.daemon.fleet.offers import Offer, signed
from ceilvo.daemon.fleet.parts import PART_BYTES, packed_part
from ceilvo.daemon.fleet.robot.taking import taken_in
from ceilvo.daemon.fleet.service.curator import Curator
from ceilvo.daemon.fleet.service.ledger import Ledger
from ceilvo.daemon.fleet.service.tables import ledger_of
from ceilvo.daemon.fleet.tiles import cut, hash_of, joined
from ceilvo.daemon.map.database.content import MapContent
from ceilvo.daemon.map.database.copies import open_map
from ceilvo.types import Landmarks

_T = TypeVar("_T")

SIZES_M = ((6.0, 5.0), (60.0, 40.0), (150.0, 120.0))
"""A room, a hall, and three halls: 170, 13,000 and 100,000 landmarks."""
DRIVE_M = (24.0, 10.0)
"""What is seen in ten minutes."""
ROBOTS, QUORUM = 6, 3
TILE_M = 8
SEED = 1


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeat", type=from_up(1), default=5, metavar="N", help="times each, the median counts (5)")
    repeat = parser.parse_args().repeat
    for size in SIZES_M:
        with tempfile.TemporaryDirectory() as folder:
            _measure(size, Path(folder), repeat)
    return 0


def _measure(size: tuple[float, float], folder: Path, repeat: int) -> None:
    rng = np.random.default_rng(SEED)
    building = Building.new(size, rng)
    m = building.as_map(np.arange(len(building.kind)), 0.003, rng)
    print(f"{size[0]:g} m x {size[1]:g} m, {len(m)} landmarks")
    seen_s = np.full((len(m), 2), 1.8e9) + 1.0 * (np.arange(len(m))[:, None] % 1000)
    tiles = cut(m, seen_s, TILE_M)
    raw = sum(map(len, tiles.values()))
    sent = sum(len(p) for data in tiles.values() for p in _parts(data))
    _say(
        "tiles", f"{len(tiles)}, {raw / len(m):.1f} bytes a landmark, {sent / len(m):.1f} as sent; {sent / 1e3:.0f} kB"
    )
    _say("manifest", f"{24 * len(tiles)} bytes before it is compressed")
    _ms("cut and hash the whole map", repeat, lambda: [hash_of(d) for d in cut(m, seen_s, TILE_M).values()])
    _ms("robot: put tiles together", repeat, lambda: joined(tiles, TILE_M))
    offers = _offers(building, m, min(ROBOTS, 6))
    rows = sum(len(o.rows) for some in offers for o in some)
    data = sum(len(signed(o, key_of(0)).packed()) for some in offers for o in some)
    drives = len(offers)
    _say(
        "offers of a drive",
        f"{rows / drives:.0f} landmarks, {data / drives / 1e3:.1f} kB, {data / rows:.1f} bytes each",
    )
    learnt = driven(m, building, _region(building, 1), np.zeros(2), np.random.default_rng(2))
    _ms("robot: find what was gained", repeat, lambda: gained(Told(m, m.ids), learnt))
    content = MapContent(learnt, np.zeros((len(learnt), 2)), AXIS_RAD)
    none = Told(m, m.ids).of_none()
    _ms("robot: take a new version in", repeat, lambda: taken_in(content, m.ids, none, m, seen_s, AXIS_RAD))
    _serve(folder, m, offers)


def _serve(folder: Path, m: Landmarks, offers: list[list[Offer]]) -> None:
    path = folder / "building.db"
    with open_map(path, "", create=True) as db:
        db.edit(MapContent.of(m, AXIS_RAD), "survey")
    with Ledger(ledger_of(path)) as ledger:
        for n in range(ROBOTS):
            ledger.add_key(key_of(n).public, f"robot{n}", False, 0.0)
    config = Mapd(building=SERVICE, policy="quorum", quorum=QUORUM, tile_m=TILE_M, offers_per_hour=1e6)
    curator, _ = _timed("service: start, with its last good copy", lambda: Curator(path, config))
    curator.tick()
    wall, cpu, count = 0.0, time.process_time(), 0
    for n, some in enumerate(offers):
        for o in some:
            data = signed(o, key_of(n)).packed()
            began = time.perf_counter()
            curator.take([data])
            wall, count = wall + time.perf_counter() - began, count + 1
    cpu = time.process_time() - cpu
    _say("service: take an offer", f"{1e3 * wall / count:.1f} ms, {1e3 * cpu / count:.1f} of the processor")
    cpu = time.process_time()
    _timed("service: merge, write and publish", curator.tick)
    _say("", f"{1e3 * (time.process_time() - cpu):.0f} ms of the processor")
    curator.close()
    size = sum(path.with_name(path.name + end).stat().st_size for end in ("", ".good", ".mapd"))
    _say("service: on disk", f"{size / len(m):.0f} bytes a landmark with good copy and ledger")
    rss = int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    _say("this process", f"{rss / 1e6:.0f} MB")


def _offers(building: Building, m: Landmarks, robots: int) -> list[list[Offer]]:
    """Of robots that drove through the same part of the building."""
    out = []
    for n in range(robots):
        learnt = driven(m, building, _region(building, n // QUORUM), np.zeros(2), np.random.default_rng(n))
        g = gained(Told(m, m.ids), learnt)
        plain = Offer(SERVICE, "", f"robot{n}", 1, 1, AXIS_RAD, "drive", 1.0, 2.0, g.rows)
        out.append([replace(plain, seq=1 + i, rows=g.rows[part]) for i, part in enumerate(parts(g))])
    return out


def _region(building: Building, seed: int) -> Region:
    side = (min(DRIVE_M[0], building.size_m[0]), min(DRIVE_M[1], building.size_m[1]))
    return Region.anywhere(building.size_m, side, np.random.default_rng(seed))


def _parts(data: bytes) -> list[bytes]:
    return [
        packed_part(hash_of(data), len(data), at, data[at : at + PART_BYTES]) for at in range(0, len(data), PART_BYTES)
    ]


def _ms(name: str, repeat: int, do: Callable[[], object]) -> None:
    times = []
    for _ in range(repeat):
        began = time.process_time()
        do()
        times.append(1e3 * (time.process_time() - began))
    _say(name, f"{np.median(times):.1f} ms of the processor")


def _timed(name: str, do: Callable[[], _T]) -> tuple[_T, float]:
    began = time.perf_counter()
    out = do()
    spent = time.perf_counter() - began
    _say(name, f"{1e3 * spent:.0f} ms")
    return out, spent


def _say(name: str, text: str) -> None:
    print(f"  {name:42} {text}", flush=True)


if __name__ == "__main__":
    sys.exit(main())
