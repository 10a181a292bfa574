"""The default filter's update: a joint Gaussian, a curve fitted to weighted draws of the pose, gates that close in."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ceilvo.config import Filter
from ceilvo.daemon.slam import log_quadratic
from ceilvo.daemon.slam.association import NIS_CAP
from ceilvo.daemon.slam.conditional import Conditional, Predicted, given_pose_chi2, jacobian, nis_of, root_of
from ceilvo.daemon.slam.joint_filter import Bools, Innovations, JointFilterState, View, noise_in_map
from ceilvo.daemon.slam.joint_map import JITTER, JointMap, along_the_turn, turn_about
from ceilvo.daemon.slam.pose_filter import normalised
from ceilvo.se2 import rotation, wrap, wrap_array
from ceilvo.types import Array, Ints

ROUNDS = (10.0, 1.25)
"""Gates of the rounds of fitting, in units of filter.gate_chi2."""
CURVE_FEATURES = 24
"""Features at most that a curve is fitted on; all are gated at the fitted pose and update the map."""
WIDEN = 1.2
"""Standard deviations of a round's proposal in those of the last fit."""
SLIP_LENGTH_M = 0.3
"""How long a slip lasts, on average."""
NEGLIGIBLE = 0.01
"""A hypothesis of less weight is dropped."""


@dataclass(frozen=True, slots=True)
class Prior:
    """One hypothesis before the update: its weight, and by how much its pose differs from the joint map's."""

    log_weight: float
    shift: Array
    spread: Array


@dataclass(frozen=True, slots=True)
class Fitted:
    """One hypothesis after the rounds: pose and root of its covariance, evidence, inliers (K,), and the curve's fit."""

    pose: Array
    root: Array
    log_evidence: float
    inliers: Bools
    heading: bool
    residual: float
    ess: float


@dataclass(slots=True)
class PfcfState:
    """What the rule remembers between updates.

    Attributes:
        displacement_m: (2,) in map, since the last update.
        travel_m: length of the path since then.
        slipping: probability that the wheels were slipping at the last update.
        ess, fit_residual: of the last fit, see FilterHealth.
        white: (N, 3) standard normals of the next first round, and of the particles that are shown.
    """

    displacement_m: Array
    travel_m: float
    slipping: float
    ess: float
    fit_residual: float
    white: Array


