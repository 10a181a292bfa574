"""The default filter's update: modes of pose and map, each gated by a curve through weighted draws of its pose.

A mode is one hypothesis about what the wheels did. It is a Gaussian, and its update is Kalman's with the features that
the curve believes (docs/filter.md says what more the curve could do, and what it was worth).
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from ceilvo.config import Filter
from ceilvo.daemon.slam import modes
from ceilvo.daemon.slam.association import NIS_CAP
from ceilvo.daemon.slam.conditional import Bools, Predicted, View, along_the_turn, nis_of, root_of, turn_about
from ceilvo.daemon.slam.joint_filter import Innovations, JointFilterState
from ceilvo.daemon.slam.log_quadratic import ROUNDS, WIDEN, Fitted, Weighing, normals, proposal
from ceilvo.daemon.slam.modes import Mode
from ceilvo.daemon.slam.pose_filter import normalised
from ceilvo.daemon.slam.slip import KINDS, NO_SLIP, NONE, YAW, Slip, SlipState, TurnScale
from ceilvo.se2 import wrap, wrap_array
from ceilvo.types import Array, Ints, Motion

CURVE_FEATURES = 24
"""Features at most that a curve is fitted on; all are gated at the fitted pose and update the map."""
PIECE_FEATURES = 6
"""Features at most by which a piece of a wide slip is chosen."""
OTHERS, MOST_OTHERS, MOST_FIT = 18.0, 0.35, 0.35
"""Squared normalised innovation beyond which a feature is another landmark's (1 in 8,000 of its own is), how many may
be, and the median up to which most fit well, a quarter of what is expected. Measured: under open cells three in ten are
of others and the median is 0.02, while the pose is right to 4 mm; with a height that is 5 % wrong most are off."""
MODEL_SIGMA_M = 0.002
"""Model error that a filter begins with; chosen: what was learnt on the golden lap."""
MODEL_SIGMA_MAX_M = 0.006
"""Model error at most: innovations beyond it say that the calibration is stale; chosen, see docs/filter.md."""
MODEL_RATE = 0.05
"""Of the observation's variance that the model error's follows an innovation by; chosen: some hundred updates."""


@dataclass(frozen=True, slots=True)
class Branch:
    """A mode with one kind of slip since the last update, fitted to a view.

    Attributes:
        log_weight: of mode and slip, before the view.
        began: share of that weight in which the slip began on this path.
        weighing: of the features that the curve was fitted on.
        fitted: curve of the last round.
        inliers, heading: (K,) features that are believed, and whether the heading is.
        moved: whether the robot moved at all.
    """

    mode: Mode
    slip: Slip
    log_weight: float
    began: float
    moved: bool
    view: View
    weighing: Weighing
    fitted: Fitted
    inliers: Bools
    heading: bool


@dataclass(slots=True)
class JointRuleState:
    """What the rule remembers between updates.

    Attributes:
        ess, fit_residual: of the last fit, see FilterHealth.
        white: (N, 3) standard normals of the next first round, and of the particles that are shown.
        slip: the path since the last update, and how often wheels slip.
        slipping: (3,) probability that the wheels were slipping at the last update, by kind.
        turns: by how much the wheels misreport turns.
        modes: hypotheses that are kept apart, with the joint map as what is reported of them; none when there is one.
        sure: weight of the modes that are reported.
        model_var_m2: variance of what the noise curves leave out.
    """

    ess: float
    fit_residual: float
    white: Array
    slip: SlipState = field(default_factory=SlipState)
    slipping: Array = field(default_factory=lambda: np.zeros(KINDS))
    turns: TurnScale = field(default_factory=TurnScale)
    modes: list[Mode] = field(default_factory=list)
    sure: float = 1.0
    model_var_m2: float = MODEL_SIGMA_M**2


class JointRule:
    """An UpdateRule: modes of slip, each fitted to a view by a curve through weighted draws of the pose."""

    def __init__(self, settings: Filter) -> None:
        self._settings = settings

    def fresh(self, rng: np.random.Generator) -> JointRuleState:
        n = self._settings.particles
        return JointRuleState(float(n), float("nan"), normals(n, rng))

    def move(self, state: JointFilterState, motion: Motion) -> None:
        rule: JointRuleState = state.rule
        before = state.joint.pose[:2].copy()
        scaled = rule.turns.scaled(motion)
        for m in rule.modes:
            m.follow(state.joint)
            m.move(scaled)
        state.joint.move(scaled)
        step_m = state.joint.pose[:2] - before
        rule.slip.moved(step_m, scaled)
        spread = rule.turns.moved(step_m, motion)
        for cov in (state.joint.cov, *(m.cov for m in rule.modes)):
            cov[:3, :3] += spread

    def jumped(self, state: JointFilterState) -> None:
        rule: JointRuleState = state.rule
        rule.slip.rest()
        rule.turns.rest()
        rule.slipping, rule.modes, rule.sure = np.zeros(KINDS), [], 1.0

    def curve(self, state: JointFilterState) -> tuple[float, float]:
        return state.rule.ess, state.rule.fit_residual

    def certainty(self, state: JointFilterState) -> float:
        return float(state.rule.sure)

    def particles(self, state: JointFilterState) -> tuple[Array, Array]:
        """Draws from the modes, as many of each as it weighs."""
        rule: JointRuleState = state.rule
        n = self._settings.particles
        poses = state.joint.pose + rule.white @ root_of(state.joint.pose_cov).T
        if rule.modes:
            share = np.cumsum([m.weight for m in rule.modes])
            mine = np.minimum(np.searchsorted(share, (np.arange(n) + 0.5) / n), len(rule.modes) - 1)
            for i, m in enumerate(rule.modes):
                poses[mine == i] = m.mean[:3] + rule.white[mine == i] @ root_of(m.cov[:3, :3]).T
        poses[:, 2] = wrap_array(poses[:, 2])
        return poses, np.full(n, 1.0 / n)

    def absorb(self, state: JointFilterState, view: View, rows: Ints) -> Innovations:
        rule: JointRuleState = state.rule
        joint = state.joint
        view = replace(view, var=view.var + rule.model_var_m2)
        chi2 = nis_of(view, joint.pose, joint.pose_cov, 1.0) if len(view) else np.empty(0)
        doubtful = bool(np.any(view.held[rows])) if len(view.held) else False
        if not doubtful:
            rule.model_var_m2 = learnt_model_var(rule.model_var_m2, view, joint.pose_cov, chi2)
        for m in rule.modes:
            m.follow(joint)
        if not modes.agree(rule.modes, joint, view.held):  # weights that change would move what they say together
            rule.modes = []
        apart = [(m, m.view(view, rows)) for m in rule.modes] or [(Mode.of(joint, rule.slipping), view)]
        chosen = _chosen(chi2, state.now)
        branches = [b for m, v in apart for b in self._branches(state, m, v, chosen)]
        weight = normalised(np.array([b.log_weight + self._log_evidence(b) for b in branches]))
        best = branches[int(np.argmax(weight))]
        if not doubtful:
            rule.slip.learn(_starts(branches, weight))
        rule.slip.rest()
        rule.ess, rule.fit_residual = best.fitted.ess, best.fitted.residual
        rule.white = normals(self._settings.particles, state.rng)
        kept = [(b, float(w)) for b, w in zip(branches, weight, strict=True) if w > modes.FAINT]
        after = [_after(state, b, w, rows) for b, w in kept]
        if doubtful:
            rule.turns.rest()
        else:
            _learn_turns(rule.turns, [b for b, _ in kept], after)
        rule.turns.told = state.known is not None or bool(np.isfinite(view.heading_var))
        rule.modes, told = modes.settled(after, mapping=state.known is None)
        modes.restore([*rule.modes, told], joint, view.held)
        joint.mean, joint.cov = told.mean, told.cov
        rule.slipping, rule.sure = told.slipping, told.weight
        state.counters["slips"] += int(best.slip.kind != NONE)
        state.counters["resamplings"] += 1
        return _innovations(best.inliers, chi2)

    def _log_evidence(self, branch: Branch) -> float:
        return branch.weighing.log_evidence(branch.fitted, self._settings.gate_chi2)

    def _branches(self, state: JointFilterState, mode: Mode, view: View, chosen: Ints) -> list[Branch]:
        """The motion as reported, and with every kind of slip that may explain the view so much better as to matter."""
        path: SlipState = state.rule.slip
        part = view.of(chosen, max(1.0, view.inflation * len(chosen) / len(view))) if len(view) else view
        chances, began = path.chances(mode.slipping, self._settings)
        predicted = Predicted(part, mode.mean[:3], mode.cov[:3, :3])
        most, tried = most_gain(predicted, self._settings.gate_chi2), []
        for kind in (NONE, *range(KINDS)):
            log_weight = float(np.log(mode.weight) + np.log(max(chances[kind], np.finfo(np.float64).tiny)))
            if kind == NONE or log_weight + most >= np.log(modes.FAINT):
                slipped = self._slip(path, kind, predicted)
                tried.append((kind, slipped, log_weight + float(np.log(slipped.share))))
        out = []
        gains = likeliest_gains(predicted, [slipped for _, slipped, _ in tried[1:]])
        for (kind, slipped, log_weight), likeliest in zip(tried, [0.0, *gains], strict=True):
            gain = likeliest if slipped.share == 1.0 else most
            if kind != NONE and log_weight + gain < np.log(modes.LIGHT if slipped.share == 1.0 else modes.FAINT):
                continue
            share = float(began[kind] / chances[kind]) if kind != NONE else 0.0
            moved = path.exposure_m > 0.0
            weighing, fitted = self._fitted(state, part, mode, slipped)
            seen = weighing.judged(fitted.off, view, chosen, self._settings.gate_chi2)
            out.append(Branch(mode, slipped, log_weight, share, moved, view, weighing, fitted, *seen))
        return out

    def _slip(self, path: SlipState, kind: int, predicted: Predicted) -> Slip:
        """A slip of a kind; of one whose spread is wide the piece that explains the view best."""
        if kind == NONE:
            return NO_SLIP
        if kind != YAW:
            return path.along(kind, self._settings)
        pieces = path.turned()
        if len(pieces) == 1:
            return pieces[0]
        view = predicted.view
        if len(view) > PIECE_FEATURES:
            view = view.of(np.arange(PIECE_FEATURES), view.inflation)
        score = []
        for p in pieces:
            at = Predicted(view, predicted.pose + p.shift, predicted.cov + p.spread)
            score.append(np.log(p.share) - most_gain(at, self._settings.gate_chi2))
        return pieces[int(np.argmax(score))]

    def _fitted(self, state: JointFilterState, part: View, mode: Mode, slipped: Slip) -> tuple[Weighing, Fitted]:
        """Rounds of drawing around the last fit and fitting the weights anew."""
        gate = self._settings.gate_chi2
        w = Weighing(part, mode.mean[:3] + slipped.shift, mode.cov[:3, :3] + slipped.spread)
        off, root = proposal(Predicted(part, w.mu, w.cov), gate)
        fitted = Fitted(off, root / WIDEN, float("nan"), float(self._settings.particles))
        u = state.rule.white
        for i, level in enumerate(ROUNDS):
            if i:
                u, root = normals(self._settings.particles, state.rng), WIDEN * fitted.root
            found = w.curve(fitted.off, root, u, level * gate)
            if found is None:
                state.counters["fit_failures"] += 1
                break
            fitted = found
        return w, fitted


def _after(state: JointFilterState, branch: Branch, weight: float, rows: Ints) -> Mode:
    """The mode after the update."""
    slipping = np.zeros(KINDS) if branch.moved else branch.mode.slipping
    if branch.slip.kind != NONE:
        slipping[branch.slip.kind] = 1.0
    mean, cov = _learnt(state, branch, rows)
    mean[2] = wrap(float(mean[2]))
    return Mode(weight, mean, cov, branch.mode.ids, slipping, branch.mode.age + 1)


def _learnt(state: JointFilterState, branch: Branch, rows: Ints) -> tuple[Array, Array]:
    """Mean and covariance of pose and map with the inliers."""
    prior, which = branch.weighing, np.flatnonzero(branch.inliers)
    view = branch.view.of(which, branch.view.inflation)
    if not branch.heading:
        view = replace(view, heading_var=np.inf)
    mean, cov = branch.mode.mean.copy(), branch.mode.cov
    if branch.slip.kind != NONE:
        mean[:3], cov = prior.mu, cov.copy()
        cov[:3, :3] = prior.cov
    known = state.known is not None
    rows = rows[:0] if known else rows.reshape(-1, 2)[which].ravel()
    step, cov = modes.corrected(mean, cov, view, rows, prior.mu + branch.fitted.off, known)
    if known:
        return mean + step, cov
    step = along_the_turn(step)
    turn_about(cov, step)
    return mean + step, cov


def _starts(branches: list[Branch], weight: Array) -> Array:
    """(3,) probabilities that a slip of each kind began."""
    out = np.zeros(KINDS)
    for b, w in zip(branches, weight, strict=True):
        if b.slip.kind != NONE:
            out[b.slip.kind] += w * b.began
    return out


def _learn_turns(turns: TurnScale, branches: list[Branch], after: list[Mode]) -> None:
    before = [b.weighing.cov for b in branches]
    step = [m.mean[:3] - b.weighing.mu for m, b in zip(after, branches, strict=True)]
    step = [np.append(s[:2], wrap(float(s[2]))) for s in step]
    turns.learn(before, step, [m.cov[:3, :3] for m in after], np.array([m.weight for m in after]))


def learnt_model_var(var_m2: float, view: View, pose_cov: Array, chi2: Array) -> float:
    """A variance that brings innovations nearer to what is predicted of them, by a slow and bounded step.

    Args:
        var_m2: as it was; view.var contains it.
        chi2: (K,) squared normalised innovations at the predicted pose.
    """
    if not len(view):
        return var_m2
    excess = bulk_nis(chi2) - 1.0
    noise = float(np.mean(view.var))
    arm2 = float(np.mean(np.sum(view.xy**2, axis=1)))
    pose = 0.5 * float(pose_cov[0, 0] + pose_cov[1, 1] + arm2 * pose_cov[2, 2])
    step = MODEL_RATE * float(np.clip(excess, -1.0, 1.0)) * noise * noise / (noise + pose)  # innovations of a lost pose
    return float(np.clip(var_m2 + step, 0.0, MODEL_SIGMA_MAX_M**2))


def bulk_nis(chi2: Array) -> float:
    """NIS per degree of freedom of features (K,), without those that are of other landmarks: few, where most fit well.

    Where most do not, it is the pose or the calibration that is wrong, and all count.
    """
    others = chi2 > OTHERS
    if np.median(chi2) < MOST_FIT and np.mean(others) <= MOST_OTHERS:
        chi2 = chi2[~others]
    return 0.5 * float(np.mean(np.minimum(chi2, NIS_CAP)))


def most_gain(predicted: Predicted, gate: float) -> float:
    """By how much another pose can explain the view better at most, as a logarithm: gates bound what each can say."""
    return 0.5 * float(np.sum(np.minimum(predicted.chi2(), gate)))


def likeliest_gains(predicted: Predicted, slips: list[Slip]) -> list[float]:
    """By how much each slip, of any amount, explains the view better, as a logarithm."""
    if not slips or not len(predicted.rows):
        return [0.0] * len(slips)
    shifts = predicted.rows_h @ np.column_stack([slipped.direction for slipped in slips])
    towards = np.linalg.solve(predicted.rows_total, shifts)
    steepness = np.sum(shifts * towards, axis=0)
    gain = 0.5 * (predicted.rows @ towards) ** 2
    return [g / s if s > 0.0 else 0.0 for g, s in zip(gain.tolist(), steepness.tolist(), strict=True)]


def _chosen(chi2: Array, now: int) -> Ints:
    """Features that the curve is fitted on: a bounded number that takes turns, the least squared innovation first.

    The order decides which are gated given which; the doubtful ones are judged by the others.
    """
    k = len(chi2)
    step = -(-k // CURVE_FEATURES)
    chosen = np.arange(now % step, k, step) if step > 1 else np.arange(k)
    return chosen[np.argsort(chi2[chosen], kind="stable")]


def _innovations(inliers: Bools, chi2: Array) -> Innovations:
    """NIS of features (K,) at the predicted pose."""
    k = len(chi2)
    nis = bulk_nis(chi2) if k else 0.0
    trimmed = float(np.mean(np.sort(chi2)[:-1])) / 2.0 if k > 1 else 0.0
    return Innovations(inliers, nis, 2 * k, trimmed)
