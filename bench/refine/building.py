"""A building of halls and corridors, driven through by a robot whose calibration is a little off; all truth is known.

Views are made from the true ceiling through the true lens and placed by the wrong one, as the daemon would. Poses and
map are what odometry makes of them with the direction of the lines, so they drift.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from ceilvo import se2
from ceilvo.calibration import Calibration, in_base
from ceilvo.daemon.map.key_poses import KeyPoses
from ceilvo.daemon.odometry.rigid import rigid_motion
from ceilvo.daemon.refinement.calibration_field import corrected
from ceilvo.daemon.refinement.refine import laid_on
from ceilvo.sim.rig import simulated_calibration
from ceilvo.types import Array, Ints, Landmarks

WRONG = np.array([0.005, 0.003, 0.03, np.radians(0.3), np.radians(-0.3)])
"""By how much the robot's calibration is off: height .5 %, focal length .3 %, k1 3 % of itself, mounting .3 deg."""
_PX = 0.1
"""Standard deviation of a crossing in the picture; docs/bench.md has .1 to .15 px for the grid."""
_LAID_M = 1e-3
"""Standard deviation of a tile's corner about the grid; chosen."""
_DIRECTION_RAD = 1e-4
"""Standard deviation of the direction of lines in a view; docs/bench.md: mrad/10."""
_CORNER_M = 1.5
"""Way along which a corner is rounded; the robot turns along twice as much, .84 rad/s at .8 m/s; chosen."""
_BORDER_PX = 10.0
_MOTION_SIGMA = np.array([1e-3, 1e-3, 5e-4])
"""Of the odometry between key poses, as it claims; chosen."""


@dataclass(frozen=True)
class Hall:
    """A rectangle of tiles: corner, size in m."""

    x_m: float
    y_m: float
    width_m: float
    depth_m: float


@dataclass(frozen=True)
class Drive:
    """One floor's ceiling (N, 2), the kinds of its crossings (N,), and true poses (K, 3) of each session."""

    xy_m: Array
    kind: Ints
    sessions: tuple[Array, ...]
    calibration: Calibration
    wrong: Calibration


def floor(
    halls: tuple[Hall, ...], tile_m: float, seed: int, sessions: int, step_m: float = 0.25, lane_m: float = 4.0
) -> Drive:
    """A floor whose sessions sweep all halls, each in lanes of its own."""
    rng = np.random.default_rng(seed)
    points = []
    for h in halls:
        x, y = np.arange(h.x_m, h.x_m + h.width_m, tile_m), np.arange(h.y_m, h.y_m + h.depth_m, tile_m)
        points.append(np.stack(np.meshgrid(x, y, indexing="ij"), -1).reshape(-1, 2))
    xy = np.concatenate(points)
    _, once = np.unique(np.round(xy / tile_m).astype(np.int64), axis=0, return_index=True)
    xy = xy[once]
    xy = xy + rng.normal(0.0, _LAID_M, xy.shape)
    true = simulated_calibration()
    off = WRONG * np.array([1, 1, true.camera.distortion[0], 1, 1])
    ways = tuple(sweep(halls, step_m, lane_m, (s + 0.5) / sessions) for s in range(sessions))
    return Drive(xy, rng.integers(0, 9, len(xy)), ways, true, corrected(true, off))


def sweep(halls: tuple[Hall, ...], step_m: float, lane_m: float, share: float) -> Array:
    """(K, 3) poses along lanes of each hall and back, and from hall to hall."""
    corners: list[tuple[float, float]] = []
    for h in halls:
        lanes = np.arange(h.y_m + 1.0 + share * lane_m * 0.5, h.y_m + h.depth_m - 1.0, lane_m)
        for i, y in enumerate(lanes):
            ends = (h.x_m + 1.0, h.x_m + h.width_m - 1.0)
            corners += [(x, float(y)) for x in (ends if i % 2 == 0 else ends[::-1])]
        corners += [(h.x_m + 1.0, h.y_m + h.depth_m - 1.0 - share), (h.x_m + 1.0 + share, h.y_m + 1.0 + share)]
    at = np.array(corners)
    length = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(at, axis=0).T))])
    along = np.arange(0.0, length[-1], step_m)
    xy = np.column_stack([np.interp(along, length, at[:, i]) for i in (0, 1)])
    heading = np.unwrap(np.arctan2(*np.gradient(xy, axis=0).T[::-1]))
    return np.column_stack([_smooth(xy, _CORNER_M, step_m), _smooth(heading[:, None], 2.0 * _CORNER_M, step_m)])


def _smooth(values: Array, over_m: float, step_m: float) -> Array:
    """Means of (K, n) over so much of the way."""
    half = round(0.5 * over_m / step_m)
    padded = np.pad(values, ((half, half), (0, 0)), "edge")
    total = np.cumsum(np.concatenate([np.zeros((1, values.shape[1])), padded]), axis=0)
    return np.asarray((total[2 * half + 1 :] - total[: -2 * half - 1]) / (2 * half + 1))


