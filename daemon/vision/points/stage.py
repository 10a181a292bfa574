"""When points are looked for, and how they join the crossings of lines.

Where lines cross at enough places nothing is looked for, so ordinary ceilings of tiles give what they gave before.
Lamps come first: nothing is placed as well as the centre of their light, and nothing is as quickly found.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import cv2
import numpy as np

from ceilvo.calibration import Calibration, to_ceiling
from ceilvo.crossing_types import CeilingLines
from ceilvo.daemon.vision.crossings import VAGUE_RAD, squares_with
from ceilvo.daemon.vision.points.lamps import as_bright, find_lamps
from ceilvo.daemon.vision.points.places import Found, Gray, Places, denoised, joined
from ceilvo.daemon.vision.points.spots import find_corners, find_spots, free_of_lamps
from ceilvo.daemon.vision.rolling_shutter import Readout
from ceilvo.daemon.vision.thinning import ALL_CELLS, ENOUGH, without_cells
from ceilvo.daemon.vision.tilt_prior import TiltPrior
from ceilvo.se2 import rotation
from ceilvo.types import NO_DIRECTION_RAD, Array, Crossings

PLENTY, AFTER = 25, 15
"""ENOUGH once points are looked for, and frames in which they still are then; chosen: fewer than tiles show, half a
second. Else motion is lost where a ceiling of slats or hexagons shows crossings first and corners then, or at once."""
_STEADY_RAD = np.radians(0.02)
"""Tilt of a robot that showed no lines to tell it by; chosen: floors in buildings, and a millimetre at 2.2 m."""

_REACH, _PIECES, _FAR_PX, _BESIDE_LINES_PX = 3.0, 97, 10000.0, 9
"""How far lines are followed to leave out what lies on them, over the ceiling's height; in how many pieces; pixels
beyond which nothing is in a picture; and how wide they are left out: a corner's block and two more; chosen."""

_UNSTEADY_RAD = 1e-3
"""What tilt and lens are off by in a view: it shifts all of it alike, and stretches its sides; chosen, 0.03 deg."""


