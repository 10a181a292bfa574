"""The normal equations of a survey, block by block, about the present estimate."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ceilvo.daemon.refinement.calibration_field import UNKNOWNS, CalibrationField
from ceilvo.daemon.refinement.straightness import Rows
from ceilvo.daemon.refinement.survey import Anchors, Survey
from ceilvo.se2 import wrap_array
from ceilvo.types import NO_DIRECTION_RAD, Array, Ints

_OWN = len(UNKNOWNS)
"""Unknowns of each calibration. They, and the direction of the ceiling of each floor, are what all else depends on: the
border."""
_HEIGHT, _FOCAL = UNKNOWNS.index("height"), UNKNOWNS.index("focal")
"""Features scatter by so much in the picture, so in metres with the height, and less with the focal length. Were it so
much in metres whatever these are, the smallest map would fit best."""
ROBUST = 3.0
"""Cauchy's scale, standard deviations: beyond it a residual counts less; 1 in 90 of normal noise of two dimensions."""
_DIRECTION_FLOOR_RAD = np.radians(0.05)
"""Least standard deviation of a direction; chosen: halls are built square to some mm in ten metres."""
_QUARTER = 0.5 * np.pi


@dataclass(frozen=True)
class Estimate:
    """Poses (K, 3), landmarks (L, 2), correction (C, 5) of the calibrations, direction (F,) of each floor's ceiling."""

    pose: Array
    xy_m: Array
    correction: Array
    axis_rad: Array


@dataclass
class Equations:
    """H x = -g by blocks. p: poses, l: landmarks, b: border, B = 5 C + F.

    Attributes:
        cost: the robust sum of squares at the estimate.
        weight: (O,) of the features, 1 where they fit.
        pp, pb, p: (K, 3, 3), (K, 3, B), (K, 3).
        ll, lb, l: (L, 2, 2), (L, 2, B), (L, 2).
        bb, b: (B, B), (B,).
        lp: (O, 2, 3) of a feature's landmark and pose.
        links: (J,) poses k whose motion from k - 1 counts.
        link: (J, 6, 6) of the two poses, and link_g (J, 6); not in pp and p.
        pairs: (T, 2) landmarks that depend on each other directly, pair (T, 4, 4); not in ll.
    """

    cost: float
    weight: Array
    pp: Array
    pb: Array
    p: Array
    ll: Array
    lb: Array
    l: Array  # noqa: E741
    bb: Array
    b: Array
    lp: Array
    links: Ints
    link: Array
    pairs: Ints
    pair: Array


@dataclass(frozen=True)
class Terms:
    """What stays the same from round to round.

    Attributes:
        fields: (C,) one for each calibration; those of the survey's features that it placed, in their order.
        prior_sigma: (C, 5) of the calibrations.
        links: (J,) poses k that are tied to k - 1 by motion.
        held: indices of poses that hold the map where it is.
        robust: Cauchy's scale; wide to begin with, where the map is bent by more than features scatter.
    """

    survey: Survey
    fields: tuple[CalibrationField, ...]
    rows: Rows
    anchors: Anchors
    prior_sigma: Array
    links: Ints
    held: Ints
    robust: float = ROBUST


HELD_SIGMA = np.array([1e-4, 1e-4, 1e-5])
"""Of a pose that holds the map where it is: m, m, rad; as good as fixed."""
_LOOSE_SIGMA = np.array([100.0, 100.0, 10.0])
"""Of every pose, so that a view that shows nothing does not leave the equations singular."""


