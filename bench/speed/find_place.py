"""Time, memory and answers of the place index on halls of 150 m x 100 m: `make bench-find-place`.

Views are the synthetic eye's of bench/place, from poses anywhere in the hall, one view a pose, with the heading named
by any quarter turn. Times are of this process on one thread. Bytes, fractions and the ratios between maps of 1,000 and
100,000 landmarks do not depend on the machine.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from ceilvo.bench.place.ceiling.eye import SyntheticEye
from ceilvo.bench.place.ceiling.worlds import LAMPS, World, WorldSpec, landmarks_of, make_world
from ceilvo.bench.results.bars import Bar, as_json, table
from ceilvo.bench.results.store import one_thread
from ceilvo.bench.speed.filter_step import medians
from ceilvo.calibration import Calibration
from ceilvo.config import Config
from ceilvo.daemon.relocalisation.evidence.sharp_view import SharpView
from ceilvo.daemon.relocalisation.place_index.found import cost
from ceilvo.daemon.relocalisation.place_index.place_index import PlaceIndex
from ceilvo.daemon.slam.association import associate
from ceilvo.daemon.slam.spatial_index import landmarks_near
from ceilvo.files import write_atomic
from ceilvo.json_values import json_value
from ceilvo.se2 import compose, wrap_array
from ceilvo.sim.rig import simulated_calibration
from ceilvo.types import Array, Landmarks, Observations

TILE_M = 0.8
"""With it a hall of 150 m x 100 m has the 30,000 landmarks that the bars are about."""
WALL_M = 1.0  # poses are so far from the walls at least; chosen: a robot's radius and some
NEAR_M = 0.2  # a candidate so near is the true place; chosen: a third of the least tile and the grid's reach
SIZES = (1_000, 10_000, 100_000)  # landmarks at random, axis; chosen, from a room to several halls
PER_M2 = 2.0  # landmarks at random; as on those halls
CHANGED = 10  # landmarks that come and go in an update
REFRESHED = 200  # landmarks looked through in an update; chosen: a map of 100,000 takes 500 updates
ADD, REMOVE, REFRESH = f"add {CHANGED}, ms", f"remove {CHANGED}, ms", f"look through {REFRESHED}, ms"
VARIED_TYPES = (0, 2, 6, 8)  # of landmarks at random: corners of lamps


def main(arguments: Sequence[str] | None = None) -> int:
    args = parser().parse_args(arguments)
    one_thread()
    halls = [hall(WorldSpec("150", TILE_M, lamps, args.seed), args.views) for lamps in LAMPS]
    document = {"halls": halls, "sizes": [grown(n, args.repeats) for n in SIZES], "seed": args.seed}
    console = Console(width=None if sys.stdout.isatty() else 140)
    for title, key in (("Halls of 150 m x 100 m, tiles of 0.8 m", "halls"), ("Landmarks at random, 2 a m^2", "sizes")):
        console.print(_table(document[key], title))
    found = bars(document)
    console.print(table(found, "What it must show"))
    args.json.parent.mkdir(parents=True, exist_ok=True)
    write_atomic(args.json, json.dumps(json_value({**document, "bars": as_json(found)}), indent=1) + "\n")
    console.print(f"figures in {args.json}")
    return 0


def parser() -> argparse.ArgumentParser:
    p = argparse.ArgumentParser(prog="python -m ceilvo.bench.speed.find_place", description="The place index.")
    p.add_argument("--views", type=int, default=100, metavar="N", help="a hall (%(default)s)")
    p.add_argument("--seed", type=int, default=101, metavar="N", help="of halls and poses (%(default)s)")
    p.add_argument("--repeats", type=int, default=5, metavar="N", help="ten updates each (%(default)s)")
    p.add_argument("--json", type=Path, default=Path("build/bench/find_place.json"), metavar="FILE")
    return p


class Hall:
    """A hall with its map, and views of it."""

    def __init__(self, spec: WorldSpec) -> None:
        self._rng = np.random.default_rng([spec.seed, 0x1D])
        self.world: World = make_world(spec)
        self._calibration: Calibration = simulated_calibration(tile_m=spec.tile_m)
        self._eye = SyntheticEye(self.world.features, self._calibration, self._rng)
        self.landmarks: Landmarks = landmarks_of(self.world.features, self._eye.missed, self._rng)
        self._visible_m = SharpView(self._calibration, Config().features.max_view_deg).visible_m

    def view(self) -> tuple[Array, Observations | None]:
        """A pose (3,) anywhere and what is seen from it, its heading named by any quarter turn."""
        x0, y0, x1, y1 = self.world.room
        low, high = [x0 + WALL_M, y0 + WALL_M, -np.pi], [x1 - WALL_M, y1 - WALL_M, np.pi]
        pose = compose(self.world.map_from_ceiling, self._rng.uniform(low, high))
        crossings = self._eye.look(pose)
        if crossings is None:
            return pose, None
        turned = pose + np.array([0.0, 0.0, 0.5 * np.pi * self._rng.integers(4)])
        noise, mount, none = self._calibration.noise, self._calibration.mount_xy_m, self.landmarks.of(np.arange(0))
        nothing = partial(landmarks_near, none)
        axis = self.world.features.axis_rad
        view = associate(crossings, noise, mount, turned, nothing, Config().filter, axis)
        return pose, replace(view, visible_m=self._visible_m)


def hall(spec: WorldSpec, views: int) -> dict[str, Any]:
    """Figures of a hall."""
    scene = Hall(spec)
    begun = time.process_time()
    index = PlaceIndex.of(scene.landmarks)
    build_s = time.process_time() - begun
    rows = [_asked(index, *scene.view()) for _ in range(views)]
    ms, listed, has, due = (np.array([r[k] for r in rows]) for k in ("ms", "listed", "has", "due"))
    complete = np.array([r["complete"] for r in rows])
    return {
        "map": f"lamps: {spec.lamps}",
        "landmarks": len(index),
        "build s": build_s,
        "bytes a landmark": index.nbytes / len(index),
        "ms a view": float(np.median(ms)),
        "ms 95 %": float(np.percentile(ms, 95)),
        "places": float(np.median(listed)),
        "true one listed %": 100.0 * float(np.mean(has)),
        "complete %": 100.0 * float(np.mean(complete)),
        "complete and true one too dear %": 100.0 * float(np.mean(complete & ~due)),
        "due and not listed": int(np.count_nonzero(due & ~has)),
    }


def _asked(index: PlaceIndex, pose: Array, view: Observations | None) -> dict[str, Any]:
    if view is None:
        return {"ms": 0.0, "listed": 0, "complete": False, "has": False, "due": False}
    begun = time.process_time()
    found = index.candidates(view)
    ms = 1e3 * (time.process_time() - begun)
    off = np.hypot(*(found.pose - pose)[:, :2].T) + np.abs(wrap_array(found.pose[:, 2] - pose[2]))
    _, contradicted, missed = index.counts(pose[None], view)
    due = found.complete and cost(contradicted, missed)[0] <= found.limit
    return {"ms": ms, "listed": len(found), "complete": found.complete, "has": bool(np.any(off < NEAR_M)), "due": due}


def grown(count: int, repeats: int) -> dict[str, Any]:
    """Figures of a map of landmarks at random, and the time of changes in it."""
    rng = np.random.default_rng([count, 0x1E])
    side_m = float(np.sqrt(count / PER_M2))

    def some(n: int, kinds: Sequence[int], first_id: int) -> Landmarks:
        xy, kind = rng.uniform(0.0, side_m, (n, 2)), rng.choice(kinds, n)
        return Landmarks(first_id + np.arange(n), xy, np.zeros((n, 2, 2)), kind, np.full(n, 9))

    landmarks = some(count, VARIED_TYPES, 0)
    index, more = PlaceIndex.of(landmarks), some(CHANGED, VARIED_TYPES, count)
    part = landmarks.of(rng.permutation(count)[:REFRESHED])
    added, removed = np.median([_changed(index, more) for _ in range(10 * repeats)], axis=0)
    us = medians({"refresh": lambda: index.sync(part)}, repeats, {})
    out = {"landmarks": count, ADD: float(added), REMOVE: float(removed), REFRESH: us["refresh"] / 1e3}
    for name, kinds in (("of 4 types", VARIED_TYPES), ("of 1 type", VARIED_TYPES[:1])):
        known = some(count, kinds, 0)
        out[f"ms a view {name}"] = float(np.median(_random_views(PlaceIndex.of(known), known, side_m, rng)))
    return out


def _changed(index: PlaceIndex, more: Landmarks) -> tuple[float, float]:
    """ms to add landmarks and to remove them again."""
    begun = time.process_time()
    index.add(more)
    between = time.process_time()
    index.remove(more.ids)
    return 1e3 * (between - begun), 1e3 * (time.process_time() - between)


def _random_views(index: PlaceIndex, known: Landmarks, side_m: float, rng: np.random.Generator) -> list[float]:
    out = []
    for _ in range(15):
        at = known.xy_map_m - rng.uniform(0.1 * side_m, 0.9 * side_m, 2)
        seen = np.flatnonzero(np.all(np.abs(at) < 1.8, axis=1))
        xy, var = at[seen] + 0.005 * rng.standard_normal((len(seen), 2)), np.full((len(seen), 2), 2.5e-5)
        view = Observations(xy, var, known.crossing_type[seen], seen, 0.0, 1e-4)
        out.append(_asked(index, np.zeros(3), view)["ms"])
    return out


def bars(document: dict[str, Any]) -> list[Bar]:
    raster = document["halls"][0]
    small, large = document["sizes"][0], document["sizes"][-1]
    ratio = large[ADD] / small[ADD]
    absent = sum(h["due and not listed"] for h in document["halls"])
    return [
        Bar("raster with gaps: ms a view, median", raster["ms a view"], f"{raster['ms a view']:.1f}", high=50.0),
        Bar("the same: bytes a landmark", raster["bytes a landmark"], f"{raster['bytes a landmark']:.0f}", high=200.0),
        Bar("the same: built in s", raster["build s"], f"{raster['build s']:.2f}", high=2.0),
        Bar("all halls: complete, true place within the limit and not listed", absent, str(absent), high=0),
        Bar(f"{ADD}, of {large['landmarks']:,}", large[ADD], f"{large[ADD]:.2f}", high=1.0),
        Bar(f"the same to that of {small['landmarks']:,}", ratio, f"{ratio:.2f}", high=1.3),
    ]


def _table(rows: Sequence[dict[str, Any]], title: str) -> Table:
    out = Table(*rows[0], title=title)
    for r in rows:
        out.add_row(
            *(f"{v:,.3g}" if isinstance(v, float) else f"{v:,}" if isinstance(v, int) else v for v in r.values())
        )
    return out


if __name__ == "__main__":
    sys.exit(main())
