"""Floors of a building side by side in one frame, so that a robot can be looked for on all of them at once.

The frame is the home floor's own. The others lie far to the right of it, turned so that the lines of all ceilings run
alike. Outside, poses are map_from_base of the floor that the robot is on.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from ceilvo.se2 import compose, inverse, rotation, transform, wrap
from ceilvo.types import Array, Ints, Landmarks, Pose

APART_M = 1000.0
"""Between a floor's ground and the next one's: a map may grow by half of it; chosen."""
_COLUMNS = ("ids", "xy_map_m", "cov_m2", "crossing_type", "sightings", "expected")


@dataclass(frozen=True, slots=True)
class Transition:
    """Where a lift or a ramp is on one floor.

    Attributes:
        name: the same on every floor that it leads to.
        kind: lift or ramp.
        x_m, y_m, theta_rad: of a robot in it, or at its foot, map_from_base.
    """

    name: str
    kind: str
    x_m: float
    y_m: float
    theta_rad: float

    @property
    def pose(self) -> tuple[float, float, float]:
        return self.x_m, self.y_m, self.theta_rad


@dataclass(frozen=True, slots=True)
class FloorMap:
    """The map of one floor in its own frame.

    Attributes:
        axis_rad: direction of axis 0 of the types.
    """

    name: str
    landmarks: Landmarks
    axis_rad: float
    transitions: tuple[Transition, ...] = ()


@dataclass(frozen=True, slots=True)
class Floor:
    """One floor, and where it lies beside the others.

    Attributes:
        name: of its map.
        frame_from_floor: (3,) [m, m, rad].
        begins_x_m: its ground is from here to the right, up to where the next one's begins.
        first_id: of its landmarks' ids in the frame; ids: above all that it had of its own.
        transitions: on the floor itself.
    """

    name: str
    frame_from_floor: Array
    begins_x_m: float
    first_id: int
    ids: int
    transitions: tuple[Transition, ...] = ()


@dataclass(frozen=True, slots=True)
class Floors:
    """Where each floor lies; none at all for a single map, which is as it is.

    Attributes:
        floors: the home floor first.
    """

    floors: tuple[Floor, ...] = field(default=())

    def __bool__(self) -> bool:
        return bool(self.floors)

    def at(self, pose: Array) -> Floor | None:
        """The floor that a pose (3,) of the frame is on; None where there is only one map."""
        under = [f for f in self.floors if f.begins_x_m <= pose[0]]
        return max(under, key=lambda f: f.begins_x_m) if under else None

    def named(self, name: str) -> Floor | None:
        return next((f for f in self.floors if f.name == name), None)

    def on_floor(self, pose: Array, cov: Array) -> tuple[str, Pose, Array]:
        """Name of the floor that a pose (3,) of the frame is on, the pose and its covariance (3, 3) there."""
        floor = self.at(pose)
        if floor is None or floor is self.floors[0]:
            return ("" if floor is None else floor.name), Pose(pose), cov
        there = np.array(compose(inverse(floor.frame_from_floor), np.asarray(pose)))
        there[2] = wrap(float(there[2]))
        return floor.name, Pose(there), _turned(cov, -float(floor.frame_from_floor[2]))

    def in_frame(self, name: str, pose: Array, cov: Array) -> tuple[Pose, Array]:
        """The reverse of on_floor().

        Raises:
            KeyError: there is no such floor.
        """
        floor = self.named(name)
        if floor is None:
            raise KeyError(name)
        return Pose(np.asarray(compose(floor.frame_from_floor, pose))), _turned(cov, float(floor.frame_from_floor[2]))

    def poses_on(self, name: str, poses: Array) -> Array:
        """Poses (N, 3) of the frame as one floor has them."""
        floor = self.named(name)
        if floor is None or floor is self.floors[0]:
            return poses
        return np.asarray(compose(np.broadcast_to(inverse(floor.frame_from_floor), poses.shape), poses))

    def landmarks_on(self, name: str, landmarks: Landmarks) -> Landmarks:
        """Those of the frame that are on one floor, as its own map has them; new ones go on from its ids."""
        floor = self.named(name)
        if floor is None:
            return landmarks
        here = next(i for i, f in enumerate(self.floors) if f is floor)
        begins = np.array([f.begins_x_m for f in self.floors])
        own = landmarks.of(np.searchsorted(begins, landmarks.xy_map_m[:, 0], side="right") - 1 == here)
        ids = self.ids_on(name, own.ids)
        turn = rotation(-float(floor.frame_from_floor[2]))
        xy = transform(Pose(inverse(floor.frame_from_floor)), own.xy_map_m) if here else own.xy_map_m
        cov = turn @ own.cov_m2 @ turn.T if here else own.cov_m2
        out = replace(own, ids=ids, xy_map_m=xy, cov_m2=cov)
        return out.of(np.argsort(ids, kind="stable"))

    def ids_on(self, name: str, ids: Ints) -> Ints:
        """(N,) ids of the frame as a floor's own map has them; -1 stays."""
        floor = self.named(name)
        if floor is None:
            return ids
        new = ids - self.first_new_id
        return np.asarray(np.where(ids < 0, -1, np.where(new >= 0, floor.ids + new, ids - floor.first_id)))

    @property
    def first_new_id(self) -> int:
        """The least id of the frame that no floor brought."""
        return sum(f.ids for f in self.floors)

    def axis_on(self, name: str, axis_rad: float) -> float:
        """Direction of axis 0 on a floor, from that in the frame."""
        floor = self.named(name)
        return axis_rad if floor is None else axis_rad - float(floor.frame_from_floor[2])

    def transition_at(self, pose: Array, reach_m: float) -> Transition | None:
        """The nearest transition within reach of a pose (3,) of the frame."""
        floor = self.at(pose)
        if floor is None or not floor.transitions:
            return None
        xy = self.on_floor(pose, np.zeros((3, 3)))[1][:2]
        nearest = min(floor.transitions, key=lambda s: float(np.hypot(s.x_m - xy[0], s.y_m - xy[1])))
        return nearest if np.hypot(nearest.x_m - xy[0], nearest.y_m - xy[1]) <= reach_m else None

    def leads(self, transition: Transition, pose: Array) -> Array:
        """(K, 3) transforms in the frame that take a robot which came to a transition at a pose (3,) to the other
        floors that it leads to."""
        here = self.at(pose)
        ends = [
            compose(f.frame_from_floor, np.array(s.pose))
            for f in self.floors
            for s in f.transitions
            if s.name == transition.name and f is not here
        ]
        if here is None or not ends:
            return np.zeros((0, 3))
        back = inverse(np.asarray(compose(here.frame_from_floor, np.array(transition.pose))))
        return np.array([compose(end, back) for end in ends])