def linearised(terms: Terms, at: Estimate) -> Equations:
    """The equations about an estimate."""
    s, k, n = terms.survey, len(at.pose), len(at.xy_m)
    eyes, size = len(at.correction), _OWN * len(at.correction) + len(at.axis_rad)
    cos, sin = np.cos(at.pose[s.view, 2]), np.sin(at.pose[s.view, 2])
    off = at.xy_m[s.landmark] - at.pose[s.view, :2]
    in_base = np.column_stack([cos * off[:, 0] + sin * off[:, 1], cos * off[:, 1] - sin * off[:, 0]])
    placed, j_b, w = _seen(terms, at)
    back = np.stack([np.column_stack([cos, sin]), np.column_stack([-sin, cos])], axis=1)  # base_from_map
    residual = _times(w, placed - in_base)
    square = np.sum(residual**2, axis=1)
    weight, cost = _robust(square, terms.robust)
    root = np.sqrt(weight)[:, None, None]
    j_l = -(w @ back) * root
    j_p = np.concatenate([-j_l, -_times(w, np.column_stack([in_base[:, 1], -in_base[:, 0]]))[..., None] * root], axis=2)
    j_b[..., _HEIGHT] -= residual
    j_b[..., _FOCAL] += residual
    j_b *= root
    r = residual[..., None] * root
    by_pose, by_landmark = _Sums(s.view, k), _Sums(s.landmark, n)
    t_p, t_l = j_p.transpose(0, 2, 1), j_l.transpose(0, 2, 1)
    pb = np.zeros((k, 3, size))
    own = _OWN * s.eye[:, None] + np.arange(_OWN)
    np.put_along_axis(pb, np.broadcast_to(own[:, None], (k, 3, _OWN)), by_pose(t_p @ j_b), axis=2)
    by_eye = _Sums(eyes * s.landmark + s.eye[s.view], eyes * n)(t_l @ j_b).reshape(n, eyes, 2, _OWN)
    lb = np.concatenate([by_eye.transpose(0, 2, 1, 3).reshape(n, 2, -1), np.zeros((n, 2, size - eyes * _OWN))], axis=2)
    e = Equations(
        cost=cost,
        weight=weight,
        pp=by_pose(t_p @ j_p) + np.diag(_LOOSE_SIGMA**-2),
        pb=pb,
        p=by_pose(t_p @ r)[..., 0],
        ll=by_landmark(t_l @ j_l),
        lb=lb,
        l=by_landmark(t_l @ r)[..., 0],
        bb=np.zeros((size, size)),
        b=np.zeros(size),
        lp=t_l @ j_p,
        links=terms.links,
        link=np.zeros((0, 6, 6)),
        pairs=np.zeros((0, 2), np.int64),
        pair=np.zeros((0, 4, 4)),
    )
    for eye, which in enumerate(_of_eyes(s, eyes)):
        j, at_ = j_b[which].reshape(-1, _OWN), slice(_OWN * eye, _OWN * (eye + 1))
        e.bb[at_, at_], e.b[at_] = j.T @ j, j.T @ r[which].ravel()
    _add_calibration(e, terms, at)
    _add_held(e, terms, at)
    _add_directions(e, terms, at)
    _add_links(e, terms, at)
    _add_pairs(e, terms, at)
    return e


def _of_eyes(s: Survey, eyes: int) -> list[Any]:
    """The features that each calibration placed: what an array of them is indexed with."""
    if eyes == 1:
        return [slice(None)]
    eye = s.eye[s.view]
    return [np.flatnonzero(eye == c) for c in range(eyes)]


def _seen(terms: Terms, at: Estimate) -> tuple[Array, Array, Array]:
    """(O, 2) where the features are by the corrected calibrations, (O, 2, 5) how that grows with the correction of
    their own, and (O, 2, 2) the square root of their information."""
    s, eyes = terms.survey, len(at.correction)
    placed, by_own, w = np.empty_like(s.seen_m), np.empty((*s.seen_m.shape, _OWN)), np.empty_like(s.root_info)
    for which, field, correction in zip(_of_eyes(s, eyes), terms.fields, at.correction, strict=True):
        placed[which], by_own[which] = field.at(correction)
        w[which] = s.root_info[which] * np.exp(correction[_FOCAL] - correction[_HEIGHT])
    return placed, w @ by_own, w


def _times(matrices: Array, vectors: Array) -> Array:
    return np.asarray(np.einsum("oij,oj->oi", matrices, vectors))


