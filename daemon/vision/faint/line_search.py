"""Faint lines of one frame: votes along two perpendicular directions, then the joint least squares of their places."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ceilvo.config import Features
from ceilvo.daemon.vision.angles import pixels
from ceilvo.daemon.vision.edge_points import Points
from ceilvo.daemon.vision.faint.level_picture import Aligned, LevelPicture, rays_from_aligned
from ceilvo.daemon.vision.faint.voting import RADIUS_PX, STRETCH_PX, Answers, Peaks, answers, peaks
from ceilvo.daemon.vision.line_fit import JointFit
from ceilvo.daemon.vision.tilt_prior import NOTHING_LATELY, Lately, TiltPrior, rocks
from ceilvo.types import Array, Ints, LineKind, Lines

Array32 = NDArray[np.float32]

LEAST_VOTES = 5.0
"""Standard deviations of a line's votes; chosen: 0 false lines in 80 pictures without any (docs/bench.md)."""
_SEEN_SIGMAS, _MAYBE_SIGMAS = 2.5, 1.2
"""Answer of a stretch in which a line is seen, in standard deviations, and of those beside it; chosen as Canny does: a
line goes on through what alone would say nothing."""
_LENGTHS, _PART = 4.0, 0.45
"""A line is seen along so many times the length that edges need, and along this part of where it could be seen; chosen:
what lamps and vents leave of themselves around them is shorter, joints are longer."""
_TOGETHER = 3
"""Neighbouring stretches that are judged as one; chosen: an eighth of a tile's side."""
_REACH_PX = (4, 2)
"""Where a stretch's answer is looked for beside its line, in the first round and once direction and tilt are known."""
_GATE_PX = (3.0, 1.5)
"""Distance of a stretch from its line in the fit's rounds; chosen: the reach, less what noise does to the highest."""
_AGAIN_PX = 0.5
"""A direction or tilt that was off by so much at the rim is tried again from where the fit ended; chosen."""
_ROUNDS = 3
"""Votes and fit, at most; chosen: the second is right but for tilts of several degrees."""


@dataclass(frozen=True, slots=True)
class _Seen:
    """Stretches in which lines were seen: across and along the axes of an aligned picture, px from its origin.

    Attributes:
        line, axis: (K,) which of the lines (L,) a stretch is of, and along which axis' normal it lies.
        across, along: (K,) px.
        kind, dark: (L,) of the lines; line_axis: (L,).
    """

    line: Ints
    across: Array
    along: Array
    line_axis: Ints
    kind: Ints


def find_faint(
    picture: LevelPicture,
    level: NDArray[np.uint8],
    usable: NDArray[np.uint8],
    psi_rad: float,
    tilt_rad: Array,
    config: Features,
    prior: TiltPrior | None,
    known_rad: float | None = None,
    lately: Lately = NOTHING_LATELY,
) -> Lines | None:
    """Lines along a direction and across it, None when fewer than two are seen.

    Args:
        level, usable: as LevelPicture gives them.
        psi_rad, tilt_rad: where to begin; the Lines have what was found, psi unfolded.
        prior: of the tilt.
        known_rad: to what the tilt is known there, where it and the direction are to a fraction of a pixel at the rim.
        lately: tilts, by which one that is held is known.
    """
    fit, usual_rad = None, lately.usual_rad(tilt_rad)
    for k in range(0 if known_rad is None else 1, _ROUNDS):
        turned = picture.aligned(level, usable, psi_rad, tilt_rad)
        seen = _seen(turned, picture.focal_px, config, _REACH_PX[min(k, 1)])
        if len(seen.line_axis) < 2:
            return None
        fit = _fitted(seen, turned, picture.focal_px, config, _GATE_PX[min(k, 1)], tilt=k > 0)
        free = fit.finish(pieces=False, rocking=rocks(prior))
        # as for edge points: no tilt is read from so little
        if config.estimate_tilt and fit.is_vague(free, prior, usual_rad):
            held_rad = max(fit.held_rad(free, lately), known_rad or 0.0)
            fit = _fitted(seen, turned, picture.focal_px, config, _GATE_PX[min(k, 1)], tilt=False)
            fit.finish_held(pieces=False, held_rad=held_rad)
        if prior is not None and config.estimate_tilt:
            fit.apply_prior(prior)
        off = abs(fit.psi - psi_rad) + float(np.max(np.abs(fit.tilt - tilt_rad)))
        psi_rad, tilt_rad = fit.psi, fit.tilt
        if k > 0 and 0.5 * off * max(level.shape) < _AGAIN_PX:
            break
    assert fit is not None
    return _lines(fit, seen, free)


def _seen(turned: Aligned, focal_px: float, config: Features, reach_px: int) -> _Seen:
    apart_px = pixels(config.groove_deg, focal_px, RADIUS_PX)
    parts = []
    first = 0
    for axis in (0, 1):
        found = answers(turned, axis)
        which = peaks(found, LEAST_VOTES, apart_px)
        line, across, along = _stretches(found, which, reach_px)
        shortest = _LENGTHS * pixels(config.min_line_deg, focal_px) / STRETCH_PX
        keep = np.bincount(line, minlength=len(which.at)) >= np.maximum(
            shortest, _PART * found.known.sum(axis=0)[which.at]
        )
        new = np.cumsum(keep) - 1
        mine = keep[line]
        origin = turned.origin_px if axis == 0 else turned.origin_px[::-1]
        parts.append((first + new[line[mine]], across[mine] - origin[0], along[mine] - origin[1], which.kind[keep]))
        first += int(np.count_nonzero(keep))
    axis_of = np.repeat([0, 1], [len(p[3]) for p in parts])
    line, across, along, kind = (np.concatenate([p[i] for p in parts]) for i in range(4))
    return _Seen(line, across, along, axis_of, kind)


