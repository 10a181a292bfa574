"""Which displacements lie between two views: on a ceiling of tiles many fit, and what is not periodic decides.

Every displacement under which crossings of one type meet is a candidate. Its weight is its share of the prediction's
probability times a likelihood ratio: how much likelier the two views are there than at a wrong place of the same
ceiling. What a wrong place explains by chance is measured on the candidates themselves, type by type: where joints of
tiles cross nearly any whole tile explains them, and a lamp's corner only the right one does.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from numpy.typing import NDArray

from ceilvo.crossing_types import CROSSING_TYPES, TYPE_MISTAKEN, quarter_turns
from ceilvo.daemon.odometry.lines.direction import knows_quarter
from ceilvo.daemon.odometry.registration import MIN_AGREEING, expected_turn, view_size_m
from ceilvo.daemon.odometry.sight import BIN_M, SMALLEST_TILE_M, Matched, Sight, shifts_by_votes
from ceilvo.se2 import compose, wrap, wrap_array
from ceilvo.types import Array, Crossings, Ints

_SAME_M, _SAME_RAD = 3.0 * BIN_M, 0.1
"""Displacements that differ by less are one: the bins that were counted together."""
_MISSED = np.array([0.01, 0.05, 0.15, 0.35, 0.6])
"""Fractions of the crossings that both views must show which one of them misses."""
_MISSED_CHANCE = np.array([0.4, 0.3, 0.17, 0.1, 0.03])
"""How likely each is; chosen: laps had 0.03 in most conditions, 0.15 at worst (make bench-vision)."""
_LOG_MISSED_CHANCE = np.log(np.outer(_MISSED_CHANCE, _MISSED_CHANCE).reshape(-1))
"""The same of each pair of fractions, in logarithms: those of two views are independent."""
_ALIKE = 0.5
"""A candidate that explains this fraction of the crossings shows what tiles explain by chance, ..."""
_ALIKE_MET = 0.25
"""... if it explains this fraction of as many as any other: a few crossings meet anywhere; both chosen."""
_LEAST_CHANCE = 0.02
"""Bound of that chance, for a type is seen a few times only."""
_MISTAKEN = 0.5
"""Where so many crossings are missing, this times as many more are seen as of another type; chosen."""
_UNSEEN, _UNSEEN_WEIGHT = np.array([0.2, 0.2, 0.3, 0.3]), 2.0
"""The same before anything was seen of a type, and for how many crossings that counts; chosen."""
_VOTED_M = BIN_M / math.sqrt(12.0)
"""Standard deviation of where votes put a candidate: of an even distribution over a bin. With a bin itself, 20 mm, one
of the cells of 0.1 m that some ceilings are made of was within reach of any prediction."""
_TILE_M2 = 0.36
"""Area that one candidate stands for; chosen: an office tile of 0.6 m. It enters by its logarithm only."""
_FAR = 0.7
"""A robot that moved by more than this fraction of a view shares too little with it to be compared; chosen."""
_NODES = np.linspace(-3.5, 3.5, 15)
"""Of a normal distribution, in standard deviations, at which its part beyond a distance is summed up."""
_TINY = 1e-300
"""In place of a probability of zero, whose logarithm there is not."""
_HOPELESS = 18.0
"""Candidates whose weight is less by so much are left out: 1e-8, far below any rate of error."""
_MOST_CANDIDATES = 64
"""Looked at for each quarter turn; chosen for time: more than there are office tiles in a view."""
_VOTES_WORTH = 2.0
"""Of the logarithm of a candidate's votes against that of its prior share, in the choice of those; chosen."""
_CLEAR = 3.0
"""Log-likelihood ratio from which a heading that the prediction knows is not looked for among the quarter turns;
chosen: a wrong quarter turn would have to fit even better to matter."""
_QUARTER_RAD = 0.5 * np.pi
_FLICKERS = 0.3
"""Such a fraction from which it is the ceiling; chosen: 0.38 at the edge of a step, 0.2 before any was seen."""
_CARRIED_MPS, _CARRIED_RADPS, _CARRIED_NEAR_M = 10.0, 10.0, 1.3
"""Nobody moves a robot faster, but for a snatch by two tiles; chosen: half of it is a throw."""
_SNATCH_S, _HURLED = 0.1, 0.1
"""Such a snatch takes so long, but for this part of them; chosen: frames are lost without a trace, too."""
_STAMP_LIES = 1e-3
"""Of all that happens to a robot, so much is not that but pictures whose stamps are wrong: then it may be anywhere;
chosen."""
_STANDS_M, _STANDS_RAD = 0.003, 0.005
"""A robot stands that is foreseen to move by less between two views; chosen: 9 cm/s at 30 Hz."""
_GOES_ON = 0.1
"""Of the robots that somebody moves by whole tiles, so many go on driving as foreseen meanwhile; chosen."""