class _Sums:
    """Sums of blocks by index."""

    def __init__(self, index: Ints, count: int) -> None:
        self._order = None if np.all(np.diff(index) >= 0) else np.argsort(index, kind="stable")
        ordered = index if self._order is None else index[self._order]
        self._at = np.flatnonzero(np.diff(ordered, prepend=-1))
        self._which, self._count = ordered[self._at], count

    def __call__(self, blocks: Array) -> Array:
        out = np.zeros((self._count, *blocks.shape[1:]))
        if len(self._at):
            out[self._which] = np.add.reduceat(blocks if self._order is None else blocks[self._order], self._at)
        return out


def _robust(square: Array, scale: float) -> tuple[Array, float]:
    """Cauchy's weights of squared residuals (N,), in standard deviations, and their cost."""
    return 1.0 / (1.0 + square / scale**2), float(scale**2 * np.sum(np.log1p(square / scale**2)))


def _add_calibration(e: Equations, terms: Terms, at: Estimate) -> None:
    info, off = terms.prior_sigma.ravel() ** -2, at.correction.ravel()
    whole = np.append(info, np.full(len(at.axis_rad), 1e-6))
    e.bb += np.diag(whole)
    e.b[: len(off)] += info * off
    e.cost += float(np.sum(info * off**2))


def _add_held(e: Equations, terms: Terms, at: Estimate) -> None:
    for k in terms.held:
        off = (at.pose[k] - terms.survey.pose[k]) / HELD_SIGMA
        e.pp[k] += np.diag(HELD_SIGMA**-2)
        e.p[k] += off / HELD_SIGMA
        e.cost += float(off @ off)


def _add_directions(e: Equations, terms: Terms, at: Estimate) -> None:
    """The lines of a floor's ceiling have one direction; a hall that is built at another counts for nothing."""
    s = terms.survey
    told = np.flatnonzero(s.direction_sigma_rad < NO_DIRECTION_RAD)
    sigma = np.hypot(s.direction_sigma_rad[told], _DIRECTION_FLOOR_RAD)
    axis = at.correction.size + s.floor[told]
    angle = 4.0 * (at.pose[told, 2] + s.direction_rad[told] - at.axis_rad[s.floor[told]])
    off = 0.25 * wrap_array(angle) / sigma
    weight, cost = _robust(off**2, terms.robust)
    info = weight / sigma**2
    e.pp[told, 2, 2] += info
    e.p[told, 2] += info * sigma * off
    e.pb[told, 2, axis] -= info
    np.add.at(e.bb, (axis, axis), info)
    np.add.at(e.b, axis, -info * sigma * off)
    e.cost += cost


def _add_links(e: Equations, terms: Terms, at: Estimate) -> None:
    s, k = terms.survey, terms.links
    before, after = at.pose[k - 1], at.pose[k]
    cos, sin = np.cos(before[:, 2]), np.sin(before[:, 2])
    d = after[:, :2] - before[:, :2]
    driven = np.column_stack([cos * d[:, 0] + sin * d[:, 1], cos * d[:, 1] - sin * d[:, 0]])
    turned = wrap_array(after[:, 2] - before[:, 2] - s.motion[k, 2])
    off = np.column_stack([driven - s.motion[k, :2], turned])
    j = np.zeros((len(k), 3, 6))
    j[:, 0, 0], j[:, 0, 1], j[:, 1, 0], j[:, 1, 1] = -cos, -sin, sin, -cos
    j[:, 0, 3], j[:, 0, 4], j[:, 1, 3], j[:, 1, 4] = cos, sin, -sin, cos
    j[:, 0, 2], j[:, 1, 2] = driven[:, 1], -driven[:, 0]
    j[:, 2, 2], j[:, 2, 5] = -1.0, 1.0
    root = (
        np.linalg.inv(np.linalg.cholesky(s.motion_cov[k] + np.diag(HELD_SIGMA**2))) if len(k) else np.zeros((0, 3, 3))
    )
    r = _times(root, off)
    weight, cost = _robust(np.sum(r**2, axis=1), terms.robust)
    j = root @ j * np.sqrt(weight)[:, None, None]
    e.link = j.transpose(0, 2, 1) @ j
    gradient = _times(j.transpose(0, 2, 1), r * np.sqrt(weight)[:, None])
    np.add.at(e.p, k - 1, gradient[:, :3])
    np.add.at(e.p, k, gradient[:, 3:])
    e.cost += cost


