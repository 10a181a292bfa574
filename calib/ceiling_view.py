"""The ceiling's own grid as a calibration target: crossings of joints in raw pixels, and their place in the lattice."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from ceilvo.calib.board import edge_width_px, light_problem
from ceilvo.calibration import Calibration, NoiseCurves, mount_rotation, projection_matrix
from ceilvo.camera import CameraModel
from ceilvo.config import Features
from ceilvo.daemon.crossings import cross
from ceilvo.daemon.edges import EdgeDetector
from ceilvo.daemon.lines import find_lines
from ceilvo.types import Lines

Array = NDArray[np.float64]
Ints = NDArray[np.int64]
Gray = NDArray[np.uint8]

GROOVES = 4
"""Crossing kind of two grooves (ceilvo.kinds)."""
_LEVEL_ENOUGH_RAD = float(np.radians(0.1))
_ROUNDS = 8
_MIN_CROSSINGS = 6
_SOFT_PX = 7.0
_NEAR_SHARE = 0.12
_ANY_NOISE = NoiseCurves((0.01,), (0.01,), 0.01, 0.0, 1.0)


@dataclass(frozen=True)
class GridView:
    """What one picture shows of the ceiling.

    Attributes:
        uv_px: (N, 2) crossings of joints, raw pixels; xy: (N, 2) the same on a ceiling at height 1, camera's axes
            levelled.
        psi_rad: direction of the joints in those axes, modulo 90 deg, psi_sigma_rad its standard deviation.
        reason: why the picture is no use, "" when it is.
    """

    uv_px: Array
    xy: Array
    psi_rad: float = 0.0
    psi_sigma_rad: float = 0.0
    reason: str = ""

    @property
    def ok(self) -> bool:
        return not self.reason


class CeilingReader:
    """Finds the joints' crossings in pictures of one camera that looks up, by the daemon's own front end.

    The camera's static tilt is learnt from the first picture and kept up to date.
    """

    def __init__(self, camera: CameraModel, tilt_rad: tuple[float, float] | None = None) -> None:
        """tilt_rad: roll, pitch as ceilvo.calibration.mount_rotation takes them, None = to be found."""
        self._camera = camera
        self._camera_from_level = np.eye(3) if tilt_rad is None else mount_rotation(0.0, *tilt_rad)
        self._features = replace(Features(), tilt_prior_deg=10.0 if tilt_rad is None else 1.0)
        self._known = tilt_rad is not None
        self._prepare()

    def _prepare(self) -> None:
        m = projection_matrix(self._camera, self._camera_from_level, (0.0, 0.0), 1.0)
        self._provisional = Calibration(self._camera, m, _ANY_NOISE)
        self._edges = EdgeDetector(self._provisional, self._features)

    @property
    def tilt_rad(self) -> tuple[float, float]:
        """Roll, pitch so far."""
        r = self._camera_from_level.T
        return float(np.arctan2(r[2, 1], r[2, 2])), float(-np.arcsin(np.clip(r[2, 0], -1, 1)))

    def __call__(self, gray: Gray) -> GridView:
        problem = light_problem(gray)
        if problem:
            return _none(problem)
        view = self._look(gray)
        if not view.ok and edge_width_px(gray) > _SOFT_PX:
            return _none(f"blurred: edges are {edge_width_px(gray):.1f} px wide; hold still, focus, more light")
        return view

    def _look(self, gray: Gray) -> GridView:
        lines: Lines | None = None
        for _ in range(_ROUNDS):
            lines = find_lines(self._edges(gray), self._features, self._provisional.level_view.focal_px)
            if lines is None:
                return _none("no two straight joints seen")
            tilt = lines.tilt_rad
            if self._known or np.abs(tilt).max() < _LEVEL_ENOUGH_RAD:
                break
            turn = cv2.Rodrigues(np.array([tilt[0], tilt[1], 0.0]))[0]
            self._camera_from_level = self._camera_from_level @ turn.T
            self._prepare()
        if lines is None:
            return _none("no two straight joints seen")
        found = cross(lines, self._provisional, self._features)
        grooves = found.kind == GROOVES
        if np.count_nonzero(grooves) < _MIN_CROSSINGS:
            return _none(f"only {np.count_nonzero(grooves)} crossings of joints seen, {_MIN_CROSSINGS} needed")
        self._known = True
        self._features = replace(self._features, tilt_prior_deg=1.0)
        level = self._provisional.level_view
        centre = np.array([self._camera.cx_px, self._camera.cy_px])
        xy = (found.uv_px[grooves] - centre) / level.focal_px
        a, b = lines.tilt_rad
        # the line fit turned the rays r by the tilt to r + w x r (ceilvo.daemon.lines); this takes them back
        turned = np.array([[1.0, 0.0, b], [0.0, 1.0, -a], [-b, a, 1.0]])
        rays = np.column_stack([xy, np.ones(len(xy))]) @ np.linalg.inv(turned).T
        uv = self._camera.pixels(rays @ self._camera_from_level.T)
        w, h = self._camera.width_px, self._camera.height_px
        inside = np.isfinite(uv).all(axis=1) & (uv > 0).all(axis=1) & (uv < [w - 1, h - 1]).all(axis=1)
        if np.count_nonzero(inside) < _MIN_CROSSINGS:
            return _none(f"only {np.count_nonzero(inside)} crossings of joints in the picture, {_MIN_CROSSINGS} needed")
        return GridView(uv[inside], xy[inside], lines.psi_rad, lines.psi_sigma_rad)


def _none(reason: str) -> GridView:
    return GridView(np.zeros((0, 2)), np.zeros((0, 2)), reason=reason)


@dataclass(frozen=True)
class Lattice:
    """Crossings of one picture that are on the grid.

    Attributes:
        index: (K, 2) whole tiles from the picture's own origin, which is the crossing nearest to the camera's foot.
        used: (K,) their rows in the GridView.
        xy_yaw: (3,) the camera's place in the lattice in tiles, and its heading, to start a fit from.
    """

    index: Ints
    used: Ints
    xy_yaw: Array


def spacing(views: list[GridView]) -> tuple[float, float]:
    """Side of a tile over the ceiling's height, and how regular the crossings are (0..1).

    The largest spacing that explains them nearly as well as any: half of it would as well.
    """
    s = np.geomspace(0.02, 2.5, 6000)
    score, count = np.zeros(len(s)), 0
    for view in views:
        for c in _along(view).T:
            waves = np.exp(2j * np.pi * c[None, :] / s[:, None])
            score += np.abs(waves.sum(axis=1))
            count += len(c)
    if count == 0:
        return float("nan"), 0.0
    score = score / count
    wide = np.array([max(np.ptp(_along(v), axis=0).min() for v in views)])
    score[s > 0.75 * wide] = 0.0  # a wave that fits in less than twice explains anything
    peaks = np.flatnonzero((score[1:-1] >= score[:-2]) & (score[1:-1] >= score[2:])) + 1
    if len(peaks) == 0:
        return float("nan"), 0.0
    best = peaks[score[peaks] >= 0.8 * score[peaks].max()].max()
    return float(s[best]), float(score[best])


def to_lattice(view: GridView, tile_share: float) -> Lattice | None:
    """Whole-tile coordinates, or None when too few crossings are on the grid."""
    c = _along(view)
    phase = np.angle(np.exp(2j * np.pi * c / tile_share).sum(axis=0)) / (2 * np.pi)
    k = c / tile_share - phase
    index = np.rint(k).astype(np.int64)
    used = np.flatnonzero((np.abs(k - index) < _NEAR_SHARE).all(axis=1))
    if len(used) < _MIN_CROSSINGS or (np.ptp(index[used], axis=0) < 1).any():
        return None
    return Lattice(index[used], used, np.array([*-phase, -view.psi_rad]))


def _along(view: GridView) -> Array:
    """(N, 2) crossings in the grid's own axes."""
    c, s = np.cos(view.psi_rad), np.sin(view.psi_rad)
    return np.asarray(view.xy @ np.array([[c, -s], [s, c]]))
