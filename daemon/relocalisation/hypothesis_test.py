"""Whether a pose that was only assumed is right: it must explain what is seen better than its rivals do.

A grid of tiles agrees with any pose that is whole tiles off, so that most features fit proves nothing. The rivals are
tried on the same views: the assumed pose is believed once it has explained clearly more features than the best of the
poses whole tiles away, over views from places a little apart. A bare grid decides nothing, and then nothing is
believed. Where one rival is clearly better than all others, the robot is there.
"""

from __future__ import annotations

import numpy as np

from ceilvo.daemon.relocalisation.place_search import Home
from ceilvo.se2 import compose, inverse, rotation, transform, wrap
from ceilvo.types import Array, Landmarks, Observations

_MARGIN, _JUMP_MARGIN = 12, 24
_SHARE, _LONG_SHARE, _AT_ONCE_SHARE = 0.85, 0.93, 0.97
_SURE_SHARE = 0.6
_FEWEST_VIEWS = 6
_LONG_VIEWS = 40
_FEWEST = 5
_FEWEST_LANDMARKS = 6
_ELSEWHERE_SHARE, _LONG_ELSEWHERE_SHARE = 0.03, 0.006
_REACH_TILES = 3
_SMALLEST_TILE_M = 0.28
_TURNED_RAD = 0.15
_NEAR_M = 2.0  # rivals of that distance are tried anyway
_FEWEST_MAPPED, _HALF = 10, 0.5
_GROUND_M = 0.45  # ground is mapped so near a landmark


class Confirmation:
    """Counts explained features; `sure` hypotheses are within a fraction of a tile and need no rivals.

    Attributes:
        carried: the wheels carried the pose here: usable with care while it is unconfirmed.
        why: for the reason of the state.
        found: it came from looking all over the map. Ceilings repeat themselves at many distances and the map may lack
            the right place, so it must be right for a longer way.
        reach_m: how far the robot can be from where its way since it was last sure took it.
        home_from_map: (3,) takes the assumed pose to where that way ended.
    """

    def __init__(
        self,
        sure: bool,
        carried: bool = False,
        why: str = "",
        found: bool = False,
        reach_m: float = np.inf,
        home_from_map: Array | None = None,
    ) -> None:
        self.sure, self.carried, self.why, self.found = sure, carried, why, found
        self.reach_m = reach_m
        self.home_from_map = np.zeros(3) if home_from_map is None else home_from_map
        self._explained: Array = np.zeros(1)
        self._seen = self._views = self._elsewhere = self._ahead_of_map = 0

    def after_gap(self, carried: bool, reach_m: float = 0.0) -> Confirmation:
        """The same hypothesis after a further blind way: what was counted before it says nothing any more."""
        both = self.carried and carried
        return Confirmation(False, both, self.why, self.found, self.reach_m + reach_m, self.home_from_map)

    def jumped(self, old: Array, new: Array) -> Confirmation:
        """A hypothesis that says the robot is at `new` instead of at `old`."""
        home_from_map = compose(self.home_from_map, compose(old, inverse(new)))
        return Confirmation(
            False, why="found elsewhere on the map", found=True, reach_m=self.reach_m, home_from_map=home_from_map
        )

    def home(self, pose: Array) -> Home | None:
        """Where the robot should be if nobody carried it, for an assumed pose; None where nothing is known of that."""
        return Home(compose(self.home_from_map, pose), self.reach_m) if np.isfinite(self.reach_m) else None

    def weigh(self, explained: Array, seen: int, elsewhere: int, nis: float, nis_max: float) -> bool:
        """Take in one view from a new place.

        Args:
            explained: (1 + K,) features that the map explains from the assumed pose and from its K rivals.
            seen: features in the view.
            elsewhere: how many more the best other place of the whole map would explain, negative where none does.

        Returns:
            True once the hypothesis is confirmed.
        """
        if explained.shape != self._explained.shape:
            self._explained = np.zeros(explained.shape)
            self._seen = self._views = self._elsewhere = self._ahead_of_map = 0
        self._explained = self._explained + explained
        self._seen, self._views = self._seen + seen, self._views + 1
        self._elsewhere += max(elsewhere, 0)
        self._ahead_of_map -= elsewhere
        fits = explained[0] >= max(_FEWEST, _SURE_SHARE * seen) and nis <= nis_max
        if self.sure or len(explained) == 1:
            return bool(fits and self.sure)
        ahead = self._explained[0] - np.max(self._explained[1:])
        return bool(fits and ahead >= _MARGIN and self._believed())

    def _believed(self) -> bool:
        """Where the robot should be a few good views do; else it takes many or better ones, and no place like it."""
        if not self.found and self.reach_m <= _NEAR_M:
            return self._views >= _FEWEST_VIEWS and self._holds(_SHARE, _ELSEWHERE_SHARE)
        if self._ahead_of_map < _MARGIN:
            return False
        if self._views >= _LONG_VIEWS:
            return self._holds(_LONG_SHARE, _LONG_ELSEWHERE_SHARE)
        return not self.found and self._views >= _FEWEST_VIEWS and self._holds(_AT_ONCE_SHARE, _ELSEWHERE_SHARE)

    def better(self) -> int | None:
        """Which rival has explained clearly more than the assumed pose and than every other; None where none has."""
        if len(self._explained) < 3:
            return None
        order = np.argsort(self._explained)
        best, second = int(order[-1]), int(order[-2])
        ahead = self._explained[best] - self._explained[second]
        convinces = self._views >= _FEWEST_VIEWS and self._explained[best] >= _SHARE * self._seen
        return best - 1 if best > 0 and ahead >= _JUMP_MARGIN and convinces else None

    @property
    def hopeless(self) -> bool:
        """Whether enough views were explained too badly, or better elsewhere: the robot is there, or nothing is mapped.

        All views count: were the last one enough, a wrong pose would only have to wait for the one that fits.
        """
        if self.sure or self._views < _FEWEST_VIEWS:
            return False
        if self._views >= _LONG_VIEWS:
            return not self._holds(_LONG_SHARE, _LONG_ELSEWHERE_SHARE)
        return not self._holds(_SHARE, _ELSEWHERE_SHARE)

    def _holds(self, share: float, elsewhere_share: float) -> bool:
        """Whether the views were explained nearly whole, the best of bad ones being none, and nowhere better."""
        explained = self._explained[0] >= share * self._seen
        return bool(explained and self._elsewhere <= elsewhere_share * self._seen)