@dataclass(frozen=True, slots=True)
class Prior:
    """What is known of ref_from_curr before the views are compared.

    Attributes:
        mean: (3,) [m, m, rad].
        cov: (3, 3).
        carried: chance that neither holds, because somebody moved the robot.
        carried_s: time in which that was, without a picture that told.
        flickers: usual fraction of the odd features, those that are no joints, which one of two views misses.
    """

    mean: Array
    cov: Array
    carried: float
    carried_s: float = math.inf
    flickers: float = 0.0


@dataclass(frozen=True, slots=True)
class Candidates:
    """Displacements that are possible, the likeliest first.

    Attributes:
        ref_from_curr: (K, 3).
        log_ratio: (K,) logarithm of how much likelier the views are there than at a wrong place.
        log_weight: (K,) the same times the prior's share: of the probability, up to a common factor.
        unpredicted: (K,) probability that somebody moved the robot, if it is there; the prediction says no such thing.
        log_elsewhere: the weight of all displacements at which the views share too little, by the prediction.
        log_carried: the weight of those to which somebody may have moved the robot.
    """

    ref_from_curr: Array
    log_ratio: Array
    log_weight: Array
    unpredicted: Array
    log_elsewhere: float
    log_carried: float

    def __len__(self) -> int:
        return len(self.log_weight)

    def is_first(self, ref_from_curr: Array) -> bool:
        """Whether a displacement (3,) found otherwise is the first."""
        return bool(_is_one(self.ref_from_curr[:1], ref_from_curr[None])[0, 0])

    def others(self, rate: float) -> Ints:
        """(A,) which besides the first may be right at this rate of error, all of them together."""
        less = self.log_weight[1:] - self.log_weight[0]
        return np.asarray(1 + np.flatnonzero(less > math.log(rate / max(len(less), 1))))

    def doubt(self) -> float:
        """Probability that the first candidate is wrong."""
        if not len(self):
            return 1.0
        others = np.append(self.log_weight[1:], self.log_elsewhere) - self.log_weight[0]
        against = float(np.sum(np.exp(np.minimum(others, 50.0))))
        return against / (1.0 + against)

    def carried(self) -> float:
        """Probability that somebody moved the robot: to one of these, or to where the views share too little."""
        log_weight = np.append(self.log_weight, [self.log_elsewhere, self.log_carried])
        weight = np.exp(log_weight - np.max(log_weight))
        return float(np.append(self.unpredicted, [0.0, 1.0]) @ weight / np.sum(weight))