def side_by_side(maps: Sequence[FloorMap]) -> tuple[Landmarks, Floors]:
    """Landmarks of several floors in one frame, that of the first, whose axis they share."""
    if len(maps) == 1:
        return maps[0].landmarks, Floors()
    right_m, first_id = -np.inf, 0
    floors: list[Floor] = []
    parts: list[Landmarks] = []
    for m in maps:
        turn = wrap(maps[0].axis_rad - m.axis_rad) if floors else 0.0
        xy = m.landmarks.xy_map_m @ rotation(turn).T
        low, high = (float(f(xy[:, 0])) if len(xy) else 0.0 for f in (np.min, np.max))
        shift_m = float(right_m + APART_M - low) if floors else 0.0
        begins_m = float(right_m + 0.5 * APART_M) if floors else -np.inf
        ids = int(np.max(m.landmarks.ids, initial=-1)) + 1
        floors.append(Floor(m.name, np.array([shift_m, 0.0, turn]), begins_m, first_id, ids, m.transitions))
        parts.append(_moved(m.landmarks, shift_m, turn, first_id))
        right_m, first_id = high + shift_m, first_id + ids
    return Landmarks(*(np.concatenate([getattr(p, c) for p in parts]) for c in _COLUMNS)), Floors(tuple(floors))


def _moved(landmarks: Landmarks, shift_m: float, turn: float, first_id: int) -> Landmarks:
    if shift_m == 0.0 and turn == 0.0 and first_id == 0:
        return landmarks
    r = rotation(turn)
    xy = landmarks.xy_map_m @ r.T + np.array([shift_m, 0.0])
    return replace(landmarks, ids=landmarks.ids + first_id, xy_map_m=xy, cov_m2=r @ landmarks.cov_m2 @ r.T)


def _turned(cov: Array, by_rad: float) -> Array:
    turn = np.eye(3)
    turn[:2, :2] = rotation(by_rad)
    return np.asarray(turn @ cov @ turn.T)
