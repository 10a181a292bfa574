"""Stages 1 and 2 when the last frame shows where to look: edges only near predicted ones (predict and verify).

A sparse look along every predicted edge shows by how much the whole picture is off: the scene is rigid, so two shifts,
a turn and a tilt do for all edges. A close look there finds the same edge points that a full detection would, and they
go into the same joint least squares. When too few of the predicted edges are there, or they fit worse than lately, the
answer is None and the caller looks at the whole frame.
"""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from ceilvo.calibration import Calibration
from ceilvo.config import Features
from ceilvo.daemon.vision import kernel
from ceilvo.daemon.vision.edge_points import Points
from ceilvo.daemon.vision.edges import framed_room, noise_samples, smoothed, thresholds
from ceilvo.daemon.vision.kernel.arguments import LOOKUP_STEP_PX, SEGMENT_PX, Ends, Grids, Int32s, Look
from ceilvo.daemon.vision.line_detection import NOISE_RATIO, LastFit
from ceilvo.daemon.vision.line_fit import JointFit
from ceilvo.daemon.vision.line_pairing import EdgeSet, pair_edges
from ceilvo.daemon.vision.rolling_shutter import Readout
from ceilvo.daemon.vision.tilt_prior import TiltPrior
from ceilvo.se2 import rotation
from ceilvo.types import Array, Ints, Lines

_CELL_PX = 4.0
"""Spacing of the look-up from level to raw pixels, bilinear between; chosen: only places to look at come from it."""
_INVERTIBLE_PX = 0.5
"""A lens is invertible where a level pixel comes back to within this; chosen: folds are off by far more."""
_SPARSE_STEP_PX, _SPARSE_REACH_PX = 12.0, 10.0
"""Sparse look: every so far along an edge, and this far to either side. The prototype's +-7 and room; chosen."""
_CLOSE_STEP_PX, _CLOSE_REACH_PX = 2.0, 2.0
"""Close look: half of the edge points that a full detection finds, within its gates; chosen."""
_EXTEND_PX = 15.0
"""An edge is looked for this far beyond the ends it had; chosen: new parts come into view at the rim."""
_SHIFT_GATES_PX = np.array([4.0, 2.5, 1.5])
"""Distance of a point from the common shift, turn and tilt, round by round; chosen to end near the close reach."""
_SHIFTS_PX = np.arange(-_SPARSE_REACH_PX - 2.0, _SPARSE_REACH_PX + 3.0)
"""Centres of the bins that vote for a shift: 1 px wide, with 2 to spare at either end."""
_SHIFT_SIGMA_PX = 5.0
"""Standard deviation of the shift beforehand; chosen: half the reach, so of two equal peaks the nearer wins."""
_SHIFT_INFO = 1e-6
"""px^-2, of the shift in the least squares: as good as none, but an axis without points is not singular."""
_TURN_SIGMA_RAD = 0.02
"""Standard deviation beforehand of turn and tilt against the last frame; chosen: 1.1 deg, a robot that rocks."""
_HELD_RAD = 1e-9
"""The same for a tilt that is not estimated: as good as 0."""
_MIN_SPARSE_POINTS = 40
"""Fewest points of the sparse look; chosen: five unknowns rest on them."""
_MIN_CLOSE_POINTS = 600
"""Fewest points of the close look; chosen: with fewer a whole look costs little and sees what this one misses."""
_SEEN_FRACTION = 0.4
"""An edge is there when seen along this fraction of what was seen of it before; chosen: part may leave the view."""
_FOUND_FRACTION = 0.7
"""Of the edges in view that must be there; chosen: new light or a wrong prediction loses more (docs/method.md)."""
_MIN_LOOKS = 4
"""An edge is in view where at least so many points of it are hoped for; chosen: fewer tell nothing."""
_MIN_EDGES = 4
"""Fewest edges that must be there; chosen: two an axis."""
_GROUPS = np.arange(4)
_SHIFT_LIKELIHOOD = np.exp(-0.5 * (_SHIFTS_PX / _SHIFT_SIGMA_PX) ** 2)