def views(drive: Drive, seed: int) -> tuple[list[KeyPoses], Landmarks]:
    """What the robot believes after all sessions: key poses by odometry, and landmarks where they were first seen."""
    rng = np.random.default_rng(seed)
    tree = cKDTree(drive.xy_m)
    place = np.full(drive.xy_m.shape, np.nan)
    seen = np.zeros(len(drive.xy_m), np.int64)
    sessions = []
    for number, way in enumerate(drive.sessions):
        sessions.append(_session(drive, way, tree, place, seen, rng, f"robot/{number}"))
    known = np.flatnonzero(seen)
    cov = np.broadcast_to(1e-4 * np.eye(2), (len(known), 2, 2))
    return sessions, Landmarks(known, place[known], cov, drive.kind[known], seen[known])


def _session(
    drive: Drive, way: Array, tree: cKDTree, place: Array, seen: Ints, rng: np.random.Generator, name: str
) -> KeyPoses:
    camera = drive.calibration.camera
    size = np.array([camera.width_px, camera.height_px]) - 1.0
    corners = in_base(drive.calibration, size * np.array([[0, 0], [1, 0], [0, 1], [1, 1.0]]))
    reach = float(np.hypot(*corners.T).max())
    pose = np.empty_like(way)
    motion = np.zeros_like(way)
    direction = -way[:, 2] + rng.normal(0.0, _DIRECTION_RAD, len(way))
    before: tuple[Ints, Array] | None = None
    view, xy, marks = [], [], []
    for k, true in enumerate(way):
        near = np.array(tree.query_ball_point(true[:2], reach), np.int64)
        base = (drive.xy_m[near] - true[:2]) @ se2.rotation(float(true[2]))
        level = np.column_stack([base, np.ones(len(base))]) @ drive.calibration.level_from_ceiling.T
        raw = drive.calibration.level_view.to_raw(level[:, :2] / level[:, 2:])
        inside = np.all((raw > _BORDER_PX) & (raw < size - _BORDER_PX), axis=1)
        near, raw = near[inside], raw[inside] + rng.normal(0.0, _PX, (np.count_nonzero(inside), 2))
        placed = in_base(drive.wrong, raw)
        if before is None:
            old = ~np.isnan(place[near, 0])
            pose[k] = rigid_motion(placed[old], place[near][old]) if np.count_nonzero(old) > 2 else true
        else:
            _, a, b = np.intersect1d(before[0], near, return_indices=True)
            motion[k] = rigid_motion(placed[b], before[1][a])
            pose[k] = se2.compose(pose[k - 1], motion[k])
            pose[k, 2] += se2.wrap(4.0 * (-direction[k] - pose[k, 2])) / 4.0
        new = near[np.isnan(place[near, 0])]
        place[new] = se2.transform(pose[k], placed[np.isin(near, new)])
        seen[near] += 1
        view.append(np.full(len(near), k))
        xy.append(placed)
        marks.append(near)
        before = near, placed
    features = np.concatenate(xy)
    m_per_px = drive.wrong.ceiling_height_m / camera.focal_px
    mark = np.concatenate(marks)
    return KeyPoses(
        session=name,
        stamp_ns=np.arange(len(way)),
        pose=pose,
        motion=motion,
        motion_cov=np.broadcast_to(np.diag(_MOTION_SIGMA**2), (len(way), 3, 3)),
        direction_rad=direction,
        direction_sigma_rad=np.full(len(way), _DIRECTION_RAD),
        view=np.concatenate(view),
        xy_base_m=features,
        cov_base_m2=np.broadcast_to((_PX * m_per_px) ** 2 * np.eye(2), (len(features), 2, 2)),
        crossing_type=drive.kind[mark],
        landmark=mark,
    )


@dataclass(frozen=True)
class MapError:
    """Of a map laid on the truth by turning and shifting."""

    rms_mm: float
    worst_mm: float
    scale_ppm: float

    def __str__(self) -> str:
        return f"{self.rms_mm:.2f} mm rms, {self.worst_mm:.2f} mm worst, scale {self.scale_ppm:+.0f} ppm"


def error(xy_m: Array, truth_m: Array) -> MapError:
    """Of landmarks (L, 2) against where they are."""
    off = np.hypot(*(laid_on(xy_m, truth_m) - truth_m).T)
    own, true = xy_m - xy_m.mean(axis=0), truth_m - truth_m.mean(axis=0)
    scale = np.sqrt(np.sum(own**2) / np.sum(true**2)) - 1.0
    return MapError(1e3 * float(np.sqrt(np.mean(off**2))), 1e3 * float(off.max()), 1e6 * float(scale))