def contradicted(observations: Observations, pose: Array, landmarks: Landmarks) -> bool:
    """Whether a view cannot be from a pose: its lines lie otherwise, or mapped ground shows something else.

    On mapped ground, less than half of what is seen is in the map, and less than half of what is in the map is seen.

    Args:
        observations: labelled as seen from that pose.
    """
    if abs(wrap(observations.heading_rad - float(pose[2]))) > _TURNED_RAD:
        return True
    seen = transform(pose, observations.xy_base_m)
    reach_m = float(np.max(np.hypot(*observations.xy_base_m.T), initial=0.0)) + _GROUND_M
    at = landmarks.xy_map_m[np.hypot(*(landmarks.xy_map_m - pose[:2]).T) < reach_m]
    if not len(at):
        return False
    apart2 = np.min((seen[:, 0, None] - at[:, 0]) ** 2 + (seen[:, 1, None] - at[:, 1]) ** 2, axis=1)
    mapped = apart2 < _GROUND_M**2
    known = int(np.count_nonzero(observations.label[mapped] >= 0))
    within = np.all((at >= seen.min(axis=0)) & (at <= seen.max(axis=0)), axis=1)
    surprising, missed = known < _HALF * np.count_nonzero(mapped), known < _HALF * np.count_nonzero(within)
    return bool(np.count_nonzero(mapped) >= _FEWEST_MAPPED and surprising and missed)


def convincing(explained: int, seen: int) -> bool:
    """Whether one view is explained nearly whole."""
    return seen >= _FEWEST and explained >= _SHARE * seen


def can_confirm(landmarks: Landmarks) -> bool:
    """Whether the map has enough in it to judge a pose by."""
    return len(landmarks) >= _FEWEST_LANDMARKS


def rival_shifts(landmarks: Landmarks, map_axis_rad: float) -> Array:
    """(K, 2) whole tiles along and across the map's axes, up to 3 away, K = 48, or 0 where the map shows no tiles."""
    xy = landmarks.xy_map_m
    if not can_confirm(landmarks):
        return np.zeros((0, 2))
    kinds, counts = np.unique(landmarks.kind, return_counts=True)
    same = xy[landmarks.kind == kinds[np.argmax(counts)]]
    if len(same) < _FEWEST_LANDMARKS:
        return np.zeros((0, 2))
    apart = np.hypot(same[:, None, 0] - same[None, :, 0], same[:, None, 1] - same[None, :, 1])
    apart[apart < _SMALLEST_TILE_M] = np.inf  # itself, and the other edge of the same joint
    nearest = np.min(apart, axis=1)
    if not np.any(np.isfinite(nearest)):
        return np.zeros((0, 2))
    tile = float(np.median(nearest[np.isfinite(nearest)]))
    reach = range(-_REACH_TILES, _REACH_TILES + 1)
    steps = np.array([(i, j) for i in reach for j in reach if (i, j) != (0, 0)], np.float64)
    return np.asarray(tile * steps @ rotation(map_axis_rad).T)


def explained_at(shifts: Array, pose: Array, observations: Observations, landmarks: Landmarks, gate_m: float) -> Array:
    """(K,) how many features have a landmark of their kind within the gate, were the robot shifted by (K, 2)."""
    seen = transform(pose, observations.xy_base_m)
    count = np.zeros(len(shifts))
    for kind in np.unique(observations.kind):
        there = landmarks.xy_map_m[landmarks.kind == kind]
        if not len(there):
            continue
        moved = seen[observations.kind == kind] + shifts[:, None]
        dx = moved[..., 0, None] - there[:, 0]
        dy = moved[..., 1, None] - there[:, 1]
        count += np.count_nonzero(np.min(dx * dx + dy * dy, axis=-1) <= gate_m * gate_m, axis=-1)
    return count
