"""The pose within a gap of vision, where ranges and marks hold what prediction alone would lose."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from ceilvo import se2
from ceilvo.daemon.relocalisation.beacons.anchors import AnchorTable
from ceilvo.daemon.relocalisation.beacons.mark_poses import MarkPose
from ceilvo.daemon.relocalisation.beacons.range_errors import direct_share
from ceilvo.types import Array, Displacement, Ints, Motion, Pose

CORRELATED = 4.0
"""By which the variance of a range is raised within a gap: ranges of a second share part of their errors; chosen."""
WANDER_M2PM = 0.1**2 / 2.0
"""Variance that an anchor's bias gains in a metre of the way: a decimetre within two metres, what something small in
the path makes of it; chosen by the covariance's test."""
LEAST_DIRECT = 0.2
"""A range that came straight with less probability is left out."""
TURNED_RAD = 0.4
"""Standard deviation of the heading beyond which ranges do not correct it: they are not linear in it then."""
ANY_RAD = float(np.pi / np.sqrt(3.0))
"""Standard deviation of a heading that may be any: more would be a lever for the place of the antenna."""
ALIKE = 0.5
"""Share of the variance of a mark's corners that is alike in pictures from near by: a lens adds as much as noise."""
FADE_M, FADE_RAD = 2.0, 1.0
"""Way and turn along which the tilt of a floor, and where in the picture a mark is, become others; chosen: as long as a
lamp is in view."""
LEAN = "the floor's tilt"
"""Names what all marks and lamps of a picture are off by."""
FEWEST = 3
"""Ranges and marks after which the pose within a gap is worth more than prediction's, chosen."""


@dataclass(slots=True)
class BridgeState:
    """Within a gap; nothing outside.

    Attributes:
        mean: (3 + A + ...,) pose in map, what each anchor's ranges are off by at this place, and what all else is off
            by that was seen; empty outside a gap.
        cov: of that.
        gap: (3,) how far the gap's prediction had come, with its covariance gap_cov (3, 3).
        used: ranges and marks that were taken.
        marks: how often each was, by name.
        errors: where in the mean a thing's error begins, by name.
        fading: covariance of each error that becomes another one on the way, by name.
    """

    mean: Array = field(default_factory=lambda: np.empty(0))
    cov: Array = field(default_factory=lambda: np.empty((0, 0)))
    gap: Array = field(default_factory=lambda: np.zeros(3))
    gap_cov: Array = field(default_factory=lambda: np.zeros((3, 3)))
    used: int = 0
    marks: dict[str, int] = field(default_factory=dict)
    errors: dict[str, int] = field(default_factory=dict)
    fading: dict[str, Array] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class _Error:
    """What something seen is off by: (K, E) derivative of what is seen by it, and its covariance (E, E) at first."""

    derivative: Array
    cov: Array
    fades: bool = False


