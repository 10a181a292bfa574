"""The ceiling's own grid as a calibration target: crossings of joints in raw pixels, and their place in the lattice."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from ceilvo.calib.targets.quality import edge_width_px, light_problem
from ceilvo.calibration import Calibration, NoiseCurves, mount_angles, mount_rotation, projection_matrix
from ceilvo.camera import CameraModel
from ceilvo.config import Features
from ceilvo.daemon.vision.crossings import cross
from ceilvo.daemon.vision.edges import EdgeDetector
from ceilvo.daemon.vision.lens import for_lens
from ceilvo.daemon.vision.line_detection import find_lines
from ceilvo.types import Lines

Array = NDArray[np.float64]
Gray = NDArray[np.uint8]

GROOVES = 4
"""Crossing kind of two grooves (ceilvo.crossing_types)."""
_LEVEL_ENOUGH_RAD = float(np.radians(0.1))
"""Tilt left at which the level view is level: a pixel at 64 deg across is 0.1 deg."""
_ROUNDS = 8
"""Of levelling the view; each leaves the square of the tilt before."""
_UNKNOWN_TILT_DEG, _KNOWN_TILT_DEG = 10.0, 1.0
"""Sigma of the tilt prior: of a camera bolted on by eye, and once the tilt was found."""
MIN_CROSSINGS = 6
"""Of joints in a picture; a pose has three unknowns, a crossing two equations."""
_SOFT_PX = 7.0
"""Width of the sharpest edges beyond which a picture without joints is called blurred."""
_ANY_NOISE = NoiseCurves((0.01,), (0.01,), 0.01, 0.0, 1.0)
"""Of a calibration that only serves the front end, which does not use it."""


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
        self._features = replace(Features(), tilt_prior_deg=_UNKNOWN_TILT_DEG if tilt_rad is None else _KNOWN_TILT_DEG)
        self._known = tilt_rad is not None
        self._prepare()

    def _prepare(self) -> None:
        m = projection_matrix(self._camera, self._camera_from_level, (0.0, 0.0), 1.0)
        self._provisional = Calibration(self._camera, m, _ANY_NOISE)
        self._features = for_lens(self._features, self._provisional.level_view)
        self._edges = EdgeDetector(self._provisional, self._features)

    @property
    def tilt_rad(self) -> tuple[float, float]:
        """Roll, pitch so far."""
        return mount_angles(self._camera_from_level)[1:]

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
        grooves = found.crossing_type == GROOVES
        if np.count_nonzero(grooves) < MIN_CROSSINGS:
            return _none(f"only {np.count_nonzero(grooves)} crossings of joints seen, {MIN_CROSSINGS} needed")
        self._known = True
        self._features = replace(self._features, tilt_prior_deg=_KNOWN_TILT_DEG)
        level = self._provisional.level_view
        centre = np.array([self._camera.cx_px, self._camera.cy_px])
        xy = (found.uv_px[grooves] - centre) / level.focal_px
        a, b = lines.tilt_rad
        # line_detection turned the rays r by the tilt to r + w x r; this takes them back
        turned = np.array([[1.0, 0.0, b], [0.0, 1.0, -a], [-b, a, 1.0]])
        rays = np.column_stack([xy, np.ones(len(xy))]) @ np.linalg.inv(turned).T
        uv = self._camera.pixels(rays @ self._camera_from_level.T)
        w, h = self._camera.width_px, self._camera.height_px
        inside = np.isfinite(uv).all(axis=1) & (uv > 0).all(axis=1) & (uv < [w - 1, h - 1]).all(axis=1)
        if np.count_nonzero(inside) < MIN_CROSSINGS:
            return _none(f"only {np.count_nonzero(inside)} crossings of joints in the picture, {MIN_CROSSINGS} needed")
        return GridView(uv[inside], xy[inside], lines.psi_rad, lines.psi_sigma_rad)


def _none(reason: str) -> GridView:
    return GridView(np.zeros((0, 2)), np.zeros((0, 2)), reason=reason)