class PfcfRule:
    """An UpdateRule: hypotheses about slip, each a Gaussian found by fitting a curve to weighted draws of the pose."""

    def __init__(self, settings: Filter) -> None:
        self._settings = settings

    def fresh(self, rng: np.random.Generator) -> PfcfState:
        n = self._settings.particles
        return PfcfState(np.zeros(2), 0.0, 0.0, float(n), float("nan"), normals(n, rng))

    def moved(self, state: JointFilterState, step_m: Array) -> None:
        rule: PfcfState = state.rule
        rule.displacement_m = rule.displacement_m + step_m
        rule.travel_m += float(np.hypot(*step_m))

    def jumped(self, state: JointFilterState) -> None:
        rule: PfcfState = state.rule
        rule.displacement_m, rule.travel_m, rule.slipping = np.zeros(2), 0.0, 0.0

    def curve(self, state: JointFilterState) -> tuple[float, float]:
        return state.rule.ess, state.rule.fit_residual

    def particles(self, state: JointFilterState) -> tuple[Array, Array]:
        """Draws from the pose's Gaussian, for pictures."""
        n = self._settings.particles
        poses = state.joint.pose + state.rule.white @ root_of(state.joint.pose_cov).T
        poses[:, 2] = wrap_array(poses[:, 2])
        return poses, np.full(n, 1.0 / n)

    def absorb(self, state: JointFilterState, view: View, rows: Ints) -> Innovations:
        rule: PfcfState = state.rule
        pose, cov = state.joint.pose, state.joint.pose_cov
        chi2 = nis_of(view, pose, cov, 1.0) if len(view) else np.empty(0)
        chosen = _chosen(chi2, state.now)
        part = view.of(chosen, max(1.0, view.inflation * len(chosen) / len(view))) if len(view) else view
        priors, predicted = self._priors(rule), Predicted(part, pose, cov)
        if len(priors) > 1 and implausible(predicted, priors[1]):
            priors = priors[:1]
        fits = [self._fit(state, view, part, chosen, priors[0], predicted)]
        for p in priors[1:]:
            fits.append(self._fit(state, view, part, chosen, p, Predicted(part, pose + p.shift, cov + p.spread)))
        log_weight = np.array([p.log_weight + f.log_evidence for p, f in zip(priors, fits, strict=True)])
        weight = normalised(log_weight)
        rule.slipping = float(weight[1]) if len(weight) > 1 else 0.0
        state.counters["slips"] += int(rule.slipping > 0.5)
        kept = weight > NEGLIGIBLE
        weight = weight * kept / np.sum(weight * kept)
        best = fits[int(np.argmax(weight))]
        rule.ess, rule.fit_residual = best.ess, best.residual
        parts = [_posterior(state, view, rows, p, f) for p, f, k in zip(priors, fits, kept, strict=True) if k]
        _merge(state.joint, weight[kept], parts)
        rule.displacement_m, rule.travel_m = np.zeros(2), 0.0
        rule.white = normals(self._settings.particles, state.rng)
        state.counters["resamplings"] += 1
        return _innovations(best.inliers, chi2)

    def _priors(self, rule: PfcfState) -> list[Prior]:
        """The motion as reported, and with a part of it swallowed by slip."""
        cfg, travel_m = self._settings, rule.travel_m
        none = Prior(0.0, np.zeros(3), np.zeros((3, 3)))
        if cfg.slip_per_m <= 0.0 or cfg.slip_share <= 0.0 or travel_m <= 0.0:
            return [none]
        enter, leave = 1.0 - np.exp(-cfg.slip_per_m * travel_m), 1.0 - np.exp(-travel_m / SLIP_LENGTH_M)
        p = float(np.clip(rule.slipping * (1.0 - leave) + (1.0 - rule.slipping) * enter, 1e-12, 1.0 - 1e-12))
        lost = np.append(cfg.slip_share * rule.displacement_m * min(1.0, 2.0 * SLIP_LENGTH_M / travel_m), 0.0)
        return [
            Prior(float(np.log1p(-p)), none.shift, none.spread),
            Prior(float(np.log(p)), -0.5 * lost, np.outer(lost, lost) / 12.0),
        ]

    def _fit(
        self, state: JointFilterState, view: View, part: View, chosen: Ints, prior: Prior, predicted: Predicted
    ) -> Fitted:
        """Rounds of drawing around the last fit and fitting the weights anew; then all features judged at the fit."""
        mu, cov = state.joint.pose + prior.shift, state.joint.pose_cov + prior.spread
        given = Conditional(part, mu, cov)
        gate = self._settings.gate_chi2
        prior_root = root_of(cov)
        prior_inverse = np.linalg.inv(prior_root)
        centre, root, widen = self._proposal(part, mu, cov, predicted)  # centre is counted from mu
        residual, u = float("nan"), state.rule.white
        for i, level in enumerate(ROUNDS):
            if i:
                u = normals(self._settings.particles, state.rng)
            proposal = root * widen
            white = u @ (prior_inverse @ proposal).T + prior_inverse @ centre
            log_f = given.log_likelihood(centre + u @ proposal.T, level * gate) + 0.5 * (
                np.einsum("ni,ni->n", u, u) - np.einsum("ni,ni->n", white, white)
            )
            curve = log_quadratic.fit(u, log_f)
            if curve is None:
                state.counters["fit_failures"] += 1
                break
            centre, root = log_quadratic.posterior(centre, proposal, curve[0], curve[1])
            residual, widen = curve[2], WIDEN
        w = normalised(log_f)
        at = centre[None]
        pose = mu + centre
        inliers = given_pose_chi2(view, pose, mu, cov) <= gate if len(chosen) < len(view) else np.empty(len(view), bool)
        inliers[chosen] = given.distances(at, gate)[0] <= gate
        heading = bool(given.heading_distance(at)[0] <= gate) and np.isfinite(view.heading_var)
        white = prior_inverse @ centre
        spread = np.linalg.slogdet(root)[1] - np.linalg.slogdet(prior_root)[1]
        evidence = float(given.log_likelihood(at, gate)[0] - 0.5 * white @ white + spread)
        return Fitted(pose, root, evidence, inliers, heading, residual, float(1.0 / np.sum(w * w)))

    def _proposal(self, view: View, mu: Array, cov: Array, predicted: Predicted) -> tuple[Array, Array, float]:
        """Where the first round draws, from mu: the prior moved by the features that its own width explains.

        A cloud far wider than the likelihood would have next to no particle where the posterior is.
        """
        gate = self._settings.gate_chi2
        total = predicted.total
        nu, take = -predicted.nu.ravel(), np.repeat(predicted.chi2() <= gate, 2)
        cross = cov @ predicted.h.T - view.joint[:3, 3:]
        off = float(wrap_array(view.heading - mu[2:])[0]) if np.isfinite(view.heading_var) else 0.0
        if np.isfinite(view.heading_var) and off**2 <= gate * (cov[2, 2] + view.heading_var):
            nu, take = np.append(nu, off), np.append(take, True)
            wider = np.empty((len(nu), len(nu)))
            wider[:-1, :-1], wider[-1, -1] = total, cov[2, 2] + view.heading_var
            wider[-1, :-1] = wider[:-1, -1] = cross[2]
            total, cross = wider, np.concatenate([cross, cov[:, 2:]], axis=1)
        if not np.any(take):
            return np.zeros(3), root_of(cov), 1.0
        if not np.all(take):
            nu, cross, total = nu[take], cross[:, take], total[np.ix_(take, take)]
        gain = np.linalg.solve(total, cross.T).T
        narrowed = cov - gain @ cross.T
        return gain @ nu, root_of(0.5 * (narrowed + narrowed.T) + np.diag(JITTER)), WIDEN