def predicted(edges: EdgeSet, prev_from_curr: Array, calibration: Calibration) -> EdgeSet:
    """The edges where a robot that moved by prev_from_curr (3,) should see them."""
    px_per_m = calibration.level_view.focal_px / calibration.ceiling_height_m
    turn = rotation(float(prev_from_curr[2]))
    mount = calibration.mount_xy_m
    shift = px_per_m * (turn @ mount + prev_from_curr[:2] - mount)
    angle = edges.psi_rad + 0.5 * np.pi * edges.axis
    across = np.cos(angle) * shift[0] + np.sin(angle) * shift[1]
    along = -np.sin(angle) * shift[0] + np.cos(angle) * shift[1]
    return replace(
        edges,
        psi_rad=edges.psi_rad - float(prev_from_curr[2]),
        offset_px=edges.offset_px - across,
        start_px=edges.start_px - along - _EXTEND_PX,
        end_px=edges.end_px - along + _EXTEND_PX,
    )


class EdgeTracker:
    """Finds predicted edges in raw frames of one camera; its look-ups are made once."""

    def __init__(self, calibration: Calibration, config: Features) -> None:
        self._config = config
        self._view, self._focal = calibration.level_view, calibration.level_view.focal_px
        self._grids = look_ups(calibration, config.max_view_deg)
        self._samples, self._framed = noise_samples(self._view, config.max_view_deg), framed_room(self._view)
        self._gate = float(np.cos(np.radians(config.direction_gate_deg)))
        self._tilt_sigma_rad = _TURN_SIGMA_RAD if config.estimate_tilt else _HELD_RAD

    def __call__(
        self,
        gray: NDArray[np.uint8],
        expected: EdgeSet,
        last: LastFit,
        prior: TiltPrior,
        readout: Readout | None = None,
    ) -> tuple[Lines, EdgeSet] | None:
        """Lines at the expected places, or None when too few are there.

        Args:
            last: of the frames before; the tilt is where the search begins.
            prior: for the final estimate of the tilt.
            readout: of a rolling shutter.
        """
        framed = smoothed(self._view.reduced(gray), self._config, self._framed)
        floor, _ = thresholds(framed, self._config, self._samples)
        rows = None if readout is None else readout.rows
        edges, group = _by_group(expected)
        begins = np.searchsorted(group, _GROUPS)

        def look(edges: EdgeSet, tilt_rad: Array, look: Look) -> tuple[Points, Int32s, Ints]:
            lines = _oriented(edges, group)
            x, y, line, looked = kernel.follow(framed, self._grids, lines, tilt_rad, self._focal, look, rows)
            return Points(x, y, _ends(line, begins), np.inf), line, looked

        sparse = look(edges, last.tilt_rad, Look(_SPARSE_STEP_PX, _SPARSE_REACH_PX, floor, self._gate, True))
        if len(sparse[1]) < _MIN_SPARSE_POINTS:
            return None
        edges, tilt_rad = _align(edges, sparse[0], sparse[1], last.tilt_rad, self._focal, self._tilt_sigma_rad)
        points, line, looked = look(edges, tilt_rad, Look(_CLOSE_STEP_PX, _CLOSE_REACH_PX, floor, self._gate, False))
        seen = np.bincount(line, minlength=len(looked))
        if len(line) < _MIN_CLOSE_POINTS or not _enough(seen, looked * edges.coverage):
            return None
        starts = [edges.offset_px[a:b] for a, b in pairwise([*begins.tolist(), len(group)])]
        return self._fit(points, line, edges, starts, tilt_rad, last, prior, readout)

    def _fit(
        self,
        points: Points,
        line: Int32s,
        edges: EdgeSet,
        starts: list[Array],
        tilt_rad: Array,
        last: LastFit,
        prior: TiltPrior,
        readout: Readout | None,
    ) -> tuple[Lines, EdgeSet] | None:
        fraction = 1.0 / _CLOSE_STEP_PX
        fit = JointFit(points, edges.psi_rad, starts, self._focal, self._config, fraction, tilt_rad, readout)
        fit.start(line, edges.offset_px)
        fit.solve()
        free = fit.finish()
        if fit.noise_px > NOISE_RATIO * last.noise_px:
            return None
        if self._config.estimate_tilt and not fit.apply_prior(prior):
            return None
        return pair_edges(fit, self._config, fraction, free, uniform=True)


