"""Least squares with parameters shared by all views and parameters of each view (bundle adjustment, Schur form)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from ceilvo.robust import MAD_TO_SIGMA

Array = NDArray[np.float64]
Residuals = Callable[[int, Array, Array], Array]
"""(view, shared parameters, the view's parameters) -> (N,) residuals in units of their noise or in px."""

_ROUNDS = 60
"""Steps at the most; chosen: a fit that goes on so long does not converge."""
_MANY_VIEWS = 8
"""Views from which their scatter alone says how large sigma is; chosen, below it chance may understate it."""
_STEP = 1e-6
"""Relative step of central differences: near the cube root of double precision, where their error is least."""
_RESCALES = 10
"""Times that the robust scale is found anew; chosen."""
_LEAST_LEFT = 1e-3
"""Of a view without which the rest says nothing: its score is not blown up beyond a thousandfold."""
_SETTLED = 0.8
"""Of the scale before: one that shrank by less is the robust scale; chosen."""
_DAMPING, _DAMPING_LEAST = 1e-4, 1e-12
_DAMPING_UP, _DAMPING_DOWN = 8.0, 10.0
_TRIES = 12
"""Levenberg-Marquardt: damping at first and at least, its factors after a step that failed or went well (about
Marquardt's ten), and steps tried before it gives up: damping has then grown 1e10 times."""
_GAIN_LEAST, _COST_LEAST = 1e-14, 1e-24
"""Relative gain, and cost in squares of the residuals' unit, at which nothing but rounding is left."""
_NEAR_ZERO, _STEP_NEAR_ZERO = 1e-3, 0.1
"""A parameter below this is differentiated with steps of a tenth: distortion and angles are small, pixels are not."""
_SCALE_LEAST = 1e-9
"""Of residuals without noise, so that they do not all count as outliers."""
_TINY = 1e-300
"""Keeps a division by zero away."""
_DIAGONAL_LEAST = 1e-12
"""Keeps damping alive for a parameter that nothing depends on."""
_RANK = 1e-12
"""Eigenvalue over the largest below which a view says nothing in that direction."""


@dataclass(frozen=True)
class BundleFit:
    """What came out.

    Attributes:
        shared: (P,) parameters of all views.
        views: (V, Q) parameters of each view.
        cov: (P, P) of shared, from the residuals' own scatter, each residual independent.
        cluster_cov: (P, P) the same with residuals independent between views only.
        residuals: of each view, not weighted.
        rms: of all residuals that count, with their degrees of freedom.
    """

    shared: Array
    views: Array
    cov: Array
    cluster_cov: Array
    residuals: tuple[Array, ...]
    rms: float


def solve(
    residuals: Residuals,
    shared: Array,
    views: Array,
    *,
    prior_info: Array | None = None,
    huber: float | None = None,
    rounds: int = _ROUNDS,
) -> BundleFit:
    """Levenberg-Marquardt from a start.

    Args:
        prior_info: (P, P) information about the start values of shared, in units of residuals^-2.
        huber: residuals beyond this many robust standard deviations count linearly.
    """
    start = np.asarray(shared, np.float64)
    x, v = start.copy(), np.array(views, np.float64)
    info = np.zeros((len(x), len(x))) if prior_info is None else prior_info
    scale = _scale(residuals, x, v, huber)
    for _ in range(1 if huber is None else _RESCALES):
        x, v = _descend(residuals, x, v, scale, (start, info), rounds)
        before, scale = scale, _scale(residuals, x, v, huber)
        if scale > _SETTLED * before:
            break
    return _finish(residuals, x, v, scale, info)


def _descend(
    residuals: Residuals, x: Array, v: Array, scale: float, prior: tuple[Array, Array], rounds: int
) -> tuple[Array, Array]:
    """Down to a minimum with the scale held, so that the cost is one; prior is start and information."""
    start, info = prior

    def cost_of(p: Array, q: Array) -> float:
        return _cost(residuals, p, q, scale) + float((p - start) @ info @ (p - start))

    damping, cost = _DAMPING, cost_of(x, v)
    for _ in range(rounds):
        blocks = _blocks(residuals, x, v, scale)
        improved, trial = False, cost
        for _ in range(_TRIES):
            dx, dv = _step(blocks, info, x - start, damping)
            trial = cost_of(x + dx, v + dv)
            if np.isfinite(trial) and trial <= cost:
                improved = True
                break
            damping *= _DAMPING_UP
        if not improved:
            break
        gain, cost = cost - trial, trial
        x, v, damping = x + dx, v + dv, max(damping / _DAMPING_DOWN, _DAMPING_LEAST)
        if gain <= _GAIN_LEAST * max(cost, _TINY) or cost < _COST_LEAST:
            break
    return x, v


def _scale(residuals: Residuals, x: Array, v: Array, huber: float | None) -> float:
    """Where residuals begin to count linearly, infinite without huber."""
    if huber is None:
        return np.inf
    every = np.concatenate([residuals(i, x, v[i]) for i in range(len(v))])
    return huber * max(MAD_TO_SIGMA * float(np.median(np.abs(every))), _SCALE_LEAST)


def _cost(residuals: Residuals, x: Array, v: Array, scale: float) -> float:
    total = 0.0
    for i in range(len(v)):
        r = np.abs(residuals(i, x, v[i]))
        total += float(
            np.sum(np.where(r <= scale, r * r, 2.0 * scale * r - scale * scale if np.isfinite(scale) else 0))
        )
    return total


def response(residuals: Callable[[Array], Residuals], given: Array, shared: Array, views: Array) -> tuple[Array, Array]:
    """How a solution moves with parameters (K,) that were given and not fitted, to first order.

    Args:
        residuals: of the given parameters.

    Returns:
        (P, K) of shared and (V, Q, K) of the views' own.
    """
    at, p = residuals(given), len(shared)
    s, g = np.zeros((p, p)), np.zeros((p, len(given)))
    own = []
    for i in range(len(views)):
        a = _jacobian(partial(_vary_shared, at, i, views[i]), shared)
        b = _jacobian(partial(at, i, shared), views[i])
        c = _jacobian(partial(_vary_given, residuals, i, shared, views[i]), given)
        pull = np.linalg.pinv(b)
        s += a.T @ (a - b @ (pull @ a))
        g += a.T @ (c - b @ (pull @ c))
        own.append((pull, a, c))
    dx = -np.linalg.pinv(s, hermitian=True) @ g if p else g
    dv = [-pull @ (c + a @ dx) for pull, a, c in own]
    return dx, np.array(dv).reshape(len(views), -1, len(given))


def _vary_given(residuals: Callable[[Array], Residuals], view: int, shared: Array, own: Array, given: Array) -> Array:
    return residuals(given)(view, shared, own)


_Block = tuple[Array, Array, Array, Array, Array]


def _blocks(residuals: Residuals, x: Array, v: Array, scale: float) -> list[_Block]:
    """For each view: shared and own normal matrices, coupling, and gradients."""
    out = []
    for i in range(len(v)):
        r = residuals(i, x, v[i])
        a = _jacobian(partial(_vary_shared, residuals, i, v[i]), x)
        b = _jacobian(partial(residuals, i, x), v[i])
        w = np.minimum(1.0, scale / np.maximum(np.abs(r), _TINY))
        aw, bw = a * w[:, None], b * w[:, None]
        out.append((aw.T @ a, bw.T @ b, aw.T @ b, aw.T @ r, bw.T @ r))
    return out


def _vary_shared(residuals: Residuals, view: int, own: Array, shared: Array) -> Array:
    return residuals(view, shared, own)


def _jacobian(f: Callable[[Array], Array], p: Array) -> Array:
    """Central differences."""
    columns = []
    for k in range(len(p)):
        h = _STEP * max(abs(p[k]), 1.0 if abs(p[k]) > _NEAR_ZERO else _STEP_NEAR_ZERO)
        up, down = p.copy(), p.copy()
        up[k] += h
        down[k] -= h
        columns.append((f(up) - f(down)) / (2.0 * h))
    return np.column_stack(columns) if columns else np.zeros((len(f(p)), 0))


def _step(blocks: list[_Block], info: Array, off: Array, damping: float) -> tuple[Array, Array]:
    p = len(info)
    s = info.copy()
    g = info @ off
    s[np.diag_indices(p)] += damping * np.maximum(sum(np.diag(b[0]) for b in blocks), _DIAGONAL_LEAST)
    inner = []
    for aa, bb, ab, ga, gb in blocks:
        bb = bb + np.diag(damping * np.maximum(np.diag(bb), _DIAGONAL_LEAST))
        inverse = np.linalg.pinv(bb)
        s += aa - ab @ inverse @ ab.T
        g += ga - ab @ inverse @ gb
        inner.append(inverse)
    dx = -np.linalg.lstsq(s, g, rcond=None)[0]
    dv = [-inverse @ (gb + ab.T @ dx) for (_, _, ab, _, gb), inverse in zip(blocks, inner, strict=True)]
    return dx, np.array(dv).reshape(len(blocks), -1)


def _finish(residuals: Residuals, x: Array, v: Array, scale: float, info: Array) -> BundleFit:
    parts = tuple(residuals(i, x, v[i]) for i in range(len(v)))
    s, n, rss = info.copy(), 0, 0.0
    each_view: list[tuple[Array, Array]] = []
    for (aa, bb, ab, ga, gb), r in zip(_blocks(residuals, x, v, scale), parts, strict=True):
        inverse = np.linalg.pinv(bb)
        each_view.append((aa - ab @ inverse @ ab.T, ga - ab @ inverse @ gb))
        s += each_view[-1][0]
        kept = r[np.abs(r) <= scale]
        n, rss = n + len(kept), rss + float(kept @ kept)
    dof = max(n - v.size - len(x), 1)
    bread = np.linalg.pinv(s, hermitian=True)
    scores = np.array([_unshrunk(score, own, bread) for own, score in each_view]).reshape(len(each_view), len(info))
    cluster = bread @ (scores.T @ scores + info * rss / dof) @ bread
    return BundleFit(x, v, bread * rss / dof, cluster, parts, float(np.sqrt(rss / dof)))


def _unshrunk(score: Array, own: Array, bread: Array) -> Array:
    """A view's score as large as its errors made it: a fit bends towards every view, most to those that say most.

    Args:
        score, own: (P,) and (P, P) gradient and information of the view.
        bread: (P, P) inverse of all information.

    Source: Bell and McCaffrey, "Bias Reduction in Standard Errors for Linear Regression with Multi-Stage Samples"
    (2002).
    """
    if not len(score):
        return score
    value, vector = np.linalg.eigh(own)
    kept = value > _RANK * max(float(value[-1]), _TINY)
    root = vector[:, kept] * np.sqrt(value[kept])
    left, turn = np.linalg.eigh(np.eye(int(kept.sum())) - root.T @ bread @ root)
    part = turn.T @ (vector[:, kept] / np.sqrt(value[kept])).T @ score
    return np.asarray(root @ (turn @ (part / np.sqrt(np.maximum(left, _LEAST_LEFT)))))


def widest(fit: BundleFit) -> Array:
    """(P, P) of shared: residuals of a view err together; never less than if they did not."""
    cov = fit.cluster_cov if len(fit.views) >= _MANY_VIEWS else np.maximum(fit.cov, fit.cluster_cov)
    return at_least(cov, fit.cov)


def at_least(cov: Array, floor: Array) -> Array:
    """cov with no variance below the floor's."""
    grow = np.sqrt(np.maximum(np.diag(floor) / np.maximum(np.diag(cov), _TINY), 1.0))
    return np.asarray(cov * np.outer(grow, grow))
