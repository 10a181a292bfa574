"""`ceilvod map join`: a map in a frame of its own becomes part of another."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ceilvo.crossing_types import quarter_turns, turned_type
from ceilvo.daemon.building.contradictions import counted, differences, of_pairs
from ceilvo.daemon.building.frames import Frame, frame_of, pairs
from ceilvo.daemon.editing import sources
from ceilvo.daemon.editing.changes import moved
from ceilvo.daemon.editing.editor import Where, apply
from ceilvo.daemon.editing.joining import both_times, free_ids, renamed
from ceilvo.daemon.map.database.content import MapContent
from ceilvo.errors import CeilvoError
from ceilvo.types import NO_LANDMARK, Ints, Landmarks


@dataclass(frozen=True)
class Joined:
    """The map that both make, and what became of whom.

    Attributes:
        shared: landmarks that both have.
        added: new ones.
        faded: that the first had, and the second, later, has not.
        refused: that the second had, and the first, later, has not.
        doubtful: that one only has though both looked; they are kept.
    """

    content: MapContent
    shared: int
    added: int
    faded: int
    refused: int
    doubtful: int

    def __str__(self) -> str:
        return (
            f"{self.shared} landmarks are in both, {self.added} added, {self.faded} faded (the later map has them no "
            f"more), {self.refused} refused (the later map has them not), {self.doubtful} in doubt and kept"
        )


def said(frame: Frame) -> str:
    """What was found, for people."""
    x, y, theta = frame.a_from_b
    n, k = frame.things
    return (
        f"lies at {x:.3f}, {y:.3f} m, turned by {np.degrees(theta):.3f} deg; {n - k} of {n} lamps, vents and the like "
        f"of the overlap are in both; a wrong place looks as good with a chance of {frame.false_alarm:.1g}"
    )


def join(a: MapContent, b: MapContent, frame: Frame) -> Joined:
    """a with b in its frame. What both have keeps a's place and name: 'refine' brings both together."""
    there = moved(b, frame.a_from_b)
    turns = quarter_turns(there.axis_rad, a.axis_rad)
    theirs = replace(there.landmarks, crossing_type=turned_type(there.landmarks.crossing_type, turns))
    i, j = _one_to_one(*pairs(a.landmarks, theirs.xy_map_m, theirs.crossing_type), a.landmarks, theirs)
    own = differences(a, of_pairs(len(a.landmarks), i), there, theirs.xy_map_m)
    other = differences(replace(there, landmarks=theirs), of_pairs(len(theirs), j), a, a.landmarks.xy_map_m)
    stay, come = ~own.gone, ~other.shared & ~other.gone
    kept = _seen_by_both(a.landmarks, theirs, i, j).of(stay)
    seen_s = a.seen_s.copy()
    seen_s[i] = both_times(a.seen_s[i], b.seen_s[j])
    new = theirs.of(come)
    ids = free_ids(new.ids, a.landmarks.ids)
    columns = ("xy_map_m", "cov_m2", "crossing_type", "sightings", "expected")
    landmarks = Landmarks(
        np.concatenate([kept.ids, ids]), *(np.concatenate([getattr(kept, c), getattr(new, c)]) for c in columns)
    )
    order = np.argsort(landmarks.ids, kind="stable")
    name = dict(zip(theirs.ids[j].tolist(), a.landmarks.ids[i].tolist(), strict=True))
    name |= dict(zip(new.ids.tolist(), ids.tolist(), strict=True))
    gone = a.landmarks.ids[own.gone]
    taken = {s.name for s in a.sessions}
    ours = tuple(replace(k, landmark=np.where(np.isin(k.landmark, gone), NO_LANDMARK, k.landmark)) for k in a.key_poses)
    poses = tuple(renamed(k, name, turns) for k in there.key_poses if k.session not in taken)
    content = replace(
        a,
        landmarks=landmarks.of(order),
        seen_s=np.concatenate([seen_s[stay], b.seen_s[come]])[order],
        key_poses=(*ours, *poses),
        sessions=(*a.sessions, *(s for s in b.sessions if s.name not in taken)),
    )
    doubtful = sum(counted(~d.shared & ~d.beyond & ~d.gone) for d in (own, other))
    return Joined(content, len(i), counted(come), counted(own.gone), counted(other.gone), doubtful)


def _one_to_one(i: Ints, j: Ints, a: Landmarks, b: Landmarks) -> tuple[Ints, Ints]:
    """Of pairs that share a landmark of a only the nearest."""
    off = np.hypot(*(a.xy_map_m[i] - b.xy_map_m[j]).T)
    order = np.lexsort((off, i))
    first = order[np.flatnonzero(np.diff(i[order], prepend=-1))]
    return i[first], j[first]


def _seen_by_both(a: Landmarks, b: Landmarks, i: Ints, j: Ints) -> Landmarks:
    sightings, expected = a.sightings.copy(), a.expected.copy()
    sightings[i] += b.sightings[j]
    expected[i] += b.expected[j]
    return replace(a, sightings=sightings, expected=expected)


def join_command(options: argparse.Namespace) -> int:
    """The command; 0, or an error where the maps are not to be joined."""
    other = sources.read(options.other, None)

    def both(content: MapContent) -> MapContent:
        frame = frame_of(content, other)
        if frame.refused:
            raise CeilvoError(f"{options.other}: not joined: {frame.refused}; drive where both maps are, and try again")
        print(f"{options.other}: {said(frame)}")
        done = join(content, other, frame)
        print(f"{options.other}: {done}")
        return done.content

    return apply(Where.of(options), both, f"join {options.other.name}")


def join_all(contents: Sequence[MapContent]) -> tuple[MapContent, list[tuple[int, Frame]], list[tuple[int, Frame]]]:
    """The first with all that can be joined to it, one after the other; which were, and which were not, and why."""
    whole, left, done = contents[0], list(range(1, len(contents))), []
    refused: dict[int, Frame] = {}
    while left:
        before = len(left)
        for k in list(left):
            frame = frame_of(whole, contents[k])
            if frame.refused:
                refused[k] = frame
                continue
            whole = join(whole, contents[k], frame).content
            left.remove(k)
            done.append((k, frame))
        if len(left) == before:
            break
    return whole, done, [(k, refused[k]) for k in left]
