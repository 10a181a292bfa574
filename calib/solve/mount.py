"""Where the camera sits on the robot: its offset and yaw in base from a spin on the spot and a straight run."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from ceilvo import se2
from ceilvo.calib.solve import bundle
from ceilvo.calib.solve.grid import GridSample, grid_residual, grid_residuals, grid_samples
from ceilvo.calib.solve.lens import lens_of, with_lens_error
from ceilvo.calib.targets.ceiling_view import GridView
from ceilvo.camera import CameraModel
from ceilvo.errors import CalibrationError

Array = NDArray[np.float64]

SPIN, RUN = "spin", "run"
MIN_TURN_RAD = float(np.radians(200.0))
MIN_RUN_M = 0.8
_MIN_FRAMES = 12
_MOST_FRAMES = 45
_BLOCKS = 8
_OUTLIER, _OUTLIER_PX = 4.0, 0.3


@dataclass(frozen=True)
class Step:
    """One picture of the experiment: SPIN or RUN, what it shows, the wheels' cumulative pose if known."""

    label: str
    view: GridView
    wheels: Array | None = None


@dataclass(frozen=True)
class Mount:
    """What came out.

    Attributes:
        xy_m: (2,) camera in base; yaw_rad: of camera in base; sigma: (3,) of x, y, yaw, and cov (3, 3).
        turned_rad, run_m: how far the robot turned and ran.
        spin_rms_m, run_rms_m: residuals of both.
        wheel_scale, wheel_scale_sigma: true over reported distance, None without wheels; wheel_turn: of the turn.
        spin_xy_m: (N, 2) the camera's path in the spin, centred, for a plot; run_xy_m: (M, 2) the base's in the run.
    """

    xy_m: Array
    yaw_rad: float
    cov: Array
    turned_rad: float
    run_m: float
    spin_rms_m: float
    run_rms_m: float
    wheel_scale: float | None
    wheel_scale_sigma: float | None
    wheel_turn: float | None
    spin_xy_m: Array
    run_xy_m: Array

    @property
    def sigma(self) -> Array:
        return np.sqrt(np.diag(self.cov))


def calibrate(
    camera: CameraModel,
    steps: list[Step],
    tile_m: float,
    level: Array,
    intrinsics_cov: Array | None = None,
) -> Mount:
    """Offset and yaw from pictures under a tiled ceiling, in order of time.

    Args:
        tile_m: side of a tile.
        level: (3,) roll, pitch, height of calib.projection.
        intrinsics_cov: of the lens; None = taken as known.

    Raises:
        CalibrationError: too little turning or running, or the grid was lost on the way.
    """
    spin, run = ([s for s in steps if s.label == label] for label in (SPIN, RUN))
    for name, part in ((SPIN, spin), (RUN, run)):
        if len(part) < _MIN_FRAMES:
            raise CalibrationError(f"mount: found {len(part)} usable pictures of the {name}, {_MIN_FRAMES} needed")
    tracks = [_samples(part, tile_m / float(level[2])) for part in (spin, run)]

    best = _solve(camera, tracks, tile_m, level)
    _check(best)
    cov = _spread(best, _place_sigma(camera, best, tile_m))
    if intrinsics_cov is not None:
        cov = with_lens_error(cov, _lens_response(camera, best, tile_m, intrinsics_cov.shape[0]), intrinsics_cov)
    scale, scale_sigma, turn = _wheels(spin, run, best, tracks)
    return Mount(
        xy_m=best.values[:2],
        yaw_rad=float(best.values[2]),
        cov=cov,
        turned_rad=float(np.ptp(best.spin[:, 2])),
        run_m=best.run_m,
        spin_rms_m=float(np.sqrt(np.mean(best.spin_off**2))),
        run_rms_m=float(np.sqrt(np.mean(best.run_off**2))),
        wheel_scale=scale,
        wheel_scale_sigma=scale_sigma,
        wheel_turn=turn,
        spin_xy_m=best.spin[:, :2] - best.spin[:, :2].mean(axis=0),
        run_xy_m=best.run_base - best.run_base[0],
    )


@dataclass(frozen=True)
class _Track:
    """Samples of one part that are on the grid, and which steps they are."""

    samples: list[GridSample]
    rows: list[int]


def _samples(part: list[Step], share: float) -> _Track:
    rows, samples = [], []
    for i, s in enumerate(grid_samples([p.view for p in part], share)):
        if s is not None:
            rows.append(i)
            samples.append(s)
    if len(samples) < _MIN_FRAMES:
        raise CalibrationError(
            f"mount: found the grid in {len(samples)} of {len(part)} pictures of the {part[0].label}, "
            f"{_MIN_FRAMES} needed; stay under a regular part of the ceiling"
        )
    return _Track(samples, rows)