class PointFinder:
    """Points of the frames of one camera; its look-up is made when lines do not suffice for the first time."""

    def __init__(self, calibration: Calibration, max_view_deg: float) -> None:
        self._calibration, self._max_view_deg = calibration, max_view_deg
        camera = calibration.level_view.camera
        self._principal_px = np.array([camera.cx_px, camera.cy_px])
        self._places: Places | None = None

    def __call__(
        self,
        gray: Gray,
        crossings: Crossings | None,
        prior: TiltPrior | None,
        now_and_then: bool = True,
        left: int = 0,
        readout: Readout | None = None,
        flickers: bool = False,
    ) -> tuple[Crossings | None, int]:
        """The crossings of a frame (H, W) with the points that it needs besides, None where there is neither; and in
        how many frames more they are looked for even if lines suffice.

        Args:
            prior: of the tilt, for frames without lines.
            now_and_then: this is one of the frames in which lamps are looked for on a ceiling that is all cells.
            left: what the last call said.
            readout: of a rolling shutter.
            flickers: crossings come and go: points are looked for as if there were none.
        """
        if crossings is not None and len(crossings) >= ALL_CELLS and not (now_and_then or flickers):
            return crossings, left
        view = self._calibration.level_view
        apart = crossings if crossings is None or flickers else without_cells(crossings)
        have = 0 if apart is None or flickers else squares_with(apart, view.focal_px)
        enough = PLENTY if left or flickers else ENOUGH
        if have >= enough and left <= 1:
            return crossings, 0
        left = AFTER if have < enough else left - 1
        only_lamps = apart is not crossings  # corners and spots of cells are as many as cells
        need = 0 if only_lamps else max(enough - have, ENOUGH)
        found = self._look(view.reduced(gray), need)
        if not len(found):
            return crossings, left
        if readout is not None:
            found = _at_one_instant(found, readout, view.focal_px)
        if crossings is None or not len(crossings):  # lines of one direction tell half of the tilt, and that badly
            crossings = self._without_crossings(crossings, prior)
        return self._with(crossings, found), left

    def fixtures(self, gray: Gray, crossings: Crossings, readout: Readout | None) -> Array:
        """(F, 2) corners and spots of a frame (H, W) in base, no light and nothing on its lines among them."""
        view, places = self._calibration.level_view, self._look_up()
        reduced = view.reduced(gray)
        smooth = denoised(reduced)
        free = free_of_lamps(places, as_bright(reduced, smooth, places)[1])
        if crossings.lines is not None:
            free = np.asarray(cv2.subtract(free, self._on_lines(crossings, crossings.lines)), np.uint8)
        found = joined([find_corners(smooth, reduced, places, free), find_spots(reduced, places, free)])
        if readout is not None:
            found = _at_one_instant(found, readout, view.focal_px)
        return to_ceiling(self._calibration.ceiling_from_level, self._uv(found, crossings.tilt_rad))

    def _on_lines(self, crossings: Crossings, lines: CeilingLines) -> Gray:
        """(H, W) 255 where lines lie, seen or not: what is there is no fixture."""
        view, places, axes = self._calibration.level_view, self._look_up(), rotation(crossings.psi_rad).T
        reach = _REACH * self._calibration.ceiling_height_m * np.linspace(-1.0, 1.0, _PIECES)
        middle, along = lines.offset_m[:, None] * axes[lines.axis], axes[1 - lines.axis]
        at = (middle[:, None] + reach[:, None] * along[:, None]).reshape(-1, 2)
        level = to_ceiling(self._calibration.level_from_ceiling, at) - self._principal_px
        raw = view.to_raw(_levelled(level, -crossings.tilt_rad, view.focal_px) + self._principal_px)
        on = np.zeros((places.height, places.width), np.uint8)
        for line in view.reduced_px(raw).reshape(len(lines.axis), _PIECES, 2):
            seen = np.all(np.isfinite(line) & (np.abs(line) < _FAR_PX), axis=1)
            cv2.polylines(on, [np.rint(line[seen]).astype(np.int32)], False, 255, _BESIDE_LINES_PX)
        return on

    def _look_up(self) -> Places:
        if self._places is None:
            self._places = Places(self._calibration, self._max_view_deg)
        return self._places

    def _look(self, gray: Gray, need: int) -> Found:
        places, smooth = self._look_up(), denoised(gray)
        lamps, bright = find_lamps(gray, smooth, places)
        found = [lamps]
        if len(lamps) < need:
            free = free_of_lamps(places, bright)
            for more in (partial(find_corners, smooth), find_spots):
                found.append(more(gray, places, free))
                if sum(map(len, found)) >= need:
                    break
        return joined(found)

    def _without_crossings(self, lines: Crossings | None, prior: TiltPrior | None) -> Crossings:
        """No crossings, with the tilt that is expected, and the direction that lines tell if there are some."""
        steady = TiltPrior(np.zeros(2), np.full(2, _STEADY_RAD)) if prior is None else prior
        roll, pitch = self._calibration.ceiling_height_m * steady.sigma_rad
        return Crossings(
            uv_px=np.zeros((0, 2)),
            xy_base_m=np.zeros((0, 2)),
            cov_base_m2=np.zeros((0, 2, 2)),
            crossing_type=np.zeros(0, np.int64),
            psi_rad=0.0 if lines is None else lines.psi_rad,
            psi_sigma_rad=NO_DIRECTION_RAD if lines is None else lines.psi_sigma_rad,
            tilt_rad=steady.mean_rad,
            tilt_sigma_rad=steady.sigma_rad,
            common_cov_m2=np.diag([pitch**2, roll**2]),
        )

    def _with(self, crossings: Crossings, found: Found) -> Crossings:
        """Crossings and points, the robot's tilt taken off the latter."""
        focal_px, uv = self._calibration.level_view.focal_px, self._uv(found, crossings.tilt_rad)
        own = self._calibration.metres_per_px**2 * (
            found.cov + _stretched((uv - self._principal_px) / focal_px, focal_px)
        )
        sure = crossings.psi_sigma_rad < VAGUE_RAD  # else a lamp's or a stain's outline was taken for lines
        return replace(
            crossings,
            psi_sigma_rad=crossings.psi_sigma_rad if sure else NO_DIRECTION_RAD,
            uv_px=np.concatenate([crossings.uv_px, uv]),
            xy_base_m=np.concatenate([crossings.xy_base_m, to_ceiling(self._calibration.ceiling_from_level, uv)]),
            cov_base_m2=np.concatenate([crossings.cov_base_m2, own + crossings.common_cov_m2]),
            crossing_type=np.concatenate([crossings.crossing_type, found.kind]),
        )

    def _uv(self, found: Found, tilt_rad: Array) -> Array:
        """(N, 2) px in the level view, the robot's tilt (2,) taken off."""
        levelled = _levelled(found.uv, tilt_rad, self._calibration.level_view.focal_px)
        return np.asarray(levelled + self._principal_px)


def _at_one_instant(found: Found, readout: Readout, focal_px: float) -> Found:
    """Points that were read row by row, moved by the predicted twist; what that is off by is in their covariance."""
    uv = readout.at_one_instant(found.uv, found.row)
    return replace(found, uv=uv, cov=found.cov + focal_px**2 * readout.cov_of_twist(uv / focal_px))


def _levelled(uv: Array, tilt_rad: Array, focal_px: float) -> Array:
    """(N, 2) px from the principal point as a level robot sees them, from what one tilted by tilt_rad (2,) did."""
    a, b = tilt_rad.tolist()
    x, y = uv[:, 0] / focal_px, uv[:, 1] / focal_px
    depth = 1.0 - b * x + a * y
    return np.asarray(np.column_stack([x + b, y - a]) * (focal_px / depth)[:, None])


def _stretched(at: Array, focal_px: float) -> Array:
    """(N, 2, 2) px^2 by which a small tilt moves points (N, 2), tangents of their angles, against the view's middle."""
    x, y = at.T
    by_tilt = np.stack([np.stack([-x * y, x * x], -1), np.stack([-y * y, x * y], -1)], axis=1)
    return np.asarray((focal_px * _UNSTEADY_RAD) ** 2 * (by_tilt @ by_tilt.transpose(0, 2, 1)))