class Bridge:
    """A Kalman filter of the pose and of what anchors, marks and lamps are off by, that lives as long as a gap.

    What errs alike each time is estimated with the pose: a lamp that is seen thirty times is not thirty lamps.
    """

    def __init__(self) -> None:
        self.state = BridgeState()

    @property
    def lives(self) -> bool:
        return len(self.state.mean) > 0

    @property
    def helps(self) -> bool:
        """Whether its pose is more than prediction."""
        return self.state.used >= FEWEST or bool(self.state.marks)

    @property
    def pose(self) -> tuple[Pose, Array]:
        return Pose(self.state.mean[:3].copy()), self.state.cov[:3, :3].copy()

    def end(self) -> None:
        self.state = BridgeState()

    def move(self, pose: Array, cov: Array, gap: Motion, table: AnchorTable, tag_m: Array) -> None:
        """Go as far as a gap's prediction has come since the pose (3,) with covariance (3, 3) at its beginning."""
        if not self.lives:
            self._begin(pose, cov, table, tag_m)
        s = self.state
        step = Displacement(se2.between(s.gap, gap.prev_from_curr))
        f = se2.lever(s.gap, gap.prev_from_curr)
        fresh = gap.cov - f @ s.gap_cov @ f.T
        back = np.eye(3)
        back[:2, :2] = se2.rotation(-float(s.gap[2]))
        values, vectors = np.linalg.eigh(0.5 * back @ (fresh + fresh.T) @ back.T)
        noise = (vectors * np.maximum(values, 0.0)) @ vectors.T
        before = s.mean[:3].copy()
        s.mean[:3] = se2.compose(before, step)
        f = se2.lever(before, s.mean[:3])
        s.cov[:3] = f @ s.cov[:3]
        s.cov[:, :3] = s.cov[:, :3] @ f.T
        g = np.eye(3)
        g[:2, :2] = se2.rotation(float(before[2]))
        s.cov[:3, :3] += g @ noise @ g.T
        most = ANY_RAD / float(np.sqrt(max(s.cov[2, 2], ANY_RAD**2)))
        s.cov[2], s.cov[:, 2] = most * s.cov[2], most * s.cov[:, 2]
        way_m = float(np.hypot(step[0], step[1]))
        every = 3 + np.arange(len(table.names))
        s.cov[every, every] += WANDER_M2PM * way_m
        self._fade(float(np.exp(-way_m / FADE_M - abs(step[2]) / FADE_RAD)))
        s.gap, s.gap_cov = np.array(gap.prev_from_curr), np.array(gap.cov)

    def _begin(self, pose: Array, cov: Array, table: AnchorTable, tag_m: Array) -> None:
        every = np.arange(len(table.names))
        at = pose[:2] + se2.rotation(float(pose[2])) @ tag_m[:2]
        distance, _ = table.distances(every, at, float(tag_m[2]))
        full = np.zeros((3 + len(every), 3 + len(every)))
        full[:3, :3] = cov
        full[3:, 3:] = np.diag(table.bias_sigma(every, distance) ** 2)
        self.state = BridgeState(np.concatenate([pose, np.zeros(len(every))]), full)

    def _fade(self, keeps: float) -> None:
        """What is another one after some way, and as large."""
        s = self.state
        for name, cov in s.fading.items():
            at = slice(s.errors[name], s.errors[name] + len(cov))
            s.mean[at] *= keeps
            s.cov[at] *= keeps
            s.cov[:, at] *= keeps
            s.cov[at, at] += (1.0 - keeps**2) * cov

    def hear(self, table: AnchorTable, tag_m: Array, which: Ints, range_m: Array, way_m: Array) -> None:
        """Ranges (N,) to anchors (N,); way_m: (N, 2) by which the tag was elsewhere then, in map."""
        s = self.state
        for a, r, way in zip(which.tolist(), range_m.tolist(), way_m, strict=True):
            arm = se2.rotation(float(s.mean[2])) @ tag_m[:2]
            one = np.array([a])
            d, unit = table.distances(one, (s.mean[:2] + arm + way)[None], float(tag_m[2]))
            h = np.zeros(len(s.mean))
            h[:2] = unit[0]
            h[2] = unit[0] @ np.array([-arm[1], arm[0]])
            h[3 + a] = 1.0
            off = r - float(table.expected(one, d)[0]) - float(s.mean[3 + a])
            spread = float(h @ s.cov @ h) + table.noise_m**2
            direct = float(direct_share(np.array(off), np.sqrt(spread)))
            if direct < LEAST_DIRECT:
                continue
            self._update(h[None], np.array([off]), np.array([[CORRELATED * table.noise_m**2 / direct]]))

    def see(self, mark: MarkPose) -> None:
        """A mark that is believed."""
        off, name = np.array(mark.pose - self.state.mean[:3]), str(mark.number)
        off[2] = se2.wrap(float(off[2]))
        errors = {
            name: _Error(mark.by_place, mark.place_cov),
            f"{name} in the picture": _Error(mark.by_picture, ALIKE * mark.picture_cov, fades=True),
            LEAN: _Error(mark.by_picture[:, :2], mark.tilt_var * np.eye(2), fades=True),
        }
        var = (1.0 - ALIKE) * mark.by_picture @ mark.picture_cov @ mark.by_picture.T
        self._see(name, off, np.eye(3), errors, var)

    def see_lamp(self, name: str, off: Array, by_pose: Array, own_var: float, seen_var: tuple[float, float]) -> None:
        """A lamp (2,) off where the pose has it in base, m, which changes with the pose by (2, 3).

        Args:
            own_var: of each coordinate of its place, m^2.
            seen_var: of each coordinate of what is seen: what the floor's tilt makes of it, and the rest.
        """
        tilt_var, rest_var = seen_var
        own = _Error(-by_pose[:, :2], own_var * np.eye(2))  # moved in map, it moves in base as the robot does
        lean = _Error(np.eye(2), tilt_var * np.eye(2), fades=True)
        self._see(name, off, by_pose, {name: own, LEAN: lean}, rest_var * np.eye(2))

    def _see(self, name: str, off: Array, by_pose: Array, errors: dict[str, _Error], var: Array) -> None:
        """Something of known place, (K,) off where the pose has it, which changes with the pose by (K, 3).

        Args:
            errors: by name; var: (K, K) of what is off by anything each time.
        """
        s = self.state
        for key, error in errors.items():
            if key not in s.errors:
                s.errors[key] = len(s.mean)
                s.mean = np.concatenate([s.mean, np.zeros(len(error.cov))])
                s.cov = np.pad(s.cov, (0, len(error.cov)))
                s.cov[s.errors[key] :, s.errors[key] :] = error.cov
            if error.fades:
                s.fading[key] = error.cov
        h = np.zeros((len(by_pose), len(s.mean)))
        h[:, :3] = by_pose
        for key, error in errors.items():
            h[:, s.errors[key] + np.arange(len(error.cov))] = error.derivative
        self._update(h, off - h[:, 3:] @ s.mean[3:], var)
        s.marks[name] = s.marks.get(name, 0) + 1

    def widen(self, mark: MarkPose) -> None:
        """A mark that contradicts others: one of them is wrong, so the pose may be either."""
        off = np.array(mark.pose - self.state.mean[:3])
        off[2] = se2.wrap(float(off[2]))
        most = np.diag(np.square(off))
        self.state.cov[:3], self.state.cov[:, :3] = 0.0, 0.0
        self.state.cov[:3, :3] = most + mark.cov

    def _update(self, h: Array, off: Array, var: Array) -> None:
        s = self.state
        cross = s.cov @ h.T
        total = h @ cross + var
        gain = np.linalg.solve(total, cross.T).T
        if len(off) == 1 and s.cov[2, 2] > TURNED_RAD**2:
            gain[2] = 0.0
        s.mean = s.mean + gain @ off
        s.mean[2] = se2.wrap(float(s.mean[2]))
        cov = s.cov - gain @ cross.T - cross @ gain.T + gain @ total @ gain.T
        s.cov = 0.5 * (cov + cov.T)
        s.used += 1
