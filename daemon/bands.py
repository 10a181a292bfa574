"""Stage 1 and 2 when the last frame tells where to look: edges only in bands around predicted ones.

Profiles of brightness are read across every predicted edge, at even distances along it, straight from the raw frame.
Steps of the right polarity are found on them, first anywhere in the band, then near the shift that most steps of
their axis share; what is found goes into the same joint least squares as a full detection. When too few of the
predicted edges are there, the answer is None and the caller looks at the whole frame.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ceilvo.calibration import Calibration
from ceilvo.config import Features
from ceilvo.daemon.grooves import EdgeSet, join_grooves
from ceilvo.daemon.line_fit import JointFit, Points
from ceilvo.daemon.tilt import TiltPrior
from ceilvo.se2 import rotation
from ceilvo.types import Array, Lines

Array32 = NDArray[np.float32]

_SPACING_PX = 6.0
_REACH_PX = 7
_MOST_SAMPLES = 1200
_NEAR_PX = 2.0
_GOLDEN = 0.6180339887
_SHIFT_GATES_PX = (4.0, 2.5, 1.5)
_LIKELY_SHIFT_PX = 5.0
_LEVER_PX = 300.0
_GROW_PX = 15.0
_GRID_PX = 4.0
_FOUND_SHARE = 0.7
_SHIFT_BINS = 2 * _REACH_PX + 1
_NOISE_MAX_PX = 1.0


@dataclass(frozen=True, slots=True)
class _Samples:
    """Where profiles are read: level pixels (K, 2) of a level robot, their edge (K,), every spacing_px along it."""

    centre_px: Array
    edge: NDArray[np.int64]
    spacing_px: float


def predicted(edges: EdgeSet, prev_from_curr: Array, calibration: Calibration) -> EdgeSet:
    """The edges where a robot that moved by prev_from_curr (3,) should see them."""
    px_per_m = calibration.level_view.focal_px / calibration.ceiling_height_m
    turn = rotation(float(prev_from_curr[2]))
    mount = calibration.mount_xy_m
    shift = px_per_m * (turn @ mount + prev_from_curr[:2] - mount)
    angle = edges.psi_rad + 0.5 * np.pi * edges.axis
    across = np.cos(angle) * shift[0] + np.sin(angle) * shift[1]
    along = -np.sin(angle) * shift[0] + np.cos(angle) * shift[1]
    return EdgeSet(
        edges.psi_rad - float(prev_from_curr[2]),
        edges.axis,
        edges.rising,
        edges.offset_px - across,
        edges.start_px - along - _GROW_PX,
        edges.end_px - along + _GROW_PX,
        edges.noise_px,
    )


class BandDetector:
    """Looks for predicted edges in raw frames of one camera."""

    def __init__(self, calibration: Calibration, config: Features) -> None:
        self._config = config
        camera, view = calibration.camera, calibration.level_view
        self._focal = view.focal_px
        self._size = (camera.width_px, camera.height_px)
        uv = view.lookup(config.max_view_deg)
        low, high = np.nanmin(uv, axis=(0, 1)), np.nanmax(uv, axis=(0, 1))
        self._low = np.floor(low / _GRID_PX) * _GRID_PX
        columns, rows = (np.ceil((high - self._low) / _GRID_PX).astype(int) + 1).tolist()
        grid = np.stack(
            np.meshgrid(self._low[0] + _GRID_PX * np.arange(columns), self._low[1] + _GRID_PX * np.arange(rows)), -1
        )
        centre = np.array([camera.cx_px, camera.cy_px])
        raw = view.to_raw(grid.reshape(-1, 2) + centre)
        back = view.from_raw(np.nan_to_num(raw, nan=-1.0)) - centre  # a lens folds over beyond its edge: not invertible
        wrong = ~(np.hypot(*(back - grid.reshape(-1, 2)).T) < 0.5)
        raw[wrong] = np.nan
        self._raw = raw.reshape(rows, columns, 2).astype(np.float32)

    def __call__(
        self, gray: NDArray[np.uint8], expected: EdgeSet, tilt_rad: Array, prior: TiltPrior
    ) -> tuple[Lines, EdgeSet] | None:
        """Lines at the expected places, or None when too few are there.

        Args:
            tilt_rad: (2,) expected tilt of the robot.
            prior: for the final estimate of the tilt.
        """
        size = self._config.smoothing_px  # a profile is not smoothed along its edge as Sobel's is
        smooth = np.asarray(cv2.GaussianBlur(gray, (size, size), 0), np.uint8)
        samples = _sample(expected, self._limits())
        if len(samples.edge) == 0:
            return None
        angle = expected.psi_rad + 0.5 * np.pi * expected.axis
        normal = np.column_stack([np.cos(angle), np.sin(angle)])[samples.edge]
        seen = _seen(samples.centre_px / self._focal, tilt_rad) * self._focal
        profile, inside = self._profiles(smooth, seen, normal)
        edge, normal, seen = samples.edge[inside], normal[inside], seen[inside]
        sign = np.where(expected.rising[edge], np.float32(1), np.float32(-1))
        step = (profile[:, 2:] - profile[:, :-2]) * sign[:, None]
        floor = 0.25 * self._config.canny_floor
        shift = _common_shift(step, expected.axis[edge] == 0, floor, _columns(seen / self._focal, normal))
        at, good = _steps(step, shift, floor)
        found = np.bincount(edge[good], minlength=len(expected.axis))
        looked = np.bincount(edge, minlength=len(expected.axis))
        if not _enough(found, looked):
            return None
        points = seen[good] + at[good, None] * normal[good]
        return self._fit(points, edge[good], expected, tilt_rad, prior, 1.0 / samples.spacing_px)

    def _fit(
        self,
        points: Array,
        edge: NDArray[np.int64],
        expected: EdgeSet,
        tilt_rad: Array,
        prior: TiltPrior,
        share: float,
    ) -> tuple[Lines, EdgeSet] | None:
        group = 2 * expected.axis + expected.rising
        order = np.argsort(group, kind="stable")  # lines of the fit stand group after group
        place = np.empty_like(order)
        place[order] = np.arange(len(order))
        by_group = np.argsort(group[edge], kind="stable")
        a, b, c, d, e = np.cumsum([0, *np.bincount(group[edge], minlength=4)]).tolist()
        x, y = (np.ascontiguousarray(points[by_group, k] / self._focal, np.float32) for k in (0, 1))
        starts = [expected.offset_px[group == g] for g in range(4)]
        fit = JointFit(
            Points(x, y, (a, b, c, d, e), np.inf), expected.psi_rad, starts, self._focal, self._config, share, tilt_rad
        )
        fit.start(place[edge[by_group]], expected.offset_px[order])
        fit.solve()
        free = fit.finish()
        if self._config.estimate_tilt:
            fit.lean_on(prior)
        return join_grooves(fit, self._config, share, free) if fit.noise_px < _NOISE_MAX_PX else None

    def _limits(self) -> tuple[Array, Array]:
        rows, columns = self._raw.shape[:2]
        return self._low, self._low + _GRID_PX * np.array([columns - 1, rows - 1])

    def _to_raw(self, level_px: Array) -> Array32:
        """(K, 2) raw pixels of level pixels relative to the principal point, nan outside the picture."""
        where = ((level_px - self._low) / _GRID_PX).astype(np.float32)
        raw = cv2.remap(
            self._raw, where[None, :, 0], where[None, :, 1], cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_CONSTANT, borderValue=(np.nan, np.nan),
        )  # fmt: skip
        return np.asarray(raw[0], np.float32)

    def _profiles(self, smooth: NDArray[np.uint8], centre: Array, normal: Array) -> tuple[Array32, NDArray[np.bool_]]:
        """(K', 2 reach + 3) brightness across the edges, and which of the samples lie in the picture."""
        half, n = _REACH_PX + 1, len(centre)
        across = half * normal
        raw = self._to_raw(np.concatenate([centre, centre - across, centre + across]))
        middle, first, last = raw[:n], raw[n : 2 * n], raw[2 * n :]
        width, height = self._size
        low, high = np.minimum(first, last), np.maximum(first, last)  # nan compares as outside
        inside = (low[:, 0] > 1) & (low[:, 1] > 1) & (high[:, 0] < width - 2) & (high[:, 1] < height - 2)
        # a parabola through both ends and the middle follows the lens within hundredths of a pixel
        curve = np.stack([middle, 0.5 * (last - first), 0.5 * (last + first) - middle], axis=2)[inside]
        t = np.linspace(-1.0, 1.0, 2 * half + 1, dtype=np.float32)
        powers = np.stack([np.ones_like(t), t, t * t])
        profile = cv2.remap(smooth, curve[:, 0] @ powers, curve[:, 1] @ powers, cv2.INTER_LINEAR)
        return np.asarray(profile, np.float32), inside


def _sample(edges: EdgeSet, limits: tuple[Array, Array]) -> _Samples:
    """Even samples along every edge, where the look-up reaches."""
    low, high = limits
    reach = float(np.max(np.abs(np.concatenate([low, high])))) * 1.5
    start = np.maximum(edges.start_px, -reach)
    length = np.maximum(np.minimum(edges.end_px, reach) - start, 0.0)
    spacing = max(_SPACING_PX, float(np.sum(length)) / _MOST_SAMPLES)
    counts = (length / spacing).astype(np.int64)
    edge = np.repeat(np.arange(len(counts)), counts)
    k = np.arange(len(edge)) - np.repeat(np.cumsum(counts) - counts, counts)
    along = start[edge] + spacing * (k + 0.5)
    angle = edges.psi_rad + 0.5 * np.pi * edges.axis
    c, s = np.cos(angle)[edge], np.sin(angle)[edge]
    # profiles begin at all fractions of a pixel, so that the bias of sub-pixel peaks averages out along an edge
    offset = edges.offset_px[edge] + (_GOLDEN * k) % 1.0 - 0.5
    centre = np.column_stack([offset * c - along * s, offset * s + along * c])
    keep = np.all((centre > low + _REACH_PX) & (centre < high - _REACH_PX), axis=1)
    return _Samples(centre[keep], edge[keep], spacing)


def _seen(level: Array, tilt: Array) -> Array:
    """Where a tilted robot sees what a level one would see at (K, 2) ray coordinates."""
    a, b = tilt
    x, y = level[:, 0], level[:, 1]
    z = 1.0 - a * y + b * x
    return np.column_stack([(x - b) / z, (y + a) / z])


def _columns(seen: Array, normal: Array) -> Array:
    """(K, 3) how far edges at ray coordinates move along their normal when direction or tilt (x, y) change, rad."""
    x, y = seen[:, 0], seen[:, 1]
    nx, ny = normal[:, 0], normal[:, 1]
    turn = nx * -y + ny * x
    about_x = nx * x * y + ny * (1.0 + y * y)
    about_y = -(nx * (1.0 + x * x) + ny * x * y)
    return np.column_stack([turn, about_x, about_y])


def _common_shift(step: Array32, first: NDArray[np.bool_], floor: float, columns: Array) -> Array:
    """(K,) px by which the whole picture is off at every sample: a shift along both axes, a turn and a tilt.

    The scene is rigid, so five unknowns tell for all edges; a neighbouring line cannot pass for the one looked for.
    """
    best = np.argmax(step, axis=1)
    strong = step[np.arange(len(step)), best] >= floor
    at = (best - _REACH_PX).astype(np.float64)
    start = np.where(first, _mode(at[first & strong]), _mode(at[~first & strong]))
    model = np.column_stack([first, ~first, columns * _LEVER_PX])
    weak = np.diag([0.0, 0.0, 1.0, 1.0, 1.0]) + 1e-6 * np.eye(5)
    fitted = start
    for gate in _SHIFT_GATES_PX:
        use = strong & (np.abs(at - fitted) < gate)
        m = model[use]
        fitted = model @ np.linalg.solve(m.T @ m + weak, m.T @ at[use])
    return np.asarray(fitted)


def _mode(at: Array) -> float:
    """The shift that most steps share; small ones are likelier beforehand."""
    if len(at) == 0:
        return 0.0
    votes = np.bincount((at + _REACH_PX).astype(np.int64), minlength=_SHIFT_BINS).astype(np.float64)
    three = votes + np.concatenate([votes[1:], [0]]) + np.concatenate([[0], votes[:-1]])
    bins = np.arange(_SHIFT_BINS) - _REACH_PX
    return float(bins[np.argmax(three * np.exp(-0.5 * (bins / _LIKELY_SHIFT_PX) ** 2))])


def _steps(step: Array32, shift: Array, floor: float) -> tuple[Array, NDArray[np.bool_]]:
    """(K,) position of the step nearest to where it should be, px from the centre, and whether there is one."""
    middle = step[:, 1:-1]
    peak = (middle >= floor) & (middle >= step[:, :-2]) & (middle > step[:, 2:])
    off = np.abs(np.arange(1 - _REACH_PX, _REACH_PX)[None, :] - shift[:, None])
    best = np.argmin(np.where(peak, off, np.inf), axis=1)
    rows = np.arange(len(step))
    good = peak[rows, best] & (off[rows, best] < _NEAR_PX)
    before, here, after = step[rows, best], step[rows, best + 1], step[rows, best + 2]
    curvature = np.maximum(2.0 * here - before - after, 1e-3)
    at = best + 1 - _REACH_PX + np.clip(0.5 * (after - before) / curvature, -0.5, 0.5)
    return at.astype(np.float64), good


def _enough(found: NDArray[np.int64], looked: NDArray[np.int64]) -> bool:
    """Whether most of the predicted edges that are in view were seen along a good part of them."""
    in_view = looked >= 4
    seen = in_view & (found >= 0.4 * looked)
    return bool(np.count_nonzero(seen) >= max(_FOUND_SHARE * np.count_nonzero(in_view), 4))