@dataclass(frozen=True)
class _Solution:
    """values: x, y, yaw; level: roll, pitch, height as refined; tracks without outliers, each picture's own pose, and
    the camera's poses in one lattice; residuals of both experiments."""

    values: Array
    level: Array
    tracks: list[_Track]
    own: list[Array]
    spin: Array
    run: Array
    spin_off: Array
    run_off: Array
    run_base: Array
    run_m: float


def _solve(camera: CameraModel, tracks: list[_Track], tile_m: float, level: Array) -> _Solution:
    """Tilt and height are refined on a part of the pictures, each picture's pose follows, then the two experiments."""
    every = [s for t in tracks for s in t.samples]
    some = every[:: max(1, -(-len(every) // _MOST_FRAMES))]
    starts = np.array([[*(s.start[:2] * tile_m), s.start[2]] for s in some])
    level = _level(camera, some, tile_m, level, starts, huber=2.0).shared
    own, clean = [], []
    for track in tracks:
        poses, samples = _poses(camera, track.samples, tile_m, level)
        own.append(poses)
        clean.append(_Track(samples, track.rows))
    return _experiments(level, clean, own, tile_m)


def _level(
    camera: CameraModel, some: list[GridSample], tile_m: float, level: Array, starts: Array, huber: float | None
) -> bundle.BundleFit:
    return bundle.solve(grid_residuals(camera, some, tile_m), level, starts, huber=huber, rounds=12 if huber else 3)


def _lens_response(camera: CameraModel, best: _Solution, tile_m: float, count: int) -> Array:
    """(3, count) how the values move with the lens' parameters: tilt and height follow, then the pictures' poses."""
    lens = lens_of(camera)
    if lens is None:
        return np.zeros((3, count))
    of, p = lens
    every = [s for t in best.tracks for s in t.samples]
    poses = np.concatenate(best.own)
    step = max(1, -(-len(every) // _MOST_FRAMES))
    some = every[::step]
    level, _ = bundle.response(lambda q: grid_residuals(of(q), some, tile_m), p, best.level, poses[::step])

    def given(q: Array) -> bundle.Residuals:
        residuals = grid_residuals(of(q), every, tile_m)
        return lambda i, _, view: residuals(i, best.level + level @ (q - p), view)

    _, own = bundle.response(given, p, np.zeros(0), poses)
    parts = np.split(own, [len(best.own[0])])
    moved = []
    for k in range(count):
        h = 1e-6 / max(float(np.abs(own[:, :, k]).max()), 1e-9)  # of a micrometre
        ends = [
            _experiments(
                best.level, best.tracks, [o + f * h * d[:, :, k] for o, d in zip(best.own, parts, strict=True)], tile_m
            )
            for f in (1.0, -1.0)
        ]
        moved.append((ends[0].values - ends[1].values) / (2.0 * h))
    return np.column_stack(moved)


def _experiments(level: Array, tracks: list[_Track], own: list[Array], tile_m: float) -> _Solution:
    spin, run = (_continuous(poses, tile_m) for poses in own)
    q, spin_off = _spin(spin)
    yaw, run_off, base, run_m = _run(run, q)
    xy = se2.rotation(yaw) @ q
    return _Solution(np.array([*xy, yaw]), level, tracks, own, spin, run, spin_off, run_off, base, run_m)


def _poses(
    camera: CameraModel, samples: list[GridSample], tile_m: float, level: Array
) -> tuple[Array, list[GridSample]]:
    """(N, 3) camera in each picture's own lattice, and the samples without crossings that do not belong to it."""
    out, clean = np.zeros((len(samples), 3)), []
    for i, sample in enumerate(samples):
        start = np.array([[*(sample.start[:2] * tile_m), sample.start[2]]])
        fit = bundle.solve(
            partial(_lattice_off, camera, sample, tile_m, level), np.zeros(0), start, huber=2.0, rounds=10
        )
        off = np.abs(fit.residuals[0].reshape(-1, 2)).max(axis=1)
        good = off < max(_OUTLIER * 1.4826 * float(np.median(off)), _OUTLIER_PX)
        kept, out[i] = sample, fit.views[0]
        if np.count_nonzero(good) >= 4 and not good.all():
            kept = replace(sample, index=sample.index[good], uv_px=sample.uv_px[good])
        out[i] = bundle.solve(
            partial(_lattice_off, camera, kept, tile_m, level), np.zeros(0), out[i][None], rounds=6
        ).views[0]
        clean.append(kept)
    return out, clean


def _continuous(own: Array, tile_m: float) -> Array:
    """The poses in one lattice: what a picture cannot tell is which tile it is, and which quarter turn."""
    out: Array = own.copy()
    velocity = np.zeros(2)
    for i in range(1, len(out)):
        out[i] = _nearest(own[i], out[i - 1], velocity, tile_m)
        velocity = out[i, :2] - out[i - 1, :2]
    return out


def _lattice_off(
    camera: CameraModel, sample: GridSample, tile_m: float, level: Array, _: int, __: Array, view: Array
) -> Array:
    return grid_residual(camera, sample, tile_m, level, view)


def _nearest(pose: Array, before: Array, velocity: Array, tile_m: float) -> Array:
    """The pose in the lattice of the picture before."""
    quarter = np.round((before[2] - pose[2]) / (0.5 * np.pi))
    xy = se2.rotation(0.5 * np.pi * float(quarter)) @ pose[:2]
    xy += np.round((before[:2] + velocity - xy) / tile_m) * tile_m
    return np.array([*xy, pose[2] + quarter * 0.5 * np.pi])


def _spin(poses: Array) -> tuple[Array, Array]:
    """The camera's offset in its own axes, and (N, 2) residuals: it moves on a circle about the base's origin."""
    n = len(poses)
    a = np.zeros((2 * n, 4))
    a[0::2, 0] = a[1::2, 1] = 1.0
    c, s = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    a[0::2, 2], a[0::2, 3], a[1::2, 2], a[1::2, 3] = c, -s, s, c
    b = poses[:, :2].ravel()
    x = np.linalg.lstsq(a, b, rcond=None)[0]
    return np.asarray(x[2:], np.float64), np.asarray((b - a @ x).reshape(-1, 2))


def _run(poses: Array, q: Array) -> tuple[float, Array, Array, float]:
    """Yaw of the camera, residuals (N, 2), path of base (N, 2) and its length: base moves along its own x."""
    c, s = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    base = poses[:, :2] - np.column_stack([c * q[0] - s * q[1], s * q[0] + c * q[1]])
    middle = 0.5 * (poses[1:, 2] + poses[:-1, 2])
    heading = np.column_stack([np.cos(middle), np.sin(middle)])
    step = np.diff(base, axis=0)
    turned = _angle(np.sum(step * heading), np.sum(heading[:, 0] * step[:, 1] - heading[:, 1] * step[:, 0]))
    for _ in range(3):
        along = np.sum(step * (heading @ se2.rotation(turned).T), axis=1)
        u = np.concatenate([np.zeros((1, 2)), np.cumsum(along[:, None] * heading, axis=0)])
        du, db = u - u.mean(axis=0), base - base.mean(axis=0)
        turned = _angle(np.sum(du * db), np.sum(du[:, 0] * db[:, 1] - du[:, 1] * db[:, 0]))
    off = db - du @ se2.rotation(turned).T
    # base's x axis is seen turned by `turned` from the camera's, so the camera is turned by the opposite in base
    return se2.wrap(-turned), off, base, float(np.hypot(*(base[-1] - base[0])))


def _angle(cosine: float, sine: float) -> float:
    return float(np.arctan2(sine, cosine))


def _check(s: _Solution) -> None:
    turned, run = float(np.ptp(s.spin[:, 2])), s.run_m
    if turned < MIN_TURN_RAD:
        raise CalibrationError(
            f"mount: found a spin of {np.degrees(turned):.0f} deg, at least {np.degrees(MIN_TURN_RAD):.0f} needed; "
            "turn the robot on the spot, four times round"
        )
    if run < MIN_RUN_M:
        raise CalibrationError(f"mount: found a run of {run:.2f} m, at least {MIN_RUN_M} needed; drive straight on")


def _place_sigma(camera: CameraModel, s: _Solution, tile_m: float) -> float:
    """Of a picture's place in the run, m, from its crossings' residuals."""
    residuals = grid_residuals(camera, s.tracks[1].samples, tile_m)
    variances = [
        float(np.mean(residuals(i, s.level, v) ** 2)) / len(t.index)
        for i, (v, t) in enumerate(zip(s.own[1], s.tracks[1].samples, strict=True))
    ]
    return float(np.sqrt(np.mean(variances)) * s.level[2] / camera.fx_px)


def _spread(s: _Solution, place_m: float) -> Array:
    """(3, 3) of x, y, yaw from the residuals, neighbours counting as one: they err together."""
    n = len(s.spin)
    c, sn = np.cos(s.spin[:, 2]), np.sin(s.spin[:, 2])
    a = np.zeros((2 * n, 4))
    a[0::2, 0] = a[1::2, 1] = 1.0
    a[0::2, 2], a[0::2, 3], a[1::2, 2], a[1::2, 3] = c, -sn, sn, c
    q_cov = _block_cov(a, s.spin_off)[2:, 2:] + _wander_var(s.spin[:, 2], s.spin_off) * np.eye(2)
    yaw = float(s.values[2])
    u = s.run_base - s.run_base.mean(axis=0)
    across = np.column_stack([-u[:, 1], u[:, 0]])
    m = len(u)
    b = np.zeros((2 * m, 3))
    b[0::2, 0] = b[1::2, 1] = 1.0
    b[:, 2] = across.ravel()
    # errors of places change so slowly under a grid that the scatter on the way does not show them: two ends count
    yaw_var = max(_block_cov(b, s.run_off)[2, 2], 2.0 * (place_m / s.run_m) ** 2)
    rot = se2.rotation(yaw)
    lever = np.array([-s.values[1], s.values[0]])
    cov = np.zeros((3, 3))
    cov[:2, :2] = rot @ q_cov @ rot.T + yaw_var * np.outer(lever, lever)
    cov[:2, 2] = cov[2, :2] = yaw_var * lever
    cov[2, 2] = yaw_var
    return cov


def _wander_var(heading: Array, off: Array) -> float:
    """Variance of each coordinate of the offset from a robot that does not turn exactly on the spot.

    Wandering that goes round once a turn looks the same as an offset; how much of it there is follows from wandering
    of nearly the same frequency: what goes round once or twice more, or less often, in the whole spin.
    """
    turns = float(np.ptp(heading)) / (2.0 * np.pi)
    frequencies = [1.0 + j / turns for j in (-2, -1, 1, 2)]
    z = off[:, 0] + 1j * off[:, 1]
    powers = [
        abs(np.mean(z * np.exp(-1j * k * heading))) ** 2
        for k in frequencies
        if abs(k) * turns > 0.6  # nothing is left of what stands still
    ]
    return float(np.mean(powers) / 2.0)


def _block_cov(a: Array, off: Array) -> Array:
    """Of a least squares' solution: the larger of independent rows and of rows that are alike within blocks."""
    inverse = np.linalg.inv(a.T @ a)
    r = off.ravel()
    white = inverse * float(r @ r) / max(len(r) - a.shape[1], 1)
    meat = np.zeros_like(inverse)
    for rows in np.array_split(np.arange(len(r)), _BLOCKS):
        score = a[rows].T @ r[rows]
        meat += np.outer(score, score)
    block = inverse @ meat @ inverse * _BLOCKS / max(_BLOCKS - a.shape[1], 1)
    grow = np.sqrt(np.maximum(np.diag(block) / np.maximum(np.diag(white), 1e-300), 1.0))
    return np.asarray(white * np.outer(grow, grow))


def _wheels(
    spin: list[Step], run: list[Step], s: _Solution, tracks: list[_Track]
) -> tuple[float | None, float | None, float | None]:
    """True over reported: distance with its sigma, and turn."""
    known = [
        np.flatnonzero([part[i].wheels is not None for i in track.rows])
        for part, track in zip((spin, run), tracks, strict=True)
    ]
    if any(len(k) < _MIN_FRAMES for k in known):
        return None, None, None
    turns, way = (
        np.array([part[track.rows[i]].wheels for i in k], np.float64)
        for part, track, k in zip((spin, run), tracks, known, strict=True)
    )
    base = s.run_base[known[1]]
    true_step = np.hypot(*np.diff(base, axis=0).T)
    told_step = np.hypot(*np.diff(way[:, :2], axis=0).T)
    if told_step.sum() < 0.1 * s.run_m:
        return None, None, None
    scale = float(np.hypot(*(base[-1] - base[0])) / np.hypot(*(way[-1, :2] - way[0, :2])))
    parts = [
        float(t.sum() / max(w.sum(), 1e-9))
        for t, w in zip(np.array_split(true_step, 5), np.array_split(told_step, 5), strict=True)
    ]
    turned = float(np.ptp(np.unwrap(turns[:, 2])))
    return (
        scale,
        float(np.std(parts, ddof=1) / np.sqrt(5)),
        float(np.ptp(s.spin[known[0], 2])) / turned if turned > 1 else None,
    )


def problems(m: Mount) -> list[str]:
    """What keeps the result from a PASS, with what to do."""
    out = []
    if m.sigma[:2].max() > 0.005:
        out.append(
            f"the offset is known to {1e3 * m.sigma[:2].max():.1f} mm only, 5 needed: turn on the spot, more rounds"
        )
    if m.sigma[2] > np.radians(0.3):
        out.append(f"the yaw is known to {np.degrees(m.sigma[2]):.2f} deg only, 0.3 needed: a longer, straighter run")
    if m.spin_rms_m > 0.02:
        out.append(f"the robot wandered by {1e3 * m.spin_rms_m:.0f} mm in the spin, 20 allowed: turn on the spot")
    if m.run_rms_m > 0.02:
        out.append(f"the run was off a straight line by {1e3 * m.run_rms_m:.0f} mm, 20 allowed: drive without slip")
    if m.wheel_scale is not None and not 0.9 < m.wheel_scale < 1.1:
        out.append(f"the wheels report {1 / m.wheel_scale:.3f} of the way driven: check their diameter in the base")
    return out
