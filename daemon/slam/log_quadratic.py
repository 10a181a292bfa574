"""A log-quadratic curve through the particles' weights: the least squares of eqs. 21-25 on ln w, all axes together.

f = exp(S*), S* = a0 + b'u + u'Hu / 2 with ten coefficients: a curve that is a Gaussian, so that it can be narrower than
the cloud and lie outside it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ceilvo.daemon.slam.conditional import Bools, Conditional, Predicted, View, given_pose_chi2, root_of
from ceilvo.daemon.slam.pose_filter import JITTER, effective_size, normalised
from ceilvo.types import Array, Ints

ROUNDS = (10.0, 1.25)
"""Gates of the rounds of fitting, in units of filter.gate_chi2."""
WIDEN = 1.2
"""Standard deviations of a round's proposal in those of the last fit."""
RIDGE = 0.003
"""Of the mean diagonal of the normal equations; chosen: keeps ten coefficients of few effective draws finite."""
STEEPEST = 1e6
FLATTEST = 0.5
"""Bounds of the posterior's precision over the proposal's."""
_PAIRS = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
_I = np.array([p[0] for p in _PAIRS])
_J = np.array([p[1] for p in _PAIRS])
_FACTOR = np.where(_I == _J, 0.5, 1.0)


def fit(u: Array, log_f: Array) -> tuple[Array, Array, float] | None:
    """Gradient b (3,) and Hessian H (3, 3) at u = 0 of the curve through log_f (N,) at whitened u (N, 3).

    Weighted by omega = sqrt(f), with a ridge on all but the intercept. The third is the rms residual of eq. 22 in f,
    relative to the largest. None when there is nothing to fit.
    """
    top = float(np.max(log_f, initial=-np.inf))
    if len(u) < 10 or not np.isfinite(top):
        return None
    log_f = np.maximum(log_f - top, -60.0)
    omega = np.exp(0.5 * log_f)
    basis = np.empty((len(u), 10))
    basis[:, 0], basis[:, 1:4], basis[:, 4:] = 1.0, u, u[:, _I] * u[:, _J]
    weighted = basis.T * omega
    gram = weighted @ basis  # eq. 25
    ridge = RIDGE * np.trace(gram) / 10.0
    gram[np.arange(1, 10), np.arange(1, 10)] += ridge
    a = np.linalg.solve(gram, weighted @ log_f)
    if not np.all(np.isfinite(a)):
        return None
    h = np.empty((3, 3))
    h[_I, _J] = h[_J, _I] = a[4:] / _FACTOR
    residual = np.exp(np.minimum(basis @ a, 1.0)) - np.exp(log_f)
    return a[1:4], h, float(np.sqrt(np.mean(residual * residual)))


def posterior(centre: Array, root: Array, b: Array, h: Array) -> tuple[Array, Array]:
    """Mean (3,) and root (3, 3) of the product of the proposal N(centre, root root') and the curve."""
    values, vectors = np.linalg.eigh(np.eye(3) - h)
    values = np.clip(values, FLATTEST, STEEPEST)
    step = vectors @ ((vectors.T @ b) / values)
    return centre + root @ step, root @ (vectors / np.sqrt(values))


@dataclass(frozen=True, slots=True)
class Fitted:
    """A curve as a Gaussian: mean (3,) from the prior's and root (3, 3); residual of eq. 22 and ESS of the weights."""

    off: Array
    root: Array
    residual: float
    ess: float


class Weighing:
    """Weights of particles: of the prior N(mu, cov), and of what a view says given the shared map."""

    def __init__(self, view: View, mu: Array, cov: Array) -> None:
        self.view, self.mu, self.cov = view, mu, cov
        self.given = Conditional(view, mu, cov)
        self.root = root_of(cov)
        self._inverse = np.linalg.inv(self.root)

    def curve(self, off: Array, proposal: Array, u: Array, gate: float) -> Fitted | None:
        """The curve through the weights of particles mu + off + proposal u, u (N, 3) standard normals (eqs. 18, 21-25).

        None where there is nothing to fit.
        """
        white = u @ (self._inverse @ proposal).T + self._inverse @ off
        prior = 0.5 * (np.einsum("ni,ni->n", u, u) - np.einsum("ni,ni->n", white, white))
        log_weight = self.given.log_likelihood(off + u @ proposal.T, gate) + prior
        found = fit(u, log_weight)
        if found is None:
            return None
        at, root = posterior(off, proposal, found[0], found[1])
        return Fitted(at, root, found[2], effective_size(normalised(log_weight)))

    def log_evidence(self, f: Fitted, gate: float) -> float:
        """Of the view, as if posterior and curve were one Gaussian."""
        white = self._inverse @ f.off
        spread = np.linalg.slogdet(f.root)[1] - np.linalg.slogdet(self.root)[1]
        return float(self.given.log_likelihood(f.off[None], gate)[0] - 0.5 * white @ white + spread)

    def judged(self, off: Array, view: View, chosen: Ints, gate: float) -> tuple[Bools, bool]:
        """Which features (K,) are within the gate at mu + off, and whether the heading is.

        The own view has the `chosen` of them; they are judged given each other.
        """
        inliers = np.ones(len(view), bool)
        if len(chosen) < len(view):
            inliers = given_pose_chi2(view, self.mu + off, self.mu, self.cov) <= gate
        inliers[chosen] = self.given.distances(off[None], gate)[0] <= gate
        heading = bool(self.given.heading_distance(off[None])[0] <= gate) and np.isfinite(self.view.heading_var)
        return inliers, heading


def proposal(predicted: Predicted, gate: float) -> tuple[Array, Array]:
    """Where the first round draws: mean from the pose and root of the prior moved by what its own width explains.

    A cloud far wider than the likelihood would have next to no particle where the posterior is.
    """
    k = predicted.nu.size
    believed = predicted.chi2() <= gate
    take = np.append(np.repeat(believed[: k // 2], 2), believed[k // 2 :])
    if not np.any(take):
        return np.zeros(3), root_of(predicted.cov)
    nu, cross, total = -predicted.rows, predicted.rows_cross, predicted.rows_total
    if not np.all(take):
        nu, cross, total = nu[take], cross[:, take], total[np.ix_(take, take)]
    gain = np.linalg.solve(total, cross.T).T
    narrowed = predicted.cov - gain @ cross.T
    return gain @ nu, WIDEN * root_of(0.5 * (narrowed + narrowed.T) + np.diag(JITTER))


def normals(n: int, rng: np.random.Generator) -> Array:
    """(N, 3) standard normals in opposite pairs, so that their mean is exact; an odd one stands in the middle."""
    u = np.zeros((n, 3))
    half = rng.standard_normal((n // 2, 3))
    half *= np.sqrt(0.5 * n / max(np.vdot(half, half) / 3.0, 1.0))
    u[: n // 2], u[n // 2 : 2 * (n // 2)] = half, -half
    return u
