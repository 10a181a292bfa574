"""From fitted edges to lines: two sides that lie close together are one groove, and axes get their final names."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ceilvo.config import Features
from ceilvo.daemon.vision import kernel
from ceilvo.daemon.vision.angles import pixels
from ceilvo.daemon.vision.kernel.arguments import Widths
from ceilvo.daemon.vision.line_fit import JointFit
from ceilvo.daemon.vision.tilt_prior import TiltPrior
from ceilvo.types import Array, Ints, Lines

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

    Only where they lie beside each other: the edges of a lamp and of a grille further on may be in lines as near.

    Args:
        fraction: of the edge points there may be, how many were looked at; fewer make a line then.
        free: tilt from this frame alone.
        uniform: the points looked at are uniformly spaced along their lines, not anywhere.

    Returns:
        The lines and the edges under them; None when fewer than two edges have enough points.
    """
    least = max(_SUPPORT_RATIO * fraction * pixels(config.min_line_deg, fit.focal_px), _MIN_SUPPORT)
    widths = Widths(_SAME_LINE_PX, pixels(config.groove_deg, fit.focal_px, BLURRED_PX), _NARROW_PX)
    extents = fit.extents()
    order, new_of_old, axis, offset, sigma, kind, support = kernel.join(
        fit.offset, fit.sigma_px(), fit.line_group, fit.support, *extents, least, widths
    )
    if not len(order):
        return None
    points, point_line = fit.picture(new_of_old)
    psi, turned = fold_direction(fit.psi)
    lines = Lines(
        psi_rad=psi,
        psi_sigma_rad=float(np.sqrt(fit.covariance[0, 0])),
        axis=axis,
        offset_px=offset,
        sigma_px=sigma,
        kind=kind,
        support=support,
        tilt_rad=fit.tilt,
        tilt_sigma_rad=np.sqrt(fit.covariance[[1, 2], [1, 2]]),
        free_tilt_rad=free.mean_rad,
        free_tilt_sigma_rad=free.sigma_rad,
        points=points,
        point_line=point_line,
        fraction=fraction,
        uniform=uniform,
    )
    return turn_axes(lines, turned), _edge_set(fit, order, extents, fraction)


def _edge_set(fit: JointFit, order: Ints, extents: tuple[Array, Array], fraction: float) -> EdgeSet:
    start, end = (v[order] for v in extents)
    rising = fit.line_group[order] % 2 == 1
    coverage = np.minimum(fit.support[order] / (fraction * np.maximum(end - start, 1.0)), 1.0)
    return EdgeSet(fit.psi, fit.axis[order], rising, fit.offset[order], start, end, coverage, fit.noise_px)


def turn_axes(lines: Lines, turned: int) -> Lines:
    """Rename the axes after psi was folded by `turned` quarter turns (clockwise)."""
    if turned % 4 == 0:
        return lines
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
