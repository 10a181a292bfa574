"""Votes of ridges and edges along the rows and columns of an aligned picture.

Stretches of a possible line are averaged first; what stands out across them is clipped, so that no single stretch
decides, and summed along the line. The sum is judged by the root of the number of stretches that could have voted.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ceilvo.daemon.vision.faint.level_picture import Aligned, Gray
from ceilvo.robust import MAD_TO_SIGMA, median
from ceilvo.types import Array, Ints, LineKind

Array32 = NDArray[np.float32]

STRETCH_PX = 8
"""Length that is averaged before it is clipped; chosen: half a degree off its direction a line moves 0.07 px in it."""
_NARROW_PX, _WIDE_PX, _SIDE_PX = 0.8, 3.0, 1.2
"""Standard deviations of the two Gaussians whose difference answers to ridges, and of the derivative that answers to
edges; the first from a prototype on a real photograph, the others chosen."""
_CLIP_SIGMAS = 2.5
"""Of a stretch's answer; chosen: four stretches of a stain do not make a line."""
_CLIPPED = 0.98
"""Standard deviation of normal noise that is clipped there."""
RADIUS_PX = 8
"""Half the length of the filters: 2.7 of the wide standard deviation."""
_STRONG_SIGMAS = 15.0
"""Of a stretch's answer, from which it and what is beside it is left to single edge points; chosen: the frame of a lamp
or a vent hides a joint along it, and would be taken for it."""
_BESIDE_BOX = np.ones((1, 2 * (RADIUS_PX + 4) + 1), np.uint8)
"""Places to either side of it where filters still see it or what it fades into; chosen: 4 px of that."""
_JUDGED_SIGMAS = 8.0
"""Clip of the answers by which ridges and edges are compared; chosen: of a stronger one it is plain what it is."""
_EDGE_RATIO = 1.5
"""By which edges must answer more than ridges; the edge's filter answers to a groove's sides as much as the ridge's to
the groove (0.95), and to an edge more than twice as much as the other (2.2)."""
_FEWEST = 6
"""Stretches that could have voted; chosen: 48 px."""
_LEAST_NOISE = 0.05
"""Grey levels of a stretch's answer; chosen: the means of eight whole numbers are no finer."""
_PEAK_PX = 3
"""A peak is higher than all votes this near; chosen: what a groove's sides are apart."""
_NOISE_STRIDE = 7
"""Every seventh answer tells the noise; chosen: thousands remain."""


@dataclass(frozen=True, slots=True)
class Answers:
    """What filters answered across one axis, in standard deviations of their noise.

    Attributes:
        ridge: (S, N) for S stretches along the lines, N places across: how much darker than on either side.
        edge: (S, N) how much brightness rises.
        known: (S, N) whether all pixels that an answer is made of show the ceiling.
    """

    ridge: Array32
    edge: Array32
    known: NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class Peaks:
    """Lines that the votes show: column of the answers, LineKind, votes in standard deviations (K,), dark or not."""

    at: Ints
    kind: Ints
    votes: Array
    dark: NDArray[np.bool_]


def _kernels() -> tuple[Array32, Array32]:
    x = np.arange(-RADIUS_PX, RADIUS_PX + 1, dtype=np.float64)
    narrow, wide, side = (np.exp(-0.5 * (x / s) ** 2) for s in (_NARROW_PX, _WIDE_PX, _SIDE_PX))
    ridge = wide / wide.sum() - narrow / narrow.sum()
    edge = x * side
    return ridge.astype(np.float32)[None], (edge / np.abs(edge).sum()).astype(np.float32)[None]


_KERNELS = _kernels()
_RIDGE_BOX = np.ones((1, 2 * RADIUS_PX + 1), np.uint8)