def find_candidates(
    ref: Crossings, curr: Crossings, turn_rad: float, prior: Prior, known: Array | None = None
) -> Candidates:
    """All displacements that explain at least three crossings, or two of few.

    Args:
        turn_rad: ref_from_curr rotation from the lines' direction, of which whole quarter turns are not known.
        known: (3,) a displacement that was found otherwise, by the same turn.
    """
    far_m = _FAR * view_size_m(ref)
    views = (ref, curr), (Sight.of(ref), Sight.of(curr))
    found: list[Matched] = []
    for quarter in range(4):
        turn = float(wrap(turn_rad + quarter * _QUARTER_RAD))
        extra = np.zeros((0, 3)) if known is None or quarter else known[None]
        found += _matched(*views, turn, extra, prior, far_m)
        if quarter == 0 and knows_quarter(float(prior.cov[2, 2])):
            straight = _weighed(found, far_m, prior)
            if len(straight) and straight.log_ratio[0] > _CLEAR:
                return straight
    return _weighed(found, far_m, prior)


def by_two_views(
    found: Candidates, earlier: Crossings, earlier_from_ref: Array, curr: Crossings, prior: Prior
) -> Candidates:
    """The same by the mean of what the reference and an earlier view say, where that can be compared.

    What one of them misses the other shows, or one whose neighbours in a pattern both miss is another.
    """
    far_m = _FAR * view_size_m(earlier)
    there = compose(earlier_from_ref, found.ref_from_curr)
    own = replace(prior, mean=compose(earlier_from_ref, prior.mean))
    quarter = np.round(wrap_array(there[:, 2] - there[0, 2]) / _QUARTER_RAD).astype(np.int64)
    views, matched = ((earlier, curr), (Sight.of(earlier), Sight.of(curr))), []
    for q in np.unique(quarter):
        which = quarter == q
        turn = expected_turn(earlier, curr, float(there[which][0, 2]))
        there[which, 2] = turn
        matched += _matched(*views, turn, there[which], own, far_m)
    at = np.concatenate([m.at for m in matched])
    ratio = _log_ratio(at, np.concatenate([m.counts for m in matched]), prior.flickers > _FLICKERS)
    if np.max(ratio) == -np.inf:  # the earlier view is like none of them
        return found
    ratio = np.maximum(ratio, np.max(ratio) - _HOPELESS)
    again = np.max(np.where(_is_one(there, at), ratio, -np.inf), axis=1)
    mean = np.where(np.hypot(*there[:, :2].T) <= far_m, 0.5 * (found.log_ratio + again), found.log_ratio)
    weight = found.log_weight - found.log_ratio + mean
    order = np.argsort(-weight, kind="stable")
    return replace(
        found,
        ref_from_curr=found.ref_from_curr[order],
        log_ratio=mean[order],
        log_weight=weight[order],
        unpredicted=found.unpredicted[order],
    )


def _matched(
    views: tuple[Crossings, Crossings],
    sights: tuple[Sight, Sight],
    turn_rad: float,
    known: Array,
    prior: Prior,
    far_m: float,
) -> list[Matched]:
    """Displacements of one rotation, those (N, 3) that were found otherwise first; one Matched, or none."""
    quarters = quarter_turns(views[1].psi_rad + turn_rad, views[0].psi_rad)
    at, votes = shifts_by_votes(*sights, turn_rad, quarters, far_m)
    at = np.column_stack([at, np.full(len(at), turn_rad)])
    promising = np.log(_prior_share(at, prior, far_m)[0]) + _VOTES_WORTH * np.log(votes)
    at = at[np.argsort(-promising, kind="stable")[:_MOST_CANDIDATES]]
    at = np.concatenate([np.column_stack([known[:, :2], np.full(len(known), turn_rad)]), at])
    return [Matched.of(*sights, at, quarters)] if len(at) else []


def _weighed(found: list[Matched], far_m: float, prior: Prior) -> Candidates:
    beyond = math.log(_far_share(prior, far_m) + _TINY), math.log(prior.carried + _TINY)
    if not found:
        return Candidates(np.zeros((0, 3)), np.zeros(0), np.zeros(0), np.zeros(0), *beyond)
    at = np.concatenate([m.at for m in found])
    ratio = _log_ratio(at, np.concatenate([m.counts for m in found]), prior.flickers > _FLICKERS)
    share, unpredicted = _prior_share(at, prior, far_m)
    weight = ratio + np.log(share)
    order = np.argsort(-weight, kind="stable")
    order = _apart(at, order[weight[order] > weight[order[0]] - _HOPELESS])
    return Candidates(at[order], ratio[order], weight[order], unpredicted[order], *beyond)


