"""What a map consists of, apart from where it is kept; editing takes one and gives another."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from ceilvo.daemon.map.key_poses import KeyPoses
from ceilvo.daemon.map.transitions import Side
from ceilvo.types import Array, Landmarks


@dataclass(frozen=True, slots=True)
class Session:
    """A drive that a map was made by.

    Attributes:
        name: as in KeyPoses.
        begun_s, last_s: wall-clock time of its first and last save, s since 1970.
        saves: their number.
        added: landmarks that came to the map by it.
        faded: those that went: no longer there, or found to be another one.
        refused: what it saw and the map did not take: never seen again, or no room.
    """

    name: str
    begun_s: float
    last_s: float
    saves: int = 0
    added: int = 0
    faded: int = 0
    refused: int = 0


@dataclass(frozen=True, slots=True)
class MapContent:
    """A whole map.

    Attributes:
        landmarks: by ascending id.
        seen_s: (L, 2) wall-clock time when each was first and last seen, s since 1970; 0 where nobody knows.
        axis_rad: direction in the map of axis 0 of the types.
        key_poses: of every session that has any.
        sessions: all of them, by name.
        floor: its name, "" for the only one.
        sides: where lifts and ramps to other floors are on this one, by name.
    """

    landmarks: Landmarks
    seen_s: Array
    axis_rad: float
    key_poses: tuple[KeyPoses, ...] = ()
    sessions: tuple[Session, ...] = ()
    floor: str = field(default="")
    sides: tuple[Side, ...] = ()

    @staticmethod
    def of(landmarks: Landmarks, axis_rad: float, seen_s: float = 0.0) -> MapContent:
        """Of a map that has landmarks only, all seen at one time."""
        ordered = landmarks.of(np.argsort(landmarks.ids, kind="stable"))
        return MapContent(ordered, np.full((len(landmarks), 2), seen_s), axis_rad)

    @property
    def features(self) -> int:
        """Crossings and points that all key poses saw."""
        return sum(k.features for k in self.key_poses)