def look_ups(calibration: Calibration, max_view_deg: float) -> Grids:
    """Look-ups to the level view and back, where the lens can be inverted."""
    view = calibration.level_view
    lookup = view.lookup(max_view_deg, LOOKUP_STEP_PX)
    low = np.floor((np.nanmin(lookup, axis=(0, 1)) - SEGMENT_PX) / _CELL_PX) * _CELL_PX
    high = np.nanmax(lookup, axis=(0, 1)) + SEGMENT_PX
    x, y = (np.arange(a, b + _CELL_PX, _CELL_PX) for a, b in zip(low, high, strict=True))
    grid = np.stack(np.meshgrid(x, y), -1).reshape(-1, 2)
    centre = np.array([view.camera.cx_px, view.camera.cy_px])
    raw = view.to_raw(grid + centre)
    back = view.from_raw(np.nan_to_num(raw, nan=-1.0)) - centre  # a lens folds over beyond its edge: not invertible
    raw[~(np.hypot(*(back - grid).T) < _INVERTIBLE_PX)] = np.nan
    table = np.ascontiguousarray(view.reduced_px(raw).reshape(len(y), len(x), 2), np.float32)
    return Grids(lookup, table, (float(low[0]), float(low[1])), _CELL_PX)


def _by_group(edges: EdgeSet) -> tuple[EdgeSet, Ints]:
    """Edges in the order in which points stand, group after group, and the group of each."""
    group = 2 * edges.axis + edges.rising
    order = np.argsort(group, kind="stable")
    fields = {k: getattr(edges, k)[order] for k in ("axis", "rising", "offset_px", "start_px", "end_px", "coverage")}
    return replace(edges, **fields), group[order]


def _ends(line: Int32s, begins: Ints) -> Ends:
    """Bounds of the groups of points, whose lines stand in the order of the edges; begins: (4,) of groups of edges."""
    a, b, c, d = np.searchsorted(line, begins.astype(np.int32)).tolist()
    return a, b, c, d, len(line)


def _oriented(edges: EdgeSet, group: Ints) -> Array:
    """(E, 5) rows of kernel.follow: cos and sin of the direction in which brightness rises, offset, start, end."""
    c, s = math.cos(edges.psi_rad), math.sin(edges.psi_rad)
    normals = np.array([[-c, -s], [c, s], [s, -c], [-s, c]])  # of each group, along which brightness rises
    out, rising = np.empty((len(group), 5)), edges.rising
    out[:, :2] = normals[group]
    out[:, 2] = np.where(rising, edges.offset_px, -edges.offset_px)
    out[:, 3] = np.where(rising, edges.start_px, -edges.end_px)
    out[:, 4] = np.where(rising, edges.end_px, -edges.start_px)
    return out


def _align(
    edges: EdgeSet, points: Points, line: Int32s, tilt_rad: Array, focal_px: float, tilt_sigma_rad: float
) -> tuple[EdgeSet, Array]:
    """The edges and the tilt, moved by the shift, turn and tilt (0 +- tilt_sigma_rad) that most points share."""
    half = points.ends[2]
    rho, tangent = kernel.project(points.x, points.y, half, edges.psi_rad, tilt_rad)
    tilt_info = tilt_sigma_rad**-2
    info = np.array([_SHIFT_INFO, _SHIFT_INFO, _TURN_SIGMA_RAD**-2, tilt_info, tilt_info])
    offset_px, psi_rad = edges.offset_px, edges.psi_rad
    found = kernel.align(
        rho, tangent, line, half, offset_px, psi_rad, focal_px, info, _SHIFT_GATES_PX, _SHIFT_LIKELIHOOD
    )
    shift = np.where(edges.axis == 0, found[0], found[1])
    moved = replace(edges, psi_rad=edges.psi_rad + float(found[2]), offset_px=edges.offset_px + shift)
    return moved, tilt_rad + found[3:]


def _enough(seen: Ints, hoped: Array) -> bool:
    """Whether most predicted edges in view are there: points seen and hoped for, (E,) each."""
    in_view = hoped >= _MIN_LOOKS
    there = np.count_nonzero(in_view & (seen >= _SEEN_FRACTION * hoped))
    return bool(there >= max(_FOUND_FRACTION * np.count_nonzero(in_view), _MIN_EDGES))
