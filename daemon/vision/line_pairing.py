"""From fitted edges to lines: two sides that lie close together are one groove, and axes get their final names."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ceilvo.config import Features
from ceilvo.daemon.vision.angles import pixels
from ceilvo.daemon.vision.line_fit import JointFit
from ceilvo.daemon.vision.tilt_prior import TiltPrior
from ceilvo.types import Array, Ints, LineKind, Lines

_SAME_LINE_PX = 3.0
"""Edges of one polarity closer than this are one; chosen: a lamp and its frame are often within 2 (docs/bench.md)."""
_SUPPORT_RATIO = 0.5
"""Fewest edge points of an edge, over the votes it took to find it; chosen: the last, narrower gate drops some."""
_MIN_SUPPORT = 4.0
"""Fewest edge points of an edge, however few of a frame were kept; chosen: offset and spread need more than 2."""
BLURRED_PX = 3.0
"""Sides closer than this may be one groove, whatever the angle; chosen: lens and smoothing part the sides by 2."""
_NARROW_PX = 1.0
"""Gaps below this count alike when sides of grooves are chosen; chosen: edge points scatter by up to this."""


@dataclass(frozen=True, slots=True)
class EdgeSet:
    """The edges under the lines of a frame, in a level robot's view: what to look for in the next frame.

    Attributes:
        psi_rad: direction of axis 0's normal.
        axis, rising: (E,) 0 or 1, and whether brightness rises along the normal.
        offset_px: (E,).
        start_px, end_px: (E,) extent along the edge, counted along the normal turned by +90 deg.
        coverage: (E,) fraction of that extent along which it was seen; short edges in one line have gaps.
        noise_px: standard deviation of the points about their edges.
    """

    psi_rad: float
    axis: Ints
    rising: NDArray[np.bool_]
    offset_px: Array
    start_px: Array
    end_px: Array
    coverage: Array
    noise_px: float


def pair_edges(
    fit: JointFit, config: Features, fraction: float, free: TiltPrior, uniform: bool = False
) -> tuple[Lines, EdgeSet] | None:
    """Falling and rising edges that lie close together are the two sides of one groove: keep its centre line.

    Args:
        fraction: of the edge points there may be, how many were looked at; fewer make a line then.
        free: tilt from this frame alone.
        uniform: the points looked at are uniformly spaced along their lines, not anywhere.

    Returns:
        The lines and the edges under them; None when fewer than two edges have enough points.
    """
    need = _SUPPORT_RATIO * fraction * pixels(config.min_line_deg, fit.focal_px)
    keep = np.flatnonzero(fit.support >= max(need, _MIN_SUPPORT))
    if len(keep) < 2:
        return None
    order = keep[np.lexsort((fit.offset[keep], fit.axis[keep]))]
    order = order[_distinct(fit, order)]
    offset, group = fit.offset[order], fit.line_group[order]
    axis, own = group // 2, np.arange(len(order))
    support = fit.support[order]
    partner = _pairs(offset, axis, group % 2, support, pixels(config.groove_deg, fit.focal_px, BLURRED_PX))
    paired = partner >= 0
    other = np.where(paired, partner, own)
    first = other >= own  # one entry a pair
    new_of_old = np.full(len(fit.offset), -1, np.int64)
    index = np.cumsum(first) - 1
    new_of_old[order] = index[np.minimum(other, own)]
    edge_kind = np.where(group % 2 == 1, LineKind.RISING, LineKind.FALLING)
    sigma = fit.sigma_px()[order]
    joined = np.where(paired, 0.5 * (offset + offset[other]), offset)
    joined_sigma = np.where(paired, 0.5 * np.hypot(sigma, sigma[other]), sigma)
    points, point_line = fit.uv(), new_of_old[fit.line]
    if len(order) < len(new_of_old):
        used = point_line >= 0
        points, point_line = points[used], point_line[used]
    psi, turned = fold_direction(fit.psi)
    lines = Lines(
        psi_rad=psi,
        psi_sigma_rad=float(np.sqrt(fit.covariance[0, 0])),
        axis=axis[first],
        offset_px=joined[first],
        sigma_px=joined_sigma[first],
        kind=np.where(paired, LineKind.GROOVE, edge_kind)[first].astype(np.int64),
        support=np.where(paired, support + support[other], support)[first],
        tilt_rad=fit.tilt,
        tilt_sigma_rad=np.sqrt(np.diag(fit.covariance)[1:]),
        free_tilt_rad=free.mean_rad,
        free_tilt_sigma_rad=free.sigma_rad,
        points=points,
        point_line=point_line,
        fraction=fraction,
        uniform=uniform,
    )
    return turn_axes(lines, turned), _edge_set(fit, order, fraction)


def _edge_set(fit: JointFit, order: Ints, fraction: float) -> EdgeSet:
    start, end = (v[order] for v in fit.extents())
    rising = fit.line_group[order] % 2 == 1
    coverage = np.minimum(fit.support[order] / (fraction * np.maximum(end - start, 1.0)), 1.0)
    return EdgeSet(fit.psi, fit.axis[order], rising, fit.offset[order], start, end, coverage, fit.noise_px)


def _distinct(fit: JointFit, order: Ints) -> NDArray[np.bool_]:
    """False for an edge close to a stronger one of its own axis and polarity.

    Args:
        order: edges by axis and offset.
    """
    good = np.ones(len(order), bool)
    for g in range(4):
        ids = np.flatnonzero(fit.line_group[order] == g)
        close = np.flatnonzero(np.diff(fit.offset[order[ids]]) < _SAME_LINE_PX)
        for k in close:
            a, b = ids[k], ids[k + 1]
            good[a if fit.support[order[a]] < fit.support[order[b]] else b] = False
    return good


def _pairs(offset: Array, axis: Ints, rising: Ints, support: Ints, groove_px: float) -> Ints:
    """Index of every line's partner, or -1: neighbours of opposite polarity, narrow and well supported pairs first.

    Where three edges could pair in two ways, the gap alone must not decide: where both are alike it would flip from
    frame to frame, and the line would jump.
    """
    partner = np.full(len(offset), -1, np.int64)
    gap = np.diff(offset)
    fits = (np.diff(axis) == 0) & (np.diff(rising) != 0) & (gap < groove_px)
    score = np.minimum(support[1:], support[:-1]) / np.maximum(gap, _NARROW_PX)
    for k in np.argsort(-score, kind="stable"):
        if fits[k] and partner[k] < 0 and partner[k + 1] < 0:
            partner[k], partner[k + 1] = k + 1, k
    return partner


def turn_axes(lines: Lines, turned: int) -> Lines:
    """Rename the axes after psi was folded by `turned` quarter turns (clockwise)."""
    axis, offset, kind = lines.axis, lines.offset_px, lines.kind
    for _ in range(turned % 4):
        # psi was taken a quarter turn back: old axis 0 is new axis 1, old axis 1 is new axis 0 reversed
        sign = np.where(axis == 1, -1, 1)
        axis, offset, kind = 1 - axis, offset * sign, kind * sign
    return replace(lines, axis=axis, offset_px=offset, kind=kind)


def fold_direction(psi: float) -> tuple[float, int]:
    """psi in [-pi/4, pi/4) and the quarter turns taken off it."""
    turns = int(np.floor((psi + 0.25 * np.pi) / (0.5 * np.pi)))
    return psi - turns * 0.5 * np.pi, turns
