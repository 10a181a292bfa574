"""Pose and landmarks as one Gaussian: a window of landmarks with all their correlations, and the rest without."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ceilvo.daemon.slam.conditional import Bools, along_the_turn, hold, turn_about
from ceilvo.daemon.slam.pose_filter import JITTER
from ceilvo.daemon.slam.spatial_index import ChangingIndex, in_box, packed, unpacked
from ceilvo.se2 import compose, rotation, wrap
from ceilvo.types import Array, Ints, Landmarks, Motion, frozen

WINDOW = 160
"""Landmarks whose correlations are kept; beyond, those seen least recently keep their own covariance only."""


_COLUMNS = (
    *("ids", "crossing_type", "sightings", "expected", "doubt"),
    *("seen_at", "confirmed", "slot", "table_xy", "table_packed"),
)
_MOST = np.iinfo(np.int32).max
"""Sightings of a map that is loaded count up to here: a building full of landmarks would pay for wider columns."""
_ROOM = 64
"""Rows by which a table grows at least, and by half of what it has; chosen."""
Counts = NDArray[np.int32]


def _no_ints() -> Ints:
    return np.empty(0, np.int64)


def _no_counts() -> Counts:
    return np.empty(0, np.int32)


@dataclass(slots=True)
class JointMap:
    """Mean (3 + 2 W,) and covariance of the pose and the W landmarks in the window, and a table of all L landmarks.

    Labels are rows of the table; those that are confirmed come first. A row in the window has a slot; its place in the
    table is then out of date until it leaves. What is done to some landmarks costs nothing for the others.

    Attributes:
        mean, cov: (3 + 2 W,), (3 + 2 W, 3 + 2 W) [m, m, rad, m, m, ...].
        label_of: (W,) row of the landmark in each slot.
        ids, crossing_type, sightings: (L,) as in Landmarks.
        seen_at: (L,) update that saw it last.
        confirmed: (L,) seen often enough to be shown.
        slot: (L,) its place in the window, -1 outside.
        table_xy, table_packed: (L, 2) means and (L, 3) covariances xx, xy, yy of those outside.
        next_id: for the next landmark that is born.
        expected: (L,) as in Landmarks.
        doubt: (L,) evidence that it is gone, see visibility.gone.
        size: confirmed landmarks.
        index: of those outside of the window.
    """

    mean: Array
    cov: Array
    label_of: Ints = field(default_factory=_no_ints)
    ids: Ints = field(default_factory=_no_ints)
    crossing_type: NDArray[np.int16] = field(default_factory=lambda: np.empty(0, np.int16))
    sightings: Counts = field(default_factory=_no_counts)
    seen_at: Counts = field(default_factory=_no_counts)
    confirmed: NDArray[np.bool_] = field(default_factory=lambda: np.empty(0, bool))
    slot: Counts = field(default_factory=_no_counts)
    table_xy: Array = field(default_factory=lambda: np.empty((0, 2)))
    table_packed: Array = field(default_factory=lambda: np.empty((0, 3)))
    next_id: int = 0
    expected: Counts = field(default_factory=_no_counts)
    doubt: NDArray[np.float32] = field(default_factory=lambda: np.empty(0, np.float32))
    size: int = field(init=False)
    index: ChangingIndex = field(init=False, repr=False, default_factory=ChangingIndex)

    def __post_init__(self) -> None:
        """States of older recordings have no counts, and confirmed landmarks anywhere."""
        if len(self.expected) != len(self):
            self.expected, self.doubt = self.sightings.copy(), np.zeros(len(self), np.float32)
        first = np.flatnonzero(self.confirmed)
        self.size = 0
        self.confirm(first)

    @staticmethod
    def at(pose: Array, cov: Array) -> JointMap:
        """Without landmarks, at a pose (3,) with cov (3, 3)."""
        mean = np.array(pose, np.float64)
        mean[2] = wrap(float(mean[2]))
        return JointMap(mean, np.array(cov, np.float64) + np.diag(JITTER))

    def __len__(self) -> int:
        return len(self.crossing_type)

    # -- the pose

    @property
    def pose(self) -> Array:
        return self.mean[:3]

    @property
    def pose_cov(self) -> Array:
        return self.cov[:3, :3]

    def move(self, motion: Motion) -> None:
        """Compose the pose with a motion; the landmarks stay (eq. 17)."""
        x, y, theta = self.mean[0], self.mean[1], float(self.mean[2])
        self.mean[:3] = compose(self.mean[:3], motion.prev_from_curr)
        f, g = np.eye(3), np.eye(3)
        f[0, 2], f[1, 2] = y - self.mean[1], self.mean[0] - x
        g[:2, :2] = rotation(theta)
        self.cov[:3] = f @ self.cov[:3]
        self.cov[3:, :3] = self.cov[:3, 3:].T
        own = self.cov[:3, :3] @ f.T + g @ motion.cov @ g.T
        self.cov[:3, :3] = 0.5 * (own + own.T)

    def put_pose(self, pose: Array, cov: Array) -> None:
        """A new pose that knows nothing of the map."""
        self.mean[:3] = pose
        self.cov[:3, :], self.cov[:, :3] = 0.0, 0.0
        self.cov[:3, :3] = cov + np.diag(JITTER)

    # -- the landmarks

    def rows(self, labels: Ints) -> Ints:
        """(2 K,) rows of mean and cov of landmarks in the window."""
        first = 3 + 2 * self.slot[labels].astype(np.int64)
        return np.column_stack([first, first + 1]).ravel()

    def xy(self, labels: Ints) -> Array:
        """(K, 2) means."""
        out, slot = self.table_xy[labels], self.slot[labels]
        inside = slot >= 0
        out[inside] = self.mean[3:].reshape(-1, 2)[slot[inside]]
        return out

    def packed(self, labels: Ints) -> Array:
        """(K, 3) covariances xx, xy, yy."""
        out, slot = self.table_packed[labels], self.slot[labels]
        a = 3 + 2 * slot[slot >= 0][:, None]
        out[slot >= 0] = self.cov[a + np.array([0, 0, 1]), a + np.array([0, 1, 1])]
        return out

    def kinds(self, labels: Ints) -> Ints:
        """(K,) types."""
        return self.crossing_type[labels].astype(np.int64)

    def load(self, landmarks: Landmarks) -> None:
        """Append a map; its landmarks enter the window when they are seen."""
        new = self._append(landmarks.crossing_type, np.minimum(landmarks.sightings, _MOST), landmarks.ids)
        self.expected[new] = np.minimum(landmarks.expected, _MOST)
        self.table_xy[new], self.table_packed[new] = landmarks.xy_map_m, packed(landmarks.cov_m2)
        self.index.add(new, self.table_xy[new])
        self.confirm(new)

    def _append(self, kind: Ints, sightings: Ints, ids: Ints | None = None) -> Ints:
        """Unconfirmed landmarks at nowhere; returns their labels."""
        old = len(self)
        self._resize(old + len(kind))
        new = slice(old, len(self))
        self.ids[new] = self.next_id + np.arange(len(kind)) if ids is None else ids
        self.next_id = max(self.next_id, int(np.max(self.ids[new], initial=-1)) + 1)
        self.crossing_type[new], self.sightings[new], self.expected[new] = kind, sightings, sightings
        self.doubt[new], self.seen_at[new], self.confirmed[new], self.slot[new] = 0.0, 0, False, -1
        return np.arange(old, len(self))

    def _resize(self, rows: int) -> None:
        for name in _COLUMNS:
            setattr(self, name, _resized(getattr(self, name), rows))

    def _move(self, source: Ints, target: Ints) -> None:
        """Rows `source` to `target`, all at once; what was there is among `source` or forgotten."""
        out = self.slot[source] < 0
        self.index.remove(source[out], self.table_xy[source[out]])
        for name in _COLUMNS:
            column = getattr(self, name)
            column[target] = column[source]
        self.index.add(target[out], self.table_xy[target[out]])
        self.label_of[self.slot[target[~out]]] = target[~out]

    def confirm(self, labels: Ints) -> None:
        """Let landmarks be shown; labels of unconfirmed ones change."""
        labels = labels[labels >= self.size]
        if not len(labels):
            return
        end = self.size + len(labels)
        enter = labels[labels >= end]
        leave = np.setdiff1d(np.arange(self.size, end), labels)
        self._move(np.concatenate([enter, leave]), np.concatenate([leave, enter]))
        self.confirmed[self.size : end] = True
        self.size = end

    def _widen(self, labels: Ints, xy: Array, cross: Array, own: Array) -> None:
        """Into the window: means (K, 2), their covariance with the state (2 K, S) and with each other (2 K, 2 K)."""
        size = len(self.mean)
        self.slot[labels] = (size - 3) // 2 + np.arange(len(labels))
        self.label_of = np.concatenate([self.label_of, labels])
        self.mean = np.concatenate([self.mean, xy.ravel()])
        wider = np.empty((len(self.mean), len(self.mean)))
        wider[:size, :size], wider[size:, :size], wider[:size, size:], wider[size:, size:] = (
            self.cov,
            cross,
            cross.T,
            own,
        )
        self.cov = wider

    def bring_in(self, labels: Ints) -> None:
        """Landmarks in the table only enter the window with their own covariance."""
        labels = labels[self.slot[labels] < 0]
        if not len(labels):
            return
        own = np.zeros((2 * len(labels), 2 * len(labels)))
        for i, block in enumerate(unpacked(self.table_packed[labels])):
            own[2 * i : 2 * i + 2, 2 * i : 2 * i + 2] = block
        self.index.remove(labels, self.table_xy[labels])
        self._widen(labels, self.table_xy[labels], np.zeros((2 * len(labels), len(self.mean))), own)

    def give_birth(self, xy_base: Array, var: Array, kind: Ints, now: int) -> Ints:
        """Unconfirmed landmarks where the pose sees them: xy_base (K, 2), var (K, 2) along base x and y."""
        r = rotation(float(self.mean[2]))
        arm = xy_base @ r.T
        h = np.zeros((2 * len(kind), 3))
        h[0::2, 0] = h[1::2, 1] = 1.0
        h[0::2, 2], h[1::2, 2] = -arm[:, 1], arm[:, 0]
        cross = h @ self.cov[:3]
        own = cross[:, :3] @ h.T
        for i, v in enumerate(var):
            own[2 * i : 2 * i + 2, 2 * i : 2 * i + 2] += (r * v) @ r.T
        labels = self._append(kind, np.ones(len(kind), np.int64))
        self.seen_at[labels] = now
        self._widen(labels, self.mean[:2] + arm, cross, own)
        return labels

    def held(self, below_id: int) -> Bools:
        """(3 + 2 W,) rows of mean and cov of landmarks with smaller ids; (0,) for none."""
        landmarks = self.ids[self.label_of] < below_id
        return np.concatenate([np.zeros(3, bool), np.repeat(landmarks, 2)]) if np.any(landmarks) else landmarks[:0]

    def merge(self, keep: int, drop: int, gate_chi2: float, learnt_from: int = 0) -> bool:
        """Make one of two landmarks by observing that their difference is zero, where that is plausible.

        Landmarks with ids below learnt_from stay as they are.
        """
        self.bring_in(np.array([keep, drop]))
        rows = self.rows(np.array([keep, drop]))
        cross = self.cov[:, rows[:2]] - self.cov[:, rows[2:]]
        off = self.mean[rows[:2]] - self.mean[rows[2:]]
        total = cross[rows[:2]] - cross[rows[2:]] + JITTER[0] * np.eye(2)
        if float(off @ np.linalg.solve(total, off)) > gate_chi2:
            return False
        gain = np.linalg.solve(total, cross.T).T
        step, less = -gain @ off, gain @ cross.T
        hold(step, less, self.held(learnt_from))
        step = along_the_turn(step)
        self.mean = self.mean + step
        self.mean[2] = wrap(float(self.mean[2]))
        cov = self.cov - less
        self.cov = 0.5 * (cov + cov.T)
        turn_about(self.cov, step)
        self.sightings[keep] += self.sightings[drop]
        self.expected[keep] = max(self.expected[keep], self.expected[drop], self.sightings[keep])
        self.forget(np.array([drop]))
        return True

    def forget(self, labels: Ints) -> None:
        """Drop landmarks; the last ones take their labels."""
        if not len(labels):
            return
        labels = np.unique(labels)
        self._narrow(labels[self.slot[labels] >= 0])
        self.index.remove(labels, self.table_xy[labels])
        first = labels[labels < self.size]
        begin, end = self.size - len(first), self.size
        self._fill(first, end)
        self.size = begin
        self._fill(np.concatenate([np.arange(begin, end), labels[len(first) :]]), len(self))
        self._resize(len(self) - len(labels))

    def _fill(self, holes: Ints, end: int) -> None:
        """Let the last landmarks of the rows before `end` move to rows without one."""
        begin = end - len(holes)
        self._move(np.setdiff1d(np.arange(begin, end), holes), holes[holes < begin])

    def _narrow(self, labels: Ints) -> None:
        """Out of the window, keeping their own covariance in the table."""
        if not len(labels):
            return
        self.table_xy[labels], self.table_packed[labels] = self.xy(labels), self.packed(labels)
        keep = np.ones(len(self.mean), bool)
        keep[self.rows(labels)] = False
        self.mean, self.cov = self.mean[keep], self.cov[np.ix_(keep, keep)]
        self.label_of = self.label_of[keep[3::2]]
        self.slot[labels] = -1
        self.slot[self.label_of] = np.arange(len(self.label_of))
        self.index.add(labels, self.table_xy[labels])

    def bound(self, window: int = WINDOW) -> None:
        """Let the landmarks that were seen least recently leave the window; an eighth at a time, for moving costs.

        Of those that were seen at once the ones seen least often.
        """
        if len(self.label_of) > window:
            order = np.lexsort((self.sightings[self.label_of], self.seen_at[self.label_of]))
            self._narrow(self.label_of[order[: len(order) - window + window // 8]])

    def near(self, low_m: Array, high_m: Array) -> Ints:
        """Labels, in order, of the landmarks in a box."""
        if not self.index.made:
            out = np.flatnonzero(self.slot < 0)
            self.index.make(out, self.table_xy[out])
        labels = np.concatenate([self.index.near(low_m, high_m), self.label_of])
        return np.sort(labels[in_box(self.xy(labels), low_m, high_m)])

    def summary(self, labels: Ints) -> Landmarks:
        return Landmarks(
            ids=self.ids[labels],
            xy_map_m=frozen(self.xy(labels)),
            cov_m2=frozen(unpacked(self.packed(labels))),
            crossing_type=self.kinds(labels),
            sightings=self.sightings[labels].astype(np.int64),
            expected=self.expected[labels].astype(np.int64),
        )


def _resized(column: NDArray[Any], rows: int) -> NDArray[Any]:
    """A column with so many rows, those beyond its own not set: the beginning of a larger array that has room.

    Where it is that already and the room is enough, nothing is copied.
    """
    whole = column.base
    if (
        isinstance(whole, np.ndarray)
        and whole.base is None
        and len(whole) >= rows
        and whole.shape[1:] == column.shape[1:]
        and whole.dtype == column.dtype
        and whole.ctypes.data == column.ctypes.data
    ):
        return whole[:rows]
    if rows <= len(column):
        return column[:rows]
    whole = np.empty((rows + max(_ROOM, len(column) // 2), *column.shape[1:]), column.dtype)
    whole[: len(column)] = column
    return whole[:rows]
