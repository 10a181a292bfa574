"""Ceilings on which lines cross too rarely: drives under them, and where their lamps hang."""

from __future__ import annotations

import numpy as np

from ceilvo import se2
from ceilvo.config import Config, Features
from ceilvo.config.reader import replace
from ceilvo.daemon.pipeline import Pipeline
from ceilvo.sim.ceiling.spec import CeilingSpec
from ceilvo.sim.world import World
from ceilvo.types import Array, Crossings, Estimate, Frame

RATE_HZ = 15.0
VIEW_DEG = Features().max_view_deg
PLASTER_ROUND = CeilingSpec(
    joints=False, tile_spread=0.0, vents=0, spots=0, stains=12, round_lamps=True, lamp_every=(3, 2)
)


def followed(world: World, start_s: float, frames: int, *overrides: str) -> tuple[list[Estimate], Array]:
    """Estimates of a drive through a world from a moment on, and (N,) how far each is from the truth, m."""
    world.start(0)
    pipeline = Pipeline(world.calibration, replace(Config(), overrides), np.random.default_rng(1))
    start, out, off = world.truth_at(start_s), [], []
    for k in range(frames):
        t_s = start_s + k / RATE_HZ
        out.append(pipeline.step(Frame(k, round(t_s * 1e9), world.frame_at(t_s))))
        off.append(float(np.hypot(*(se2.compose(start, out[-1].pose) - world.truth_at(t_s))[:2])))
    return out, np.array(off)


def lamps_at(room: World, pose: Array, tilt_rad: Array) -> Array:
    """(N, 2) true centres of lamps in base, of those that a robot at a pose sees as a whole."""
    calibration, layout = room.calibration, room.ceiling.layout
    rects = np.array([p.rect for p in layout.lamps])
    xy = se2.transform(se2.inverse(pose), 0.5 * (rects[:, :2] + rects[:, 2:]))
    uv = np.column_stack([xy, np.ones(len(xy))]) @ calibration.level_from_ceiling.T
    raw = calibration.level_view.to_raw(uv[:, :2] / uv[:, 2:])
    margin = 30.0 + 1.5 * calibration.camera.focal_px * float(np.max(np.abs(tilt_rad)))
    return np.asarray(xy[np.all((raw > margin) & (raw < np.array([640.0, 480.0]) - margin), axis=1)])


def off_m(seen: Crossings, kind: int, at: Array) -> Array:
    """(N,) distance from each place to the nearest point of a kind."""
    xy = seen.xy_base_m[seen.crossing_type == kind]
    return np.asarray(np.min(np.hypot(*(at[:, None] - xy[None]).transpose(2, 0, 1)), axis=1))
