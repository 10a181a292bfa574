"""What may have happened to a robot while nobody looked, and how likely it is to be elsewhere then."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from ceilvo.daemon.odometry.course import JUMPED
from ceilvo.daemon.odometry.dead_reckoning import Track
from ceilvo.daemon.odometry.sight import SMALLEST_TILE_M
from ceilvo.daemon.relocalisation.lattice import offset, rival_poses
from ceilvo.daemon.relocalisation.place_belief import LEAST
from ceilvo.daemon.slam.pose_filter import TINY
from ceilvo.types import Array, Motion

LIFT_S = 1.0
"""Nobody lifts a robot, carries it to another tile and puts it down in less; chosen."""
LIFTED, CARRY_S = 0.02, 2.0
"""Chance that a robot which saw nothing for so long was lifted meanwhile; chosen: it happens, but seldom. In less time
fewer places are near enough, as its square."""
UNNOTICED = 1e-3
"""Part of those lifts that neither wheels nor gyro notice; chosen: nobody carries a robot without turning it."""
CARRY_MPS = 4.0
"""How fast a hand moves it at most; chosen: at 2.0, a walk, a robot that was swung further than it was listed had e^-8
of the chance of its twins under a raster of lamps, and never caught up (tuning seed 700 number 2)."""
TURN_RADPS, PUT_DOWN_RAD = 5.0, 0.5
"""How fast a hand turns a robot at most, and how much more while it puts it down; chosen."""
BESIDE_M, BESIDE_RAD = 1.0, 0.25 * np.pi
"""Besides how far a robot was moved and turned: its pose was put onto the nearest tiles, and turned onto them; half a
tile of 1.25 m either way."""
FASTER = 2.0
"""Than a hand by so much nobody moves it, so that places further off are no rivals; chosen: 8 m/s."""
ANYWHERE_M = 6.0
"""One that may have been carried further may be anywhere on the map: for time, nearer rivals are listed one by one."""
OFF_MAP = 0.05
"""Of those that were moved, how many stand where the map does not know; chosen."""
STORED_WRONG, GIVEN_WRONG, RESET_WRONG = 0.05, 0.2, 0.9
"""Chance that a robot was moved while it was off; that a person mistakes the tile; that a robot whose pose is thrown
away does not stand where it is told to begin. Chosen."""
JUST_NOW_S, STORED_LEAST = 60.0, 0.001
"""A pose that was stored less long ago is doubted in proportion, LIFTED for all of that time, but no less than this:
a service that was killed is back within seconds, in which few robots are carried; chosen."""
STORED_ALIGNED = 72.0
"""Likelihood ratio at most of tiles that lie as a stored pose says, also against whole tiles; chosen: a robot that
is put down within 5 cm of the same spot on another tile of 0.6 m by chance is one in 36, and along the same axis every
other time."""
UNTOUCHED, UNTOUCHED_SIGMA = 0.8, np.array([0.005, 0.005, 0.005])
"""Of the robots that nobody moved while they were off, how many stand where they stood, and how exactly, m and rad: the
others were bumped into; chosen."""
MOST_UNTOUCHED = 8.0
"""Log-likelihood ratio at most of tiles that lie exactly as a stored pose says; chosen: of 3000 robots that were
carried one stands in another dock a whole number of tiles away."""
CHANGED_OFF, CHANGE_S = 1e-4, 3600.0
"""Chance that the ceiling above a robot was changed while it was off for so long or longer; chosen: of ten thousand
nights one, and nobody hangs lamps anew within an hour."""
UNLIKELY = 0.005
"""A doubt that is less likely is over with the first view that bears the place out; chosen: a frame that was lost while
driving, whose way may be another one by a whole tile with one chance in a thousand, is no reason to stop for."""
_SIGMA_2_RAD2 = 0.05**2
"""Added to the variance of a heading that rivals are judged by, rad^2."""
_SIGMA_2_M2 = 0.05**2
"""The same of a position, m^2."""
_SIGMA2 = np.array([_SIGMA_2_M2, _SIGMA_2_M2, _SIGMA_2_RAD2])
"""Both, of a pose."""
MOST_ALIGNED = 6.0
"""Log-likelihood ratio at most of tiles that lie as expected; chosen: a robot is put down along the tiles, too."""
FEWEST_JUMPED, FEWEST_EVER = 10, 4
"""Crossings of a view that says so, and where views are poor; chosen: odometry needs three."""
_NEIGHBOURS = 8
"""Tiles around one."""
ENTERS = 0.05
"""Chance per spot that a robot comes from ground that nobody has mapped to ground that somebody has; chosen."""
PLACES_PER_M2 = 4.0 / 0.6**2
"""Places of a map that a view may be from: four headings on every tile of 0.6 m."""
LED = 0.95
"""Of the robots that may have changed floors, how many come out where a transition leads to; chosen."""
LED_M, LED_RAD = 1.0, 0.5
"""Around there: where a robot stands in a cabin, and how it stands, is not known better; chosen."""
MOST_DOUBTS = 64
"""More than so many doubts are no single ones any more, and the robot may be anywhere; for time."""


@dataclass(slots=True)
class Doubt:
    """One thing that may have moved the robot without being measured.

    Attributes:
        reason: for people.
        cov: (3, 3) of the pose as it is believed to be.
        elsewhere: probability that this covariance does not hold, because somebody moved the robot.
        reach_m: how far it can have been moved.
        stored: part of `elsewhere` that began when the pose was stored. Nobody who moved the robot since minded the
            tiles, and nobody may have touched it: how they lie speaks against that, also against whole tiles.
        changed: probability that the ceiling was changed meanwhile, where nobody moved the robot.
        leads: (K, 3) transforms in map that take the pose to where else a lift or a ramp may have brought the robot;
            where there are any, nothing else moved it.
        reach_rad: how far it can have been turned; inf where it may have gone on before or after.
        centre: (3,) of cov, off the tracked pose in map: where prediction had the robot, which is not where it is
            tracked once odometry had to choose a way.
    """

    reason: str
    cov: Array = field(default_factory=lambda: np.zeros((3, 3)))
    elsewhere: float = 0.0
    reach_m: float = 0.0
    stored: float = 0.0
    changed: float = 0.0
    leads: Array = field(default_factory=lambda: np.zeros((0, 3)))
    reach_rad: float = np.inf
    centre: Array = field(default_factory=lambda: np.zeros(3))

    @property
    def unmeasured(self) -> bool:
        """Whether the robot may be off by a part of a tile; else its path is known but for whole tiles."""
        return self.elsewhere > 0.0 or bool(np.any(self.cov))

    @property
    def anywhere(self) -> bool:
        return self.reach_m > ANYWHERE_M

    def jumped_within(self, most_s: float) -> bool:
        """Whether the picture jumped, in a gap of so long at most."""
        return self.elsewhere >= JUMPED and self.reach_m <= CARRY_MPS * most_s + BESIDE_M

    def bounded(self, listed_m: float) -> bool:
        """Whether somebody who moved the robot cannot have brought it further than rivals are listed one by one."""
        return self.elsewhere >= UNLIKELY and not len(self.leads) and max(self.search_m, self.reach_m) <= listed_m

    @property
    def search_m(self) -> float:
        """How far off rivals are looked for one by one."""
        drift_m = 4.0 * float(np.sqrt(max(np.linalg.eigvalsh(self.cov[:2, :2])[-1], 0.0)))
        drift_m += float(np.hypot(*self.centre[:2]))
        carried_m = self.reach_m if self.elsewhere > 0.0 and not len(self.leads) else 0.0
        return min(max(drift_m, carried_m), ANYWHERE_M)

    def beyond(self, off: Array, faster: float = 1.0) -> NDArray[np.bool_]:
        """(N,) whether nobody, were he so much faster, can have brought it off by (N, 3); False where not known."""
        if self.elsewhere == 0.0 or len(self.leads) or self.anywhere or np.isinf(self.reach_rad):
            return np.zeros(len(off), bool)
        drift_rad = 4.0 * float(np.sqrt(max(self.cov[2, 2], 0.0))) + abs(float(self.centre[2]))
        turned_rad = max(self.reach_rad, drift_rad) + BESIDE_RAD
        moved_m = self.search_m + (faster - 1.0) * max(self.reach_m - BESIDE_M, 0.0) + BESIDE_M
        return np.asarray((np.hypot(off[:, 0], off[:, 1]) > moved_m) | (np.abs(off[:, 2]) > turned_rad))

    def log_odds(self, off: Array, here: Array, tile_m: Array) -> Array:
        """(M,) of being off by (M, 3) in map from where the robot should be, against being off by `here` (3,)."""
        inverse = np.linalg.inv(self.cov + np.diag(_SIGMA2))
        carried = 0.0 if len(self.leads) else (1.0 - OFF_MAP) * self.elsewhere
        moved = np.log(max(carried, TINY) / (len(off) + 1))
        moved += self._left(0.0, min(max(self.alignment(here, tile_m), 0.0), np.log(STORED_ALIGNED)), here, tile_m)
        by_hand = np.where(self.beyond(off, FASTER), np.log(TINY), moved)
        stayed = np.log1p(-self.elsewhere)
        bumped = stayed - max(self._untouched(here, tile_m) - self.alignment(here, tile_m), 0.0)
        there = np.logaddexp(by_hand, bumped - 0.5 * np.sum((off @ inverse) * off, axis=-1))
        near = np.logaddexp(moved, stayed - 0.5 * here @ inverse @ here)
        return np.asarray(np.maximum(there - near, LEAST))

    def alignment(self, here: Array, tile_m: Array, turned: bool = True) -> float:
        """Log-likelihood ratio of tiles that lie as the pose says, off by `here` (3,), against tiles that lie anyhow.

        A robot that was put down anywhere sees the lattice shifted by any part of a tile and turned by any angle; not
        turned: by none, for another ceiling hangs along the same walls.
        """
        var = np.diagonal(self.cov) + _SIGMA2
        return float(np.clip(_fit(here, var, tile_m, turned), -MOST_ALIGNED, MOST_ALIGNED))

    @property
    def unlisted(self) -> float:
        """Share of the places that somebody can have moved it to which are on the map and are not listed one by one."""
        return (1.0 - OFF_MAP) * (1.0 - (ANYWHERE_M / max(self.reach_m, ANYWHERE_M)) ** 2)

    @property
    def unknown(self) -> float:
        """Log-odds of standing where the map does not know, or where no rival was listed."""
        share = OFF_MAP + self.unlisted
        return float(np.log(max(share * self.elsewhere, TINY)) - np.log1p(-self.elsewhere))

    def off_map(self, here: Array, tile_m: Array) -> tuple[float, float]:
        """`unknown` and log_odds_of_change() once it sees tiles off by `here` (3,); of no size where there are none."""
        by_tiles = self.unmeasured and bool(np.any(tile_m))
        unknown = self.unknown_by_tiles(here, tile_m) if by_tiles else self.unknown
        return unknown, self.log_odds_of_change(here, tile_m)

    def unknown_by_tiles(self, here: Array, tile_m: Array) -> float:
        """`unknown` of a robot of unmeasured path once it sees the tiles off by `here` (3,) from the expected pose."""
        aligned = self.alignment(here, tile_m)
        return self.unknown + self._left(aligned, aligned, here, tile_m)

    def log_odds_of_change(self, here: Array, tile_m: Array) -> float:
        """Log-odds, against the place where it was, of a robot that nobody moved below a ceiling that was changed, once
        it sees tiles off by `here` (3,): the same ones or others, along the same walls."""
        if self.changed == 0.0:
            return -np.inf
        as_known = ((UNTOUCHED, UNTOUCHED_SIGMA**2), (1.0 - UNTOUCHED, np.diagonal(self.cov) + _SIGMA2))
        fits = [np.log(0.5 * share) + _fit(here, var, t) for share, var in as_known for t in (tile_m, np.zeros(2))]
        fit, stayed = np.logaddexp.reduce(fits), max(self.alignment(here, tile_m), self._untouched(here, tile_m))
        return float(np.log(self.changed) - np.log1p(-self.elsewhere) + min(fit, MOST_UNTOUCHED) - stayed)

    def _left(self, before: float, since: float, here: Array, tile_m: Array) -> float:
        """Logarithm of what tiles off by `here` (3,) leave of `elsewhere`: log-likelihood ratios speak against what was
        doubted before the pose was stored, and since."""
        if self.stored == 0.0:
            return -before
        since = max(since, self._untouched(here, tile_m))
        left = (self.elsewhere - self.stored) * np.exp(-before) + self.stored * np.exp(-since)
        return float(np.log(left / self.elsewhere))

    def _untouched(self, here: Array, tile_m: Array) -> float:
        """Log-likelihood ratio of tiles off by `here` (3,) where nobody touched the robot since its pose was stored."""
        if self.stored == 0.0:
            return -np.inf
        return min(float(np.log(UNTOUCHED) + _fit(here, UNTOUCHED_SIGMA**2, tile_m)), MOST_UNTOUCHED)


@dataclass(slots=True)
class Reach:
    """Where hands can have brought the robot since its place was sure: by doubts, each at a tracked pose (3,)."""

    doubts: list[tuple[Doubt, Array]] = field(default_factory=list)

    def take(self, doubt: Doubt, pose: Array) -> None:
        """One more doubt came at a pose (3,)."""
        if len(self.doubts) <= MOST_DOUBTS:
            self.doubts.append((doubt, pose))

    def beyond(self, places: Array, faster: float = 1.0) -> NDArray[np.bool_]:
        """(N,) whether no single doubt, were it so much faster, explains places (N, 3), place_from_tracked in map."""
        out = np.full(len(places), 0 < len(self.doubts) <= MOST_DOUBTS)
        for doubt, pose in self.doubts:
            out &= doubt.beyond(offset(rival_poses(places, pose), pose), faster)
        return out


def _fit(here: Array, var: Array, tile_m: Array, turned: bool = True) -> float:
    """Log-likelihood ratio of tiles that lie off by `here` (3,) with variances (3,), against tiles that lie anyhow; not
    turned: along the same walls."""
    period = np.array([*tile_m, 0.5 * np.pi if turned else 0.0])
    fits = np.log(np.maximum(period, TINY) / np.sqrt(2.0 * np.pi * var)) - 0.5 * here**2 / var
    return float(np.sum(fits[period > 0.0]))


def shows_a_jump(crossings: int, usual: float) -> bool:
    """Whether a view that no motion explains has so many crossings that a motion should have explained it.

    Of large tiles a view shows five or six: half of what is usual there says as much as ten elsewhere.
    """
    return crossings >= min(FEWEST_JUMPED, max(0.5 * usual, FEWEST_EVER))


def of_gap(
    blind_cov: Array, blind_s: float, jumped: float, other: float, watched: bool = False, bridged: bool = False
) -> Doubt:
    """After a stretch without motions from vision.

    Args:
        blind_cov: (3, 3) of what prediction alone knew of it.
        blind_s: how long it was.
        jumped: probability that somebody moved the robot, where pictures did not fit; else 0.
        other: probability that the motion which ended it is another one that fits as well.
        watched: a gyro bears out that the robot stood on its wheels.
        bridged: the view that ended it shows what the one before it showed, so that nobody went on moving the robot.
    """
    lifted = LIFTED * min(1.0, (blind_s / CARRY_S) ** 2) if blind_s > LIFT_S else 0.0
    lifted *= UNNOTICED if watched else 1.0
    elsewhere = max(jumped, lifted, min(other, JUMPED))
    why = "the picture jumped" if jumped > lifted else f"{blind_s:.1f} s without vision"
    reach_rad = TURN_RADPS * blind_s + PUT_DOWN_RAD if bridged else np.inf
    return Doubt(why, blind_cov, elsewhere, CARRY_MPS * blind_s + BESIDE_M, reach_rad=reach_rad)


def of_track(track: Track, final: Motion, jumped: float, expected: Array, tracked: Array) -> Doubt:
    """After a track that ended in a final motion, of the pose (3,) that is tracked now.

    Args:
        jumped: as of_gap() takes it, before odometry looked at the view that ended the gap.
        expected: (3,) in map, where prediction alone has the robot.
    """
    weighed = track.bridged and final.doubt == 0.0
    cov = final.cov if weighed else track.blind_cov  # what odometry weighed, it weighed in all of the latter
    left = jumped * final.doubt_left
    doubt = of_gap(cov, track.blind_s, left, final.doubt, track.watched, track.bridged)
    return doubt if weighed else replace(doubt, centre=offset(expected, tracked))


def of_stored(cov: Array, ago_s: float, before: float) -> Doubt:
    """Of a pose that an earlier run stored: the robot may have been moved since, less likely if that is not long ago.

    Args:
        cov: (3, 3) of the pose where nobody moved it.
        ago_s: since it was stored; inf where nobody knows.
        before: probability that the robot was elsewhere when the pose was stored. A claim that nothing had confirmed is
            not better for a restart, and how the tiles lie says nothing of it: whole tiles are what it may be off by.
    """
    moved = max(LIFTED * ago_s / JUST_NOW_S, STORED_LEAST) if ago_s <= JUST_NOW_S else STORED_WRONG
    before = min(before, RESET_WRONG)
    elsewhere = min(moved + before, RESET_WRONG)
    changed = CHANGED_OFF if ago_s >= CHANGE_S else 0.0
    return Doubt("stored map and pose", cov, elsewhere, np.inf, elsewhere - before, changed)


def of_suspicion(reason: str, reach_m: float, pending: Doubt | None) -> Doubt:
    """To be put on a pending doubt: one suspicion, frame after frame, does not reach further with each."""
    far_m = 0.0 if pending is None else pending.reach_m
    return Doubt(reason, elsewhere=JUMPED, reach_m=reach_m - far_m if reach_m > far_m else 0.0)


def both(a: Doubt, b: Doubt) -> Doubt:
    """Of one after the other: the largest of each, and of leads the later ones."""
    elsewhere, reach_m = max(a.elsewhere, b.elsewhere), a.reach_m + b.reach_m
    changed, leads = max(a.changed, b.changed), b.leads if len(b.leads) else a.leads
    reach_rad = sum(d.reach_rad for d in (a, b) if d.elsewhere > 0.0)
    cov, centre = a.cov + b.cov, a.centre + b.centre
    return Doubt(b.reason, cov, elsewhere, reach_m, changed=changed, leads=leads, reach_rad=reach_rad, centre=centre)


def negligible(doubt: Doubt, rate: float) -> bool:
    """Whether the doubt cannot bring the tracked place below a chance of 1 - rate, on the smallest tiles."""
    sigma2 = float(np.linalg.eigvalsh(doubt.cov[:2, :2])[-1]) + _SIGMA_2_M2
    by_chance = _NEIGHBOURS * float(np.exp(-0.5 * SMALLEST_TILE_M**2 / sigma2))
    by_chance += _NEIGHBOURS * float(np.exp(-0.5 * (0.5 * np.pi) ** 2 / (doubt.cov[2, 2] + _SIGMA_2_RAD2)))
    return doubt.elsewhere + by_chance < rate


def log_odds_of_found(poses: Array, pose: Array, leads: Array, area_m2: float, late: bool) -> Array:
    """(N,) of places that a view was found at, against all places that are not listed.

    Args:
        poses: (N, 3); pose: (3,) tracked.
        leads: (K, 3) transforms from the tracked pose to where transitions lead to.
        area_m2: of the map.
        late: all that was there at another spot since the doubt has been listed.
    """
    out = np.full(len(poses), -np.log(max(area_m2, 1.0) * PLACES_PER_M2))
    out += np.log(ENTERS) if late else 0.0
    if not len(leads):
        return out
    out += np.log1p(-LED)
    for there in rival_poses(leads, pose):
        off = offset(poses, there)
        led = (np.hypot(off[:, 0], off[:, 1]) < LED_M) & (np.abs(off[:, 2]) < LED_RAD)
        out[led] = np.log(LED / (len(leads) * max(int(np.count_nonzero(led)), 1)))
    return out
