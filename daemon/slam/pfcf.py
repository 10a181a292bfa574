"""The filter of this daemon: pose particles on one shared map, a curve fitted to their weights, gates that close in."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ceilvo.config import Filter
from ceilvo.daemon.relocalisation.pose_search import Bank
from ceilvo.daemon.relocalisation.recovering_filter import Recovering
from ceilvo.daemon.slam import log_quadratic
from ceilvo.daemon.slam.conditional import Conditional, Predicted, given_pose_chi2, jacobian, root_of, surprise_of
from ceilvo.daemon.slam.joint_filter import NIS_CAP, View, noise_in_map
from ceilvo.daemon.slam.joint_map import JITTER, along_the_turn, turn_about
from ceilvo.daemon.slam.paper.curve_fit import systematic
from ceilvo.daemon.slam.pose_filter import normalised
from ceilvo.se2 import rotation, wrap, wrap_array
from ceilvo.types import Array, Depletion, Ints, Landmarks, Motion

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
Bools = NDArray[np.bool_]


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


class Pfcf(Recovering):
    """State: N pose particles and one map p(m | x); see docs/filter.md."""

    def __init__(self, settings: Filter, rng: np.random.Generator) -> None:
        super().__init__(settings, rng)

    def reset(self, pose: Array, cov: Array, landmarks: Landmarks | None = None, known: bool = False) -> None:
        super().reset(pose, cov, landmarks, known)
        n = self._settings.particles
        self._way = np.zeros(2)
        self._reported_m = 0.0
        self._slipping = 0.0
        self._health = (float(n), float("nan"))
        self._white = self._normals()

    def _normals(self) -> Array:
        """(N, 3) standard normals in opposite pairs, so that their mean is exact; an odd one stands in the middle."""
        n = self._settings.particles
        u = np.zeros((n, 3))
        half = self._rng.standard_normal((n // 2, 3))
        half *= np.sqrt(0.5 * n / max(np.vdot(half, half) / 3.0, 1.0))
        u[: n // 2], u[n // 2 : 2 * (n // 2)] = half, -half
        return u

    def particles(self) -> tuple[Array, Array]:
        n = self._settings.particles
        if self._bank is not None and len(self._bank):
            weights = normalised(self._bank.log_weight)
            pick = systematic(weights, np.random.default_rng(0), n)
            return self._bank.mean[pick], np.full(n, 1.0 / n)
        poses = self._joint.pose + self._white @ root_of(self._joint.pose_cov).T
        poses[:, 2] = wrap_array(poses[:, 2])
        return poses, np.full(n, 1.0 / n)

    def estimate(self) -> tuple[Array, Array, Depletion]:
        n = self._settings.particles
        ess, residual = self._health
        pose, cov, weight = self.dominant()
        told = (0.0, 0) if self._bank is not None else (self._nis, self._nis_dof)
        return pose, cov, Depletion(n, ess, n, residual, *told, weight)

    def predict(self, motion: Motion) -> None:
        before = self._joint.pose.copy()
        super().predict(motion)
        step = self._joint.pose[:2] - before[:2]
        self._way += step
        self._reported_m += float(np.hypot(*step))

    # -- update

    def _go_on_from(self, bank: Bank) -> None:
        super()._go_on_from(bank)
        self._way, self._reported_m, self._slipping = np.zeros(2), 0.0, 0.0

    def _absorb(self, view: View, rows: Ints) -> Bools:
        pose, cov = self._joint.pose, self._joint.pose_cov
        surprise = self._telemetry(view)
        chosen = self._chosen(surprise)
        part = view.of(chosen, max(1.0, view.inflation * len(chosen) / len(view))) if len(view) else view
        priors, predicted = self._priors(), Predicted(part, pose, cov)
        if len(priors) > 1 and implausible(predicted, priors[1]):
            priors = priors[:1]
        fits = [self._fit(view, part, chosen, priors[0], predicted)]
        for p in priors[1:]:
            fits.append(self._fit(view, part, chosen, p, Predicted(part, pose + p.shift, cov + p.spread)))
        log_weight = np.array([p.log_weight + f.log_evidence for p, f in zip(priors, fits, strict=True)])
        weight = normalised(log_weight)
        self._slipping = float(weight[1]) if len(weight) > 1 else 0.0
        self._counters["slips"] += int(self._slipping > 0.5)
        kept = weight > NEGLIGIBLE
        weight = weight * kept / np.sum(weight * kept)
        best = int(np.argmax(weight))
        self._health = (fits[best].ess, fits[best].residual)
        parts = [self._posterior(view, rows, p, f) for p, f, k in zip(priors, fits, kept, strict=True) if k]
        self._merge(weight[kept], parts)
        self._way, self._reported_m = np.zeros(2), 0.0
        self._white = self._normals()
        self._counters["resamplings"] += 1
        return fits[best].inliers

    def _chosen(self, surprise: Array) -> Ints:
        """Features that the curve is fitted on: a bounded number that takes turns, the least surprising first.

        The order decides which are gated given which; the doubtful ones are judged by the others.
        """
        k = len(surprise)
        step = -(-k // CURVE_FEATURES)
        chosen = np.arange(self._now % step, k, step) if step > 1 else np.arange(k)
        return chosen[np.argsort(surprise[chosen], kind="stable")]

    def _priors(self) -> list[Prior]:
        """The motion as reported, and with a part of it swallowed by slip."""
        cfg, way = self._settings, self._reported_m
        none = Prior(0.0, np.zeros(3), np.zeros((3, 3)))
        if cfg.slip_per_m <= 0.0 or cfg.slip_share <= 0.0 or way <= 0.0:
            return [none]
        enter, leave = 1.0 - np.exp(-cfg.slip_per_m * way), 1.0 - np.exp(-way / SLIP_LENGTH_M)
        p = float(np.clip(self._slipping * (1.0 - leave) + (1.0 - self._slipping) * enter, 1e-12, 1.0 - 1e-12))
        lost = np.append(cfg.slip_share * self._way * min(1.0, 2.0 * SLIP_LENGTH_M / way), 0.0)
        return [
            Prior(float(np.log1p(-p)), none.shift, none.spread),
            Prior(float(np.log(p)), -0.5 * lost, np.outer(lost, lost) / 12.0),
        ]

    def _fit(self, view: View, part: View, chosen: Ints, prior: Prior, predicted: Predicted) -> Fitted:
        """Rounds of drawing around the last fit and fitting the weights anew; then all features judged at the fit."""
        mu, cov = self._joint.pose + prior.shift, self._joint.pose_cov + prior.spread
        given = Conditional(part, mu, cov)
        gate = self._settings.gate_chi2
        prior_root = root_of(cov)
        prior_inverse = np.linalg.inv(prior_root)
        centre, root, widen = self._proposal(part, mu, cov, predicted)  # centre is counted from mu
        residual, u = float("nan"), self._white
        for i, level in enumerate(ROUNDS):
            if i:
                u = self._normals()
            proposal = root * widen
            white = u @ (prior_inverse @ proposal).T + prior_inverse @ centre
            log_f = given.log_likelihood(centre + u @ proposal.T, level * gate) + 0.5 * (
                np.einsum("ni,ni->n", u, u) - np.einsum("ni,ni->n", white, white)
            )
            curve = log_quadratic.fit(u, log_f)
            if curve is None:
                self._counters["fit_failures"] += 1
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

    def _posterior(self, view: View, rows: Ints, prior: Prior, fitted: Fitted) -> tuple[Array, Array]:
        """Mean and covariance of pose and map: the inliers' Kalman update.

        On a known map it is linearised at the fitted pose. A map in the making turns with the pose's heading, and the
        covariance must not learn of that common turn: the features' lever is the estimate's, not the measured one.
        """
        mean, cov = self._joint.mean.copy(), self._joint.cov
        if np.any(prior.spread):
            cov = cov.copy()
            cov[:3, :3] += prior.spread
        mean[:3] += prior.shift
        which = np.flatnonzero(fitted.inliers)
        take, k = np.repeat(fitted.inliers, 2), 2 * len(which)
        at = fitted.pose if self._known is not None else mean[:3].copy()
        arm = view.xy[which] @ rotation(float(at[2])).T
        lever = arm if self._known is not None else view.landmark[which] - at[:2]
        h = np.concatenate([jacobian(lever), [[0.0, 0.0, 1.0]] if fitted.heading else np.empty((0, 3))])
        if not len(h):
            return mean, cov
        off = at - mean[:3]
        off[2] = wrap_array(off[2:])[0]
        innovation = h @ off
        innovation[:k] -= (at[:2] + arm - view.landmark[which]).ravel()
        innovation[k:] = wrap_array(view.heading - mean[2:3])[: len(h) - k]
        cross = h @ cov[:3]
        if self._known is None:
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
        if self._known is None:
            step = along_the_turn(step)
            turn_about(cov, step)
        return mean + step, cov

    def _merge(self, weight: Array, parts: list[tuple[Array, Array]]) -> None:
        """One Gaussian with the mean and the covariance of the hypotheses together."""
        j = self._joint
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

    def _telemetry(self, view: View) -> Array:
        """NIS of every feature at the predicted pose; returns the squares (K,)."""
        self._nis, self._nis_dof, self._surprise = 0.0, 2 * len(view), 0.0
        if not len(view):
            return np.empty(0)
        pose, cov = self._joint.pose, self._joint.pose_cov
        nis = surprise_of(view, pose, cov, 1.0)
        self._nis = float(np.mean(np.minimum(nis, NIS_CAP))) / 2.0
        self._surprise = float(np.mean(np.sort(nis)[:-1])) / 2.0 if len(nis) > 1 else 0.0
        return nis


def implausible(predicted: Predicted, slip: Prior) -> bool:
    """Whether no amount of slip explains the innovations so much better that it could matter."""
    way = np.tile(slip.shift[:2], len(predicted.nu))
    towards = np.linalg.solve(predicted.total, way) if len(way) else way
    steepness = float(way @ towards)
    gain = 0.5 * float(predicted.nu.ravel() @ towards) ** 2 / steepness if steepness > 0.0 else 0.0
    return bool(slip.log_weight + gain < np.log(NEGLIGIBLE))