def _add_pairs(e: Equations, terms: Terms, at: Estimate) -> None:
    """Rows of landmarks that are straight, tapes between two, and marks."""
    rows, anchors = terms.rows, terms.anchors
    floor = terms.survey.landmark_floor[rows.pair[:, 0]]
    angle = at.axis_rad[floor] + _QUARTER * rows.axis
    normal = np.column_stack([np.cos(angle), np.sin(angle)])
    along = np.column_stack([-np.sin(angle), np.cos(angle)])
    apart = at.xy_m[rows.pair[:, 0]] - at.xy_m[rows.pair[:, 1]]
    sigma_m = rows.sigma_m * np.exp(np.mean(at.correction[:, _HEIGHT]))
    off = np.sum(normal * apart, axis=1) / sigma_m
    weight, cost = _robust(off**2, terms.robust)
    e.cost += cost
    by_border = np.zeros((len(off), len(e.b)))
    by_border[np.arange(len(off)), at.correction.size + floor] = np.sum(along * apart, axis=1) / sigma_m
    by_border[:, _HEIGHT : at.correction.size : _OWN] = -off[:, None] / len(at.correction)
    _add_pair(e, rows.pair, normal / sigma_m[:, None], off, weight, by_border)
    apart = at.xy_m[anchors.between[:, 0]] - at.xy_m[anchors.between[:, 1]]
    length = np.hypot(*apart.T)
    off = (length - anchors.distance_m) / anchors.distance_sigma_m
    weight, cost = _robust(off**2, terms.robust)
    e.cost += cost
    unit = apart / np.maximum(length, 1e-9)[:, None] / anchors.distance_sigma_m[:, None]
    _add_pair(e, anchors.between, unit, off, weight, np.zeros((len(off), len(e.b))))
    marked = (at.xy_m[anchors.mark] - anchors.mark_xy_m) / anchors.mark_sigma_m[:, None]
    np.add.at(e.ll, anchors.mark, anchors.mark_sigma_m[:, None, None] ** -2 * np.eye(2))
    np.add.at(e.l, anchors.mark, marked / anchors.mark_sigma_m[:, None])
    e.cost += float(np.sum(marked**2))


def _add_pair(e: Equations, pair: Ints, by_first: Array, off: Array, weight: Array, by_border: Array) -> None:
    """Residuals off (T,) that grow by_first (T, 2) with the first landmark, shrink with the second, and by_border."""
    root = np.sqrt(weight)[:, None]
    j, r, b = np.concatenate([by_first, -by_first], axis=1) * root, off * root[:, 0], by_border * root
    e.pairs = np.concatenate([e.pairs, pair])
    e.pair = np.concatenate([e.pair, j[:, :, None] * j[:, None, :]])
    for side in (0, 1):
        part = j[:, 2 * side : 2 * side + 2]
        np.add.at(e.l, pair[:, side], part * r[:, None])
        np.add.at(e.lb, pair[:, side], part[:, :, None] * b[:, None, :])
    e.bb += b.T @ b
    e.b += b.T @ r


def moved(at: Estimate, poses: Array, landmarks: Array, border: Array) -> Estimate:
    """The estimate after a step."""
    pose = at.pose + poses
    pose[:, 2] = wrap_array(pose[:, 2])
    correction, axes = np.split(border, [at.correction.size])
    return Estimate(
        pose, at.xy_m + landmarks, at.correction + correction.reshape(at.correction.shape), at.axis_rad + axes
    )