def implausible(predicted: Predicted, slip: Prior) -> bool:
    """Whether no amount of slip explains the innovations so much better that it could matter."""
    shift = np.tile(slip.shift[:2], len(predicted.nu))
    towards = np.linalg.solve(predicted.total, shift) if len(shift) else shift
    steepness = float(shift @ towards)
    gain = 0.5 * float(predicted.nu.ravel() @ towards) ** 2 / steepness if steepness > 0.0 else 0.0
    return bool(slip.log_weight + gain < np.log(NEGLIGIBLE))


def _chosen(chi2: Array, now: int) -> Ints:
    """Features that the curve is fitted on: a bounded number that takes turns, the least squared innovation first.

    The order decides which are gated given which; the doubtful ones are judged by the others.
    """
    k = len(chi2)
    step = -(-k // CURVE_FEATURES)
    chosen = np.arange(now % step, k, step) if step > 1 else np.arange(k)
    return chosen[np.argsort(chi2[chosen], kind="stable")]


def _posterior(state: JointFilterState, view: View, rows: Ints, prior: Prior, fitted: Fitted) -> tuple[Array, Array]:
    """Mean and covariance of pose and map: the inliers' Kalman update.

    On a known map it is linearised at the fitted pose. A map in the making turns with the pose's heading, and the
    covariance must not learn of that common turn: the features' lever is the estimate's, not the measured one.
    """
    mean, cov = state.joint.mean.copy(), state.joint.cov
    if np.any(prior.spread):
        cov = cov.copy()
        cov[:3, :3] += prior.spread
    mean[:3] += prior.shift
    which = np.flatnonzero(fitted.inliers)
    take, k = np.repeat(fitted.inliers, 2), 2 * len(which)
    at = fitted.pose if state.known is not None else mean[:3].copy()
    arm = view.xy[which] @ rotation(float(at[2])).T
    lever = arm if state.known is not None else view.landmark[which] - at[:2]
    h = np.concatenate([jacobian(lever), [[0.0, 0.0, 1.0]] if fitted.heading else np.empty((0, 3))])
    if not len(h):
        return mean, cov
    off = at - mean[:3]
    off[2] = wrap_array(off[2:])[0]
    innovation = h @ off
    innovation[:k] -= (at[:2] + arm - view.landmark[which]).ravel()
    innovation[k:] = wrap_array(view.heading - mean[2:3])[: len(h) - k]
    cross = h @ cov[:3]
    if state.known is None:
        cross[:k] -= cov[rows[take]]
        total = cross[:, :3] @ h.T
        total[:, :k] -= cross[:, rows[take]]
    else:
        total = cross[:, :3] @ h.T
        total[:k, :k] += view.joint[3:, 3:][np.ix_(take, take)]
    noise = noise_in_map(float(fitted.pose[2]), view.var[which] * view.inflation)
    i = np.arange(len(which))
    for a in range(2):
        for b in range(2):
            total[2 * i + a, 2 * i + b] += noise[:, a, b]
    total[k:, k:] += view.heading_var
    white = np.linalg.solve(np.linalg.cholesky(total), np.column_stack([innovation, cross]))
    cross = np.ascontiguousarray(white[:, 1:])
    step = cross.T @ white[:, 0]
    cov = cov - cross.T @ cross  # a product with itself comes out symmetric
    if state.known is None:
        step = along_the_turn(step)
        turn_about(cov, step)
    return mean + step, cov


def _merge(j: JointMap, weight: Array, parts: list[tuple[Array, Array]]) -> None:
    """One Gaussian with the mean and the covariance of the hypotheses together."""
    mean, cov = parts[0]
    if len(parts) > 1:
        means = np.array([m for m, _ in parts])
        means[:, 2] = means[0, 2] + wrap_array(means[:, 2] - means[0, 2])
        mean = weight @ means
        off = (means - mean) * np.sqrt(weight)[:, None]
        cov = sum((w * c for w, (_, c) in zip(weight, parts, strict=True)), off.T @ off)
        cov = 0.5 * (cov + cov.T)
    j.mean, j.cov = mean, cov
    j.mean[2] = wrap(float(j.mean[2]))


def _innovations(inliers: Bools, chi2: Array) -> Innovations:
    """NIS of features (K,) at the predicted pose."""
    k = len(chi2)
    nis = float(np.mean(np.minimum(chi2, NIS_CAP))) / 2.0 if k else 0.0
    trimmed = float(np.mean(np.sort(chi2)[:-1])) / 2.0 if k > 1 else 0.0
    return Innovations(inliers, nis, 2 * k, trimmed)


def normals(n: int, rng: np.random.Generator) -> Array:
    """(N, 3) standard normals in opposite pairs, so that their mean is exact; an odd one stands in the middle."""
    u = np.zeros((n, 3))
    half = rng.standard_normal((n // 2, 3))
    half *= np.sqrt(0.5 * n / max(np.vdot(half, half) / 3.0, 1.0))
    u[: n // 2], u[n // 2 : 2 * (n // 2)] = half, -half
    return u
