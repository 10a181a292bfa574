"""The belief over places: the tracked pose, its rivals on the map, and a place that the map does not know.

A sequential test (Wald 1945): every view adds the logarithm of its likelihood ratio to each rival's odds against the
tracked place, and the tracked place is sure while all others together are less likely than the stated rate of error.
Views from one spot show the same things and err alike, so they count as one: their mean is what is added.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ceilvo.daemon.relocalisation.evidence.wrong_places import by_single_lamps, combined, guessed, too_much
from ceilvo.daemon.relocalisation.lattice import CELL_M, beside, cells, rival_poses, same_places
from ceilvo.se2 import compose, inverse
from ceilvo.types import Array, Ints

LEAST = -18.0
"""Log-odds against the likeliest place below which none falls: 1.5e-8, the chance per spot that a robot moved whole
tiles without a trace in any sensor; chosen. It also bounds how long a move that did happen is overlooked."""
LEAST_UNKNOWN = -20.0
"""The same for ground that the map does not know: 2e-9; chosen."""
EVEN_RATE = 1e-3
"""Of errors among robots that were put down anywhere; chosen: one in a hundred is, see states.false_place_rate."""
SPOT_M, SPOT_RAD = 0.25, 0.25
"""A robot that has moved or turned so far sees other things, or the same ones with other errors; chosen."""
SPOT_CAP = 25.0
"""What one spot may add to log-odds, either way; chosen: no single view is surer than that."""
LEAD_M = 0.6
"""For so much of the way a place must have been the likeliest to take over; chosen: what people, dirt or a line that is
called by another type add to it is gone then, and it may be as much as a lamp adds. Turning shows the same ceiling."""
MOST_PLACES = 20_000
"""Places kept: of a hall of 15,000 m^2 whose lamps hang in a pattern some 7,000 look alike; chosen for time."""


@dataclass(slots=True)
class PlaceBelief:
    """Log-weights of places.

    Attributes:
        places: (P, 3) place_from_tracked, transforms in map; the first is the tracked place, zero.
        log_weight: (P,) but for what was seen; with that, and before this spot, the largest of all is zero.
        seen: (P, 2) log-likelihood ratios from spots that were left, against ground that is not known: any, and alike.
        unknown: the same of ground that the map does not know.
        spot: (P, 2) sums of the views' from this spot; nan of a place that no view was weighed at yet.
        spot_views: views from this spot.
        spot_m, spot_rad: moved and turned since the spot began.
        cut: places were left out that may be right.
        leader, led_m: the likeliest place (3,) but for the tracked one, and for how much of the way it was.
        told, told_unknown: what of log_weight and unknown is of other senses, see tell().
        evidence: (P,) log-likelihoods of all that was seen and told, whatever was likely before; see beats_all().
        changed: as unknown, of a robot that stands where it stood below a ceiling that was changed while it was off.
        stood: (1, 3) place where that is, or none where it is the tracked one.
    """

    places: Array = field(default_factory=lambda: np.zeros((1, 3)))
    log_weight: Array = field(default_factory=lambda: np.zeros(1))
    seen: Array = field(default_factory=lambda: np.zeros((1, 2)))
    unknown: float = LEAST_UNKNOWN
    spot: Array = field(default_factory=lambda: np.zeros((1, 2)))
    spot_views: int = 0
    spot_m: float = 0.0
    spot_rad: float = 0.0
    cut: bool = False
    leader: Array = field(default_factory=lambda: np.zeros(3))
    led_m: float = 0.0
    told: Array = field(default_factory=lambda: np.zeros(1))
    told_unknown: float = 0.0
    evidence: Array = field(default_factory=lambda: np.zeros(1))
    changed: float = -np.inf
    stood: Array = field(default_factory=lambda: np.zeros((0, 3)))

    def __post_init__(self) -> None:
        """States of older recordings were told nothing, and had one weight of a place."""
        if len(self.told) != len(self.places):
            self.told = np.zeros(len(self.places))
        if len(self.evidence) != len(self.places):
            self.evidence = self.log_weight + self.seen[:, 0]

    def __len__(self) -> int:
        """Places, the tracked one included."""
        return len(self.places)

    # -- what it says

    def weights(self) -> tuple[Array, float]:
        """(P,) log-weights of the places and of the unknown one, this spot included; the largest is zero."""
        weight = self._weighed(self.seen + self._of_spot)
        top = max(float(np.max(weight)), self.unknown)
        return np.maximum(weight - top, LEAST), max(self.unknown - top, LEAST_UNKNOWN)

    @property
    def _of_spot(self) -> Array:
        """(P, 2) the mean of the views from this spot."""
        return np.asarray(np.clip(np.nan_to_num(self.spot) / max(self.spot_views, 1), -SPOT_CAP, SPOT_CAP))

    @property
    def settled(self) -> Array:
        """(P,) log-weights before this spot."""
        return self._weighed(self.seen)

    def _weighed(self, seen: Array) -> Array:
        """(P,) log-weights, unknown ground's being as it was.

        Places are compared with each other by what any place explains by chance, for of each it is known what would be
        seen there. The likeliest is compared with unknown ground, which may be alike.
        """
        weight = self.log_weight + seen[:, 0]
        return np.asarray(weight - too_much(seen[np.argmax(weight)]))

    def shares(self) -> tuple[Array, float]:
        """(P,) probabilities of the places, and that of the unknown one."""
        weight, unknown = (np.exp(w) for w in self.weights())
        total = float(np.sum(weight) + unknown)
        return weight / total, float(unknown / total)

    def doubt(self) -> float:
        """Probability that the robot is not at the tracked place."""
        share, unknown = self.shares()
        return float(np.sum(share[1:]) + unknown)

    @property
    def led_by_another(self) -> bool:
        """Whether a place of the map is likelier than the tracked one."""
        return bool(np.argmax(self.weights()[0]) > 0)

    def winner(self, rate: float) -> int | None:
        """The place but for the tracked one beside which all others together are less likely than the rate."""
        share, unknown = self.shares()
        best = int(np.argmax(share))
        elsewhere = not np.any(same_places(self.stood, self.places[best, None]))
        rest = unknown + float(np.sum(share) - share[best] * (1.0 - elsewhere * np.exp(min(self.changed_odds, 0.0))))
        if best == 0 or rest >= rate or self.cut or self.led_m < LEAD_M:
            return None
        return best if same_places(self.leader[None], self.places[best, None])[0, 0] else None

    @property
    def changed_odds(self) -> float:
        """Log-odds of a changed ceiling against the likeliest place."""
        return self.changed - self._against_changed

    @property
    def _against_changed(self) -> float:
        if self.changed == -np.inf:  # nobody asks: every frame in doubt would for its reason
            return 0.0
        seen = self.seen + self._of_spot
        best = int(np.argmax(self.log_weight + seen[:, 0]))
        return float(self.log_weight[best]) + by_single_lamps(seen[best])

    def beats_all(self, place: int) -> bool:
        """Whether what was seen is enough for a place without where the robot was before: a stored pose makes some
        e^10 likelier than the rest of a hall, and is a guess for a robot that may be anywhere."""
        weight = self.evidence + self._of_spot[:, 0]
        rest = np.delete(weight, place) - weight[place]
        return bool(np.sum(np.exp(np.minimum(rest, 0.0))) < EVEN_RATE)

    # -- what changes it

    def moved(self, moved_m: float, turned_rad: float) -> None:
        self.spot_m += moved_m
        self.spot_rad += turned_rad

    @property
    def at_another_spot(self) -> bool:
        return self.spot_m > SPOT_M or self.spot_rad > SPOT_RAD

    def weigh(self, log_ratio: Array, unmapped: Callable[[int], tuple[Array, NDArray[np.bool_]]] | None = None) -> None:
        """Take in a view: (P, 2) log-likelihood ratios of the places against ground that is not known, and what says
        (P,) how much of what speaks for one of them lies on ground that is not known at each (None: nothing), and
        (P,) beside which how alike the ceiling is there is a guess.

        What the likeliest other place than the tracked one explains so well may be because ceilings are alike: then
        new ground would show the same, so it is no worse for that: any, or while the tracked place leads, only its own.
        """
        if len(self) > 1 and unmapped is not None:
            weight = self.log_weight + self.seen[:, 0] + log_ratio[:, 0]
            best = 1 + int(np.argmax(weight[1:]))
            view = np.clip(log_ratio[best], -SPOT_CAP, SPOT_CAP)
            on_new, guess = unmapped(best)
            before, after = self.seen[best], self.seen[best] + view
            measured = too_much(after) - too_much(before)
            by_guess = too_much(guessed(after)) - too_much(guessed(before))
            share = np.maximum(np.where(guess, by_guess, measured), 0.0) * on_new
            share[best] = 0.0
            if weight[best] < weight[0]:
                share[1:] = 0.0
            log_ratio = log_ratio + np.column_stack([share, np.zeros(len(self))])
        if not self.spot_views:
            self.spot_m = self.spot_rad = 0.0
        if np.any(late := np.isnan(self.spot)):
            best = int(np.argmax(np.where(late[:, 0], -np.inf, self.weights()[0])))
            as_now = self.spot[best] + self.spot_views * (log_ratio - log_ratio[best])
            self.spot = np.where(late, as_now, self.spot)
        self.spot = self.spot + log_ratio
        self.spot_views += 1

    def tell(self, log_likelihood: Array, unknown: float) -> None:
        """Other senses say (P,) of the places and of unknown ground, in place of what they said before."""
        self.log_weight = self.log_weight + (log_likelihood - self.told)
        self.evidence = self.evidence + (log_likelihood - self.told)
        self.unknown += unknown - self.told_unknown
        self.told, self.told_unknown = log_likelihood, unknown

    def leave_spot(self) -> None:
        """What this spot says is settled; the next view is from another. Places that have lost are dropped."""
        best = int(np.argmax(self.weights()[0]))
        same = best > 0 and bool(same_places(self.leader[None], self.places[best, None])[0, 0])
        self.leader, self.led_m = self.places[best].copy(), self.led_m + self.spot_m if same else 0.0
        self.forget()
        self._settle()

    def _settle(self) -> None:
        changed = self.changed_odds
        raw = self._weighed(self.seen + self._of_spot)
        top, unknown = max(float(np.max(raw)), self.unknown), self.unknown
        weight, self.unknown = self.weights()
        # What other senses say anew each time is not bounded: only what was seen falls no further.
        self.told = self.told + np.minimum(weight - (raw - top), np.maximum(-self.told, 0.0))
        self.told_unknown += min(self.unknown - (unknown - top), max(-self.told_unknown, 0.0))
        self.evidence = self.evidence + self._of_spot[:, 0]
        self.seen = self.seen + self._of_spot if len(self) > 1 else np.zeros((1, 2))
        likeliest = self.seen[np.argmax(weight)]
        # One that has fallen no further than LEAST was given some of its weight: not for what it has shown itself.
        self.seen[weight <= LEAST] = likeliest
        self.log_weight = weight - self.seen[:, 0] + too_much(likeliest)
        self.spot, self.spot_views = np.zeros((len(self), 2)), 0
        self.spot_m = self.spot_rad = 0.0
        self.changed = changed + self._against_changed

    def renew(self) -> None:
        """Something happened: what was seen before says how likely places were, but no longer which are alike.

        A spot that was not left shows the same again: a picture that stands was another proof with every frame.
        """
        if not self.at_another_spot:
            self.spot, self.spot_views = np.zeros((len(self), 2)), 0
        self._settle()
        changed = self.changed_odds
        self.log_weight, self.seen = self.settled, np.zeros((len(self), 2))
        self.changed = changed + self._against_changed

    def add(self, places: Array, log_odds: Array, late: bool = False) -> None:
        """More places (N, 3) with log-odds (N,) against the tracked one; of one that is there they are added up. Late:
        all that may be right were there before.

        What this spot has shown before is taken to have told them from the likeliest place as the next view will. What
        was seen before it made unknown ground as likely as it is, beside the likeliest: so beside them, were they that.
        """
        own = cells(self.places, CELL_M).tolist()
        at = {key: i for i in range(len(self) - 1, -1, -1) for key in beside(own[i])}
        fresh: list[int] = []
        settled = self.settled
        weight = log_odds + settled[0]
        likeliest, evidence = self.seen[np.argmax(settled)], self._of_new(late)
        stood = np.flatnonzero(np.any(same_places(self.places, self.stood), axis=1))
        for n, (g, cell) in enumerate(zip(places, cells(places, CELL_M).tolist(), strict=True)):
            i = at.get(tuple(cell))
            if i is None:
                at.update(dict.fromkeys(beside(cell), len(self) + len(fresh)))
                fresh.append(n)
            elif 0 < i < len(self):
                self.evidence[i] = max(self.evidence[i], evidence)
                if weight[n] > settled[i] or i in stood:
                    self.places[i] = g
                if weight[n] > settled[i]:  # most of its weight is new, and has the same past
                    self.log_weight[i], self.seen[i] = settled[i] - combined(likeliest), likeliest
                self.log_weight[i] += np.logaddexp(0.0, weight[n] - settled[i])
        self._append(places[fresh], weight[fresh], evidence)
        if len(self) > MOST_PLACES:
            self._leave_out(MOST_PLACES)

    def may_stand(self, places: Array, log_odds: float) -> None:
        """Where the robot stood (N, 3) if its ceiling was changed in part, with other tiles: none if that is here."""
        self.stood = places
        self.add(places, np.full(len(places), log_odds))

    def watch(self, places: Array) -> None:
        """Places (N, 3), all different, where the robot may have got to without a trace: weak evidence adds up.

        One that is there keeps what it has: a way on which nothing tells places apart must not add up to a doubt.
        """
        fresh = places[~np.any(same_places(places, self.places), axis=1)]
        self._append(fresh, np.full(len(fresh), LEAST + self.settled[0]), self._of_new(late=True))

    def _of_new(self, late: bool) -> float:
        """Evidence of a place that is not there yet: as good as any, unless it comes late."""
        return float(np.max(self.evidence)) + (LEAST if late else 0.0)

    def _append(self, places: Array, weight: Array, evidence: float) -> None:
        """Places (N, 3) that are not there yet, with log-weights (N,) and the past of the likeliest."""
        likeliest, count = self.seen[np.argmax(self.settled)], len(places)
        self.places = np.concatenate([self.places, places])
        self.log_weight = np.concatenate([self.log_weight, weight - combined(likeliest)])
        self.seen = np.concatenate([self.seen, np.repeat(likeliest[None], count, axis=0)])
        self.spot = np.concatenate([self.spot, np.full((count, 2), np.nan)])
        self.told = np.concatenate([self.told, np.full(count, self.told[0])])
        self.evidence = np.concatenate([self.evidence, np.full(count, evidence)])

    def again(self, log_odds: float) -> None:
        """The tracked place was found anew, a few centimetres off; log-odds as of add()."""
        settled = self.settled
        weight, likeliest = log_odds + settled[0], self.seen[np.argmax(settled)]
        self.evidence[0] = self._of_new(late=False)
        if weight > settled[0]:
            self.log_weight[0], self.seen[0] = weight - combined(likeliest), likeliest

    def _leave_out(self, most: int) -> None:
        """All but the heaviest; the first stays always."""
        settled = self.settled
        but = np.sort(np.append(0, 1 + np.argsort(-settled[1:], kind="stable")[: most - 1]))
        self.cut |= bool(np.max(np.delete(settled, but), initial=LEAST) > LEAST)
        self._keep(but)

    def _keep(self, which: Ints | NDArray[np.bool_]) -> None:
        self.places, self.log_weight = self.places[which], self.log_weight[which]
        self.seen, self.spot, self.told = self.seen[which], self.spot[which], self.told[which]
        self.evidence = self.evidence[which]

    def doubt_unknown(self, log_odds: float, changed: float = -np.inf) -> None:
        """Something happened after which the robot may be anywhere, with these log-odds against where it was.

        Wherever that was: while another place leads, it is that one which has become doubtful.

        Args:
            changed: log-odds of another ceiling where the robot stood, against the tracked place.
        """
        self.unknown = float(np.logaddexp(self.unknown, log_odds + np.max(self.settled)))
        self.changed = float(np.logaddexp(self.changed, changed + self.settled[0]))

    def forget(self) -> None:
        """Drop places that have lost; the tracked one alone is left when it is sure."""
        keep = self.weights()[0] > LEAST
        keep[0] = True
        self._keep(keep)
        self.cut &= len(self) > 1

    def jump(self, winner: int, tracked: Array) -> Array:
        """The winner becomes the tracked place; returns its pose (3,) for the tracked pose (3,)."""
        self._settle()
        self.led_m, self.changed, self.stood = 0.0, -np.inf, self.stood[:0]
        there: Array = rival_poses(self.places[winner : winner + 1], tracked)[0]
        back = inverse(self.places[winner])
        order = np.concatenate([[winner], np.delete(np.arange(len(self)), winner)])
        self.places = np.asarray(compose(self.places[order], np.broadcast_to(back, self.places.shape)))
        self.places[0], self.log_weight, self.seen = 0.0, self.log_weight[order], self.seen[order]
        self.told, self.evidence = self.told[order], self.evidence[order]
        return there