def _apart(at: Array, order: Ints) -> Ints:
    """The order without those that are one with an earlier one: its neighbouring bins."""
    near = _is_one(at[order], at[order])
    return np.asarray(order[~np.any(np.tril(near, -1), axis=1)])


def _is_one(at: Array, others: Array) -> NDArray[np.bool_]:
    """(K, J) whether displacements (K, 3) are those of (J, 3), or neighbouring bins."""
    off = at[:, None] - others[None]
    near = np.max(np.abs(off[..., :2]), axis=2) < _SAME_M
    return np.asarray(near & (np.abs(wrap_array(off[..., 2])) < _SAME_RAD))


def _log_ratio(at: Array, counts: Array, flickers: bool) -> Array:
    """(K,) of Matched, against a wrong place; the other candidates show what chance explains there.

    Args:
        flickers: what is missing of the commonest type, joints, and of the others is judged apart.
    """
    gain = _log_if_right() - np.log(_chance(at, counts))[:, None]  # (K, Q, 4, 13)
    gain[:, :, 1:] = np.minimum(gain[:, :, 1:], 0.0)  # what is missing or mistaken proves no place
    each = np.einsum("kct,kqct->kqt", counts, gain)
    joints = each[:, :, int(np.argmax(np.sum(counts, axis=(0, 1))))]
    others = np.sum(each, axis=2) - joints
    ratio = _over_fractions(joints) + _over_fractions(others) if flickers else _over_fractions(joints + others)
    return np.asarray(np.where(_agreeing(counts) < MIN_AGREEING, -np.inf, ratio))


@cache
def _log_if_right() -> Array:
    """(Q, 4, 13) logarithms of the shares of Matched.counts at the right place, for each pair of fractions that the two
    views miss.

    Of what one of them shows, at least: what both miss is not counted.
    """
    missed = np.repeat(_MISSED[:, None], CROSSING_TYPES, axis=1)
    before, now = np.repeat(missed, len(_MISSED), axis=0), np.tile(missed, (len(_MISSED), 1))
    other = np.minimum(TYPE_MISTAKEN + _MISTAKEN * 0.5 * (before + now), 0.5)
    both = (1.0 - before) * (1.0 - now)
    shares = np.stack([both * (1.0 - other), both * other, before * (1.0 - now), now * (1.0 - before)], axis=1)
    return np.asarray(np.log(shares / (1.0 - before * now)[:, None]))


def _over_fractions(score: Array) -> Array:
    """(K,) logarithm of the mean over fractions that are missing, of likelihoods (K, Q) given as logarithms."""
    score = score + _LOG_MISSED_CHANCE
    top = np.max(score, axis=1)
    return np.asarray(top + np.log(np.sum(np.exp(score - top[:, None]), axis=1)))


def _agreeing(counts: Array) -> Array:
    """(K,) fraction of the crossings that both views must show which both do."""
    met, all_of_them = np.sum(counts[:, :2], axis=(1, 2)), np.sum(counts, axis=(1, 2))
    return np.asarray(met / np.maximum(all_of_them, _TINY))


def _chance(at: Array, counts: Array) -> Array:
    """(K, 4, 13) the same as fractions, at the other candidates: where tiles meet, or anywhere if they do not."""
    met = np.sum(counts[:, :2], axis=(1, 2))
    alike = (_agreeing(counts) >= _ALIKE) & (met >= _ALIKE_MET * np.max(met))
    found = _at_others(at, at[alike], counts[alike])
    alone = np.sum(found, axis=(1, 2)) < _TINY
    found[alone] = _at_others(at[alone], at, counts)
    tried = np.sum(found, axis=1, keepdims=True)
    chance = np.maximum((found + _UNSEEN[:, None] * _UNSEEN_WEIGHT) / (tried + _UNSEEN_WEIGHT), _LEAST_CHANCE)
    chance[:, 0] = np.minimum(chance[:, 0], 1.0 - TYPE_MISTAKEN)  # no place explains more than the right one
    return np.asarray(chance)