def _stretches(found: Answers, which: Peaks, reach_px: int) -> tuple[Ints, Array, Array]:
    """Of every line the stretches that show it: the line, and where they are across and along it, px."""
    lines, across, along = [], [], []
    n = found.ridge.shape[1]
    for k, (at, kind, dark) in enumerate(zip(which.at, which.kind, which.dark, strict=True)):
        low, high = max(at - reach_px - 1, 0), min(at + reach_px + 2, n)
        part = found.ridge[:, low:high] if kind == LineKind.GROOVE else found.edge[:, low:high]
        part = part if (dark or kind == LineKind.RISING) else -part
        part = cv2.blur(part, (1, _TOGETHER), borderType=cv2.BORDER_CONSTANT) * np.float32(np.sqrt(_TOGETHER))
        inner = part[:, 1:-1]
        best = np.argmax(inner, axis=1) + 1
        row = np.arange(len(part))
        left, top, right = (part[row, best + d] for d in (-1, 0, 1))
        good = _runs((top >= _MAYBE_SIGMAS) & (top > left) & (top > right), top >= _SEEN_SIGMAS)
        bend = np.where(good, left - 2.0 * top + right, -1.0)
        place = low + best + 0.5 * (left - right) / bend
        at_rows = np.flatnonzero(good)
        lines.append(np.full(len(at_rows), k))
        across.append(place[at_rows])
        along.append((at_rows + 0.5) * STRETCH_PX - 0.5)
    if not lines:
        none = np.zeros(0)
        return np.zeros(0, np.int64), none, none
    return np.concatenate(lines), np.concatenate(across), np.concatenate(along)


def _runs(maybe: NDArray[np.bool_], sure: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """(S,) those of the maybe that a row of others joins to a sure one."""
    run = np.cumsum(np.diff(maybe, prepend=False))
    found = np.bincount(run, maybe & sure, len(maybe) + 1) > 0
    return np.asarray(maybe & found[run])


def _fitted(seen: _Seen, turned: Aligned, focal_px: float, config: Features, gate_px: float, tilt: bool) -> JointFit:
    """The joint least squares of lines.JointFit on stretches in place of edge points; its last round is to come."""
    axis = seen.line_axis[seen.line]
    order = np.argsort(axis, kind="stable")
    line, axis = seen.line[order], axis[order]
    first = np.where(axis == 0, seen.across[order], seen.along[order]) / focal_px
    second = np.where(axis == 0, seen.along[order], seen.across[order]) / focal_px
    rays = rays_from_aligned(turned.psi_rad, turned.tilt_rad) @ np.stack([first, second, np.ones(len(first))])
    half = int(np.count_nonzero(axis == 0))
    x, y = (np.asarray(v / rays[2], np.float32) for v in rays[:2])
    points = Points(x, y, (0, half, half, len(line), len(line)), float(np.hypot(x, y).max(initial=0.0)))
    count = np.maximum(np.bincount(seen.line, minlength=len(seen.line_axis)), 1)
    offset = np.array([np.median(seen.across[seen.line == k]) for k in range(len(count))])
    mine = [offset[seen.line_axis == a] for a in (0, 1)]
    none = np.zeros(0)
    fit = JointFit(
        points, turned.psi_rad, [mine[0], none, mine[1], none], focal_px, config, 1.0 / STRETCH_PX, turned.tilt_rad
    )
    fit.start(line.astype(np.int32), offset)
    for _ in range(2):
        fit.assign(gate_px)
        fit.solve(tilt)
    return fit


def _lines(fit: JointFit, seen: _Seen, free: TiltPrior) -> Lines | None:
    keep = np.flatnonzero(fit.support >= 2)
    if len(keep) < 2:
        return None
    new = np.full(len(fit.offset), -1)
    new[keep] = np.arange(len(keep))
    uv, number = fit.picture(new)
    spread = np.arange(STRETCH_PX) - 0.5 * (STRETCH_PX - 1)
    angle = fit.psi + 0.5 * np.pi * seen.line_axis[keep[number]]
    tangent = np.column_stack([-np.sin(angle), np.cos(angle)])
    points = (uv[:, None, :] + spread[None, :, None] * tangent[:, None, :]).reshape(-1, 2)
    return Lines(
        psi_rad=fit.psi,
        psi_sigma_rad=float(np.sqrt(fit.covariance[0, 0])),
        axis=seen.line_axis[keep],
        offset_px=fit.offset[keep],
        sigma_px=fit.sigma_px()[keep],
        kind=seen.kind[keep],
        support=fit.support[keep] * STRETCH_PX,
        tilt_rad=fit.tilt,
        tilt_sigma_rad=np.sqrt(np.diag(fit.covariance)[1:]),
        free_tilt_rad=free.mean_rad,
        free_tilt_sigma_rad=free.sigma_rad,
        points=points.astype(np.float32),
        point_line=np.repeat(number, STRETCH_PX),
    )