def answers(picture: Aligned, axis: int) -> Answers:
    """Across the normals of axis 0 (columns) or 1 (rows)."""
    gray, usable = (v if axis == 0 else v.T for v in (picture.gray, picture.usable))
    gray = _stretches(gray)
    whole = np.asarray(_narrowest(usable) == 255, np.uint8)
    known = np.asarray(cv2.erode(whole, _RIDGE_BOX), bool)
    ridge, edge = (_normalised(np.asarray(cv2.filter2D(gray, cv2.CV_32F, k), np.float32), known) for k in _KERNELS)
    strong = np.asarray(np.maximum(np.abs(ridge), np.abs(edge)) > _STRONG_SIGMAS, np.uint8)
    known &= np.asarray(cv2.dilate(strong, _BESIDE_BOX)) == 0
    return Answers(ridge * known, edge * known, known)


def _stretches(picture: Gray) -> Array32:
    """(S, N) means over STRETCH_PX rows."""
    rows = len(picture) // STRETCH_PX
    whole = picture[: rows * STRETCH_PX].reshape(rows, STRETCH_PX, -1)
    return np.asarray(whole.sum(axis=1, dtype=np.uint16) * np.float32(1.0 / STRETCH_PX), np.float32)


def _narrowest(usable: Gray) -> Gray:
    """(S, N) least of STRETCH_PX rows."""
    rows = len(usable) // STRETCH_PX
    return np.asarray(usable[: rows * STRETCH_PX].reshape(rows, STRETCH_PX, -1).min(axis=1), np.uint8)


def _normalised(answer: Array32, known: NDArray[np.bool_]) -> Array32:
    """In standard deviations; 0 where not known."""
    sample = answer[known][::_NOISE_STRIDE]
    noise = max(MAD_TO_SIGMA * median(np.abs(sample)), _LEAST_NOISE)
    return np.asarray(np.where(known, answer / np.float32(noise), np.float32(0.0)), np.float32)


def profile(answer: Array32, known: NDArray[np.bool_], clip: float = _CLIP_SIGMAS) -> Array:
    """(N,) votes: the clipped answers' sum over the root of how many stretches could have voted."""
    votes = np.clip(answer, -clip, clip).sum(axis=0, dtype=np.float64)
    count = known.sum(axis=0)
    score = np.where(count >= _FEWEST, votes / (_CLIPPED * np.sqrt(np.maximum(count, 1))), 0.0)
    return np.asarray(score, np.float64)


def peaks(found: Answers, least: float, apart_px: float) -> Peaks:
    """Lines with at least so many standard deviations of votes; of those closer than apart_px the stronger one.

    Whichever filter answers most says what a line is: beside an edge there is a weaker ridge, beside a ridge are two
    weaker edges.
    """
    ridge, edge = profile(found.ridge, found.known), profile(found.edge, found.known)
    judged_ridge, judged_edge = (profile(v, found.known, _JUDGED_SIGMAS) for v in (found.ridge, found.edge))
    judged_edge /= _EDGE_RATIO
    rows = []
    for votes, judged, kind, dark in (
        (ridge, judged_ridge, LineKind.GROOVE, True),
        (-ridge, -judged_ridge, LineKind.GROOVE, False),
        (edge, judged_edge, LineKind.RISING, False),
        (-edge, -judged_edge, LineKind.FALLING, False),
    ):
        spread = max(MAD_TO_SIGMA * median(np.abs(votes)), 1.0)
        at = _maxima(votes, least * spread)
        rows += [(int(k), int(kind), v / spread, dark, s) for k, v, s in zip(at, votes[at], judged[at], strict=True)]
    rows.sort(key=lambda row: -row[4])
    kept: list[tuple[int, int, float, bool, float]] = []
    for row in rows:
        if all(abs(row[0] - other[0]) >= apart_px for other in kept):
            kept.append(row)
    kept.sort()
    return Peaks(
        np.array([row[0] for row in kept], np.int64),
        np.array([row[1] for row in kept], np.int64),
        np.array([row[2] for row in kept], np.float64),
        np.array([row[3] for row in kept], bool),
    )


def _maxima(votes: Array, least: float) -> Ints:
    highest = cv2.dilate(votes[None], np.ones((1, 2 * _PEAK_PX + 1), np.uint8))[0]
    return np.asarray(np.flatnonzero((votes >= least) & (votes >= highest)), np.int64)