def _at_others(at: Array, others: Array, counts: Array) -> Array:
    """(K, 4, 13) sums of the counts of the other candidates (J, 3), for each of (K, 3)."""
    here = np.all(np.abs(at[:, None] - others[None]) <= SMALLEST_TILE_M, axis=2)
    return np.asarray(np.tensordot((~here).astype(np.float64), counts, axes=1))


def _prior_share(at: Array, prior: Prior, far_m: float) -> tuple[Array, Array]:
    """(K,) of the prior's probability that each candidate (K, 3) stands for; (K,) part of it that no prediction has.

    Where tiles lie as predicted to millimetres, pictures with wrong stamps would do so by chance, for they show the
    robot anywhere in a tile; and one that a hand snatches by whole tiles stands, it does not go on as was foreseen.
    """
    cov = prior.cov[:2, :2] + _VOTED_M**2 * np.eye(2)
    off = at[:, :2] - prior.mean[:2]
    distance2 = np.einsum("ki,ij,kj->k", off, np.linalg.inv(cov), off)
    density = np.exp(-0.5 * distance2) / (2.0 * np.pi * np.sqrt(np.linalg.det(cov)))
    quarters = at[:, 2:] - prior.mean[2] + _QUARTER_RAD * np.arange(4)
    log_turn = -0.5 * wrap_array(quarters) ** 2 / (float(prior.cov[2, 2]) + _SAME_RAD**2)
    of_turn = np.exp(log_turn[:, 0] - np.logaddexp.reduce(log_turn, axis=1))
    foreseen = _TILE_M2 * density
    own = np.minimum(foreseen, 1.0) * of_turn
    surer = max(float(np.max(foreseen * of_turn, initial=0.0)), 1.0)
    off_m, reach_m = np.hypot(off[:, 0], off[:, 1]), _CARRIED_MPS * prior.carried_s
    near = off_m <= _CARRIED_NEAR_M + reach_m
    near &= np.abs(wrap_array(at[:, 2] - prior.mean[2])) <= _SAME_RAD + _CARRIED_RADPS * prior.carried_s
    hurled = off_m > _CARRIED_NEAR_M * min(prior.carried_s / _SNATCH_S, 1.0) + reach_m
    goes_on = float(np.hypot(*prior.mean[:2])) > _STANDS_M or abs(float(prior.mean[2])) > _STANDS_RAD
    by_hand = np.where(hurled, _HURLED, 1.0) * (max(_GOES_ON, 1.0 / surer) if goes_on else 1.0)
    so_far = np.where(near, by_hand, _STAMP_LIES / surer)
    anywhere = prior.carried * min(_TILE_M2 / (np.pi * far_m**2), 1.0) / 4.0 * so_far
    share = np.asarray((1.0 - prior.carried) * own + anywhere + _TINY)
    return share, anywhere / share


def _far_share(prior: Prior, far_m: float) -> float:
    """How much of the prediction's probability is further away than views can be compared."""
    values, vectors = np.linalg.eigh(prior.cov[:2, :2])
    x, y = (np.sqrt(max(v, 0.0)) * _NODES for v in values)
    at = prior.mean[:2] + x[:, None, None] * vectors[:, 0] + y[None, :, None] * vectors[:, 1]
    weight = np.exp(-0.5 * _NODES**2)
    weight = np.outer(weight, weight)
    return float(np.sum(weight[np.hypot(at[..., 0], at[..., 1]) > far_m]) / np.sum(weight))
