"""Solves the normal equations: poses are eliminated, landmarks in an order that leaves a band, the border last."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import LinAlgError, cho_solve_banded, cholesky_banded
from scipy.linalg.lapack import dtbtrs
from scipy.sparse import bsr_array, coo_array, csr_array
from scipy.sparse.csgraph import connected_components, reverse_cuthill_mckee

from ceilvo.daemon.refinement.equations import Equations
from ceilvo.errors import CeilvoError
from ceilvo.types import Array, Ints

_LEAST_PART = 4096
"""Unknowns of a part that is decomposed by itself; chosen: smaller ones cost little."""
_AT_ONCE = 1024
"""Landmarks whose rows are made at once; chosen: 20 MB where each is seen with a hundred others from several places."""
MOST_BAND_BYTES = 6 * 2**30
"""Of the band; a hall of 40 m x 30 m with 30,000 landmarks takes .5 GB."""


class RefinementError(CeilvoError):
    """A map that cannot be refined: in one line why, and what to do."""


@dataclass(frozen=True)
class Step:
    """Changes of poses (K, 3), landmarks (L, 2) and border (B,)."""

    poses: Array
    landmarks: Array
    border: Array


class Solver:
    """Keeps the order of the unknowns from round to round: what is tied to what does not change.

    Args:
        view, landmark: (O,) what is seen from where, view ascending.
        poses, landmarks: how many.
        links: poses that are tied to the one before; they and those before are not eliminated.
    """

    def __init__(self, view: Ints, landmark: Ints, poses: int, landmarks: int, links: Ints) -> None:
        self._view, self._landmark, self._landmarks = view, landmark, landmarks
        kept = np.zeros(poses, bool)
        kept[links] = kept[links - 1] = True
        self._kept, self._gone = np.flatnonzero(kept), np.flatnonzero(~kept)
        self._slot = np.full(poses, -1)
        self._slot[self._gone] = np.arange(len(self._gone))
        self._place = np.full(poses, -1)
        self._place[self._kept] = 2 * landmarks + 3 * np.arange(len(self._kept))
        self._of_gone = np.flatnonzero(~kept[view])
        self._of_kept = np.flatnonzero(kept[view])
        self._order: Ints | None = None
        self._size = 2 * landmarks + 3 * len(self._kept)
        self._ends: list[int] = []

    def step(self, e: Equations, damping: float, noise: Array | None = None) -> Step:
        """One step; damping is added to the diagonal, relative to it.

        Args:
            noise: (n, N) standard normal, for drawn(), which is made the errors that it stands for.

        Raises:
            RefinementError: the equations are singular, or too wide for the memory.
        """
        grow, border_size = 1.0 + damping, len(e.b)
        pp, ll, bb = (m * (1.0 + (grow - 1.0) * np.eye(m.shape[-1])) for m in (e.pp, e.ll, e.bb))
        gone = pp[self._gone]
        inverse = np.linalg.inv(gone)
        a = self._blocks(e.lp[self._of_gone])
        middle = bsr_array((inverse, np.arange(len(gone)), np.arange(len(gone) + 1)), shape=(3 * len(gone),) * 2)
        through = a @ middle if len(gone) else a
        to_border = np.zeros((self._size, border_size + 1))
        to_border[: 2 * self._landmarks, :border_size] = e.lb.reshape(-1, border_size)
        to_border[: 2 * self._landmarks, border_size] = e.l.ravel()
        at = self._place[self._kept][:, None] + np.arange(3)
        to_border[at, :border_size], to_border[at, border_size] = e.pb[self._kept], e.p[self._kept]
        right = np.concatenate([e.pb[self._gone], e.p[self._gone, :, None]], axis=2)
        to_border[: 2 * self._landmarks] -= through @ right.reshape(-1, border_size + 1)
        direct = self._direct(e, pp, ll)
        if self._order is None:
            self._order, self._ends = _ordered(a, direct)
        solved = self._solved(_Reduced(direct, through, a), to_border, noise)
        folded = np.concatenate([bb, e.b[:, None]], axis=1) - to_border[:, :border_size].T @ solved
        folded -= np.einsum("kib,kij,kjc->bc", right[..., :border_size], inverse, right, optimize=True)
        border = -np.linalg.solve(folded[:, :border_size], folded[:, border_size])
        x = -(solved[:, border_size] + solved[:, :border_size] @ border)
        poses = np.empty((len(pp), 3))
        poses[self._kept] = x[at]
        rest = right[..., border_size] + right[..., :border_size] @ border
        rest += (a.T @ x[: 2 * self._landmarks]).reshape(-1, 3)
        poses[self._gone] = -np.einsum("kij,kj->ki", inverse, rest)
        self.border_cov = np.linalg.inv(folded[:, :border_size])
        return Step(poses, x[: 2 * self._landmarks].reshape(-1, 2), border)

    def drawn(self, e: Equations, rng: np.random.Generator, count: int) -> Array:
        """(count, L, 2) errors of the landmarks, drawn from what the equations leave; the border is held."""
        noise = rng.standard_normal((self._size, count))
        self.step(e, 0.0, noise)
        return np.asarray(noise[: 2 * self._landmarks].T.reshape(count, -1, 2))

    def _blocks(self, lp: Array) -> bsr_array:
        """(2 L, 3 G) landmarks by eliminated poses."""
        order = np.argsort(self._landmark[self._of_gone], kind="stable")
        rows = np.bincount(self._landmark[self._of_gone], minlength=self._landmarks)
        columns = self._slot[self._view[self._of_gone]][order]
        shape = (2 * self._landmarks, 3 * len(self._gone))
        return bsr_array((lp[order], columns, np.concatenate([[0], np.cumsum(rows)])), shape=shape)

    def _direct(self, e: Equations, pp: Array, ll: Array) -> coo_array:
        """What ties landmarks, and poses that are kept, to each other directly."""
        parts = [_Blocks(2 * np.arange(self._landmarks), 2 * np.arange(self._landmarks), ll)]
        first, second = 2 * e.pairs[:, 0], 2 * e.pairs[:, 1]
        for i, a in enumerate((first, second)):
            for j, b in enumerate((first, second)):
                parts.append(_Blocks(a, b, e.pair[:, 2 * i : 2 * i + 2, 2 * j : 2 * j + 2]))
        if len(self._kept):
            place = self._place
            parts.append(_Blocks(place[self._kept], place[self._kept], pp[self._kept]))
            for i, a in enumerate((place[e.links - 1], place[e.links])):
                for j, b in enumerate((place[e.links - 1], place[e.links])):
                    parts.append(_Blocks(a, b, e.link[:, 3 * i : 3 * i + 3, 3 * j : 3 * j + 3]))
            landmark, pose = 2 * self._landmark[self._of_kept], place[self._view[self._of_kept]]
            parts.append(_Blocks(landmark, pose, e.lp[self._of_kept]))
            parts.append(_Blocks(pose, landmark, e.lp[self._of_kept].transpose(0, 2, 1)))
        rows, columns, values = (np.concatenate(v) for v in zip(*(p.entries() for p in parts), strict=True))
        direct = coo_array((values, (rows, columns)), shape=(self._size, self._size))
        direct.sum_duplicates()
        return direct

    def _solved(self, matrix: _Reduced, right: Array, noise: Array | None) -> Array:
        """The inverse of the matrix times (n, m), by a Cholesky decomposition of a band for each part of the survey
        that is tied to no other."""
        order = self._order
        assert order is not None
        rank = np.empty(self._size, np.int32)
        rank[order] = np.arange(self._size, dtype=np.int32)
        out = np.empty_like(right)
        drawn = np.empty_like(noise) if noise is not None else None
        for begin, end in zip([0, *self._ends[:-1]], self._ends, strict=True):
            which = order[begin:end]
            band = self._decomposed(matrix, rank, begin, end)
            out[which] = cho_solve_banded((band, True), right[which], check_finite=False)
            if noise is not None and drawn is not None:
                drawn[which], info = dtbtrs(band, noise[begin:end], uplo="L", trans="T")
                assert info == 0
            del band  # before the next one is made
        if noise is not None and drawn is not None:
            noise[:] = drawn
        return out

    def _decomposed(self, matrix: _Reduced, rank: NDArray[np.int32], begin: int, end: int) -> Array:
        """The lower band (w, n) of a part, decomposed."""
        width = matrix.width(rank, begin, end)
        if 8 * width * (end - begin) > MOST_BAND_BYTES:
            raise RefinementError(
                f"refinement needs {8e-9 * width * self._size:.0f} GB for {self._landmarks} landmarks, expected at "
                f"most {MOST_BAND_BYTES / 2**30:.0f} GB: refine the building's parts one by one (ceilvod map crop)"
            )
        band = np.zeros((width, end - begin), order="F")
        matrix.draw(band, rank, begin, end)
        try:
            return np.asarray(cholesky_banded(band, overwrite_ab=True, lower=True, check_finite=False))
        except LinAlgError as e:
            raise RefinementError(f"the views do not tie the map together: {e}") from e


@dataclass(frozen=True)
class _Reduced:
    """What is left of the equations once poses are eliminated: `direct` less `through` times `by_pose` transposed,
    which is made some landmarks at a time, for all of it is larger than its band.

    Attributes:
        direct: (n, n) landmarks first, then poses that are kept.
        through, by_pose: (2 L, 3 G) in blocks, landmarks by eliminated poses.
    """

    direct: coo_array
    through: bsr_array
    by_pose: bsr_array

    def width(self, rank: NDArray[np.int32], begin: int, end: int) -> int:
        """Of the band that holds all entries between unknowns of ranks begin to end."""
        row, column = rank[self.direct.row], rank[self.direct.col]
        own = (row >= begin) & (row < end)
        widest = int(np.max(row[own] - column[own], initial=0))
        poses = np.repeat(rank[: self.through.shape[0] : 2], np.diff(self.by_pose.indptr))
        first, last = np.full(self.by_pose.shape[1] // 3, end), np.full(self.by_pose.shape[1] // 3, begin)
        own = (poses >= begin) & (poses < end)
        np.minimum.at(first, self.by_pose.indices[own], poses[own])
        np.maximum.at(last, self.by_pose.indices[own], poses[own])
        return 1 + max(widest, 1 + int(np.max(last - first, initial=0)))

    def draw(self, band: Array, rank: NDArray[np.int32], begin: int, end: int) -> None:
        """Add the entries between unknowns of ranks begin to end to their lower band."""
        row, column = rank[self.direct.row], rank[self.direct.col]
        low = (row >= column) & (row >= begin) & (row < end)
        row, column = row[low] - begin, column[low] - begin
        band[row - column, column] += self.direct.data[low]
        place = rank[: self.through.shape[0] : 2]
        own = np.flatnonzero((place >= begin) & (place < end))
        seen = self.by_pose.T.tobsr(blocksize=(3, 2))
        for some in np.array_split(own, -(-len(own) // _AT_ONCE)):
            product = (_block_rows(self.through, some) @ seen).tobsr(blocksize=(2, 2))
            row = np.repeat(place[some], np.diff(product.indptr)) - begin
            column = place[product.indices] - begin
            for i, j in ((0, 0), (1, 0), (1, 1), (0, 1)):
                low = row > column if i < j else row >= column
                r, c = row[low] + i, column[low] + j
                band[r - c, c] -= product.data[low, i, j]


def _block_rows(matrix: bsr_array, which: Ints) -> bsr_array:
    """Some of the rows of blocks."""
    counts = np.diff(matrix.indptr)[which]
    ends = np.cumsum(counts)
    at = np.arange(int(ends[-1])) + np.repeat(matrix.indptr[which] - (ends - counts), counts)
    size, columns = matrix.blocksize[0] * len(which), matrix.shape[1]
    return bsr_array((matrix.data[at], matrix.indices[at], np.append(0, ends)), shape=(size, columns))


def _ordered(by_pose: bsr_array, direct: coo_array) -> tuple[Ints, list[int]]:
    """The unknowns in the order of the band (Reverse Cuthill and McKee), the two of a landmark one after the other, and
    where parts end that are tied to no other."""
    landmarks = by_pose.shape[0] // 2
    shape = (landmarks, by_pose.shape[1] // 3)
    seen = csr_array((np.ones(len(by_pose.indices), bool), by_pose.indices, by_pose.indptr), shape=shape)
    together = (seen @ seen.T).tocoo()
    node = np.arange(direct.shape[0])
    node = np.where(node < 2 * landmarks, node // 2, node - landmarks)
    row, column = (np.concatenate([p, node[d]]) for p, d in ((together.row, direct.row), (together.col, direct.col)))
    count = int(node[-1]) + 1
    pattern = coo_array((np.ones(len(row), np.int8), (row, column)), shape=(count, count)).tocsr()
    del row, column, together
    found = np.asarray(reverse_cuthill_mckee(pattern, symmetric_mode=True), np.int64)
    part = connected_components(pattern, directed=False)[1][found]  # one after the other in the order
    sizes = np.where(found < landmarks, 2, 1)
    ends = np.cumsum(sizes)
    first = np.where(found < landmarks, 2 * found, found + landmarks)
    order = np.repeat(first - (ends - sizes), sizes) + np.arange(int(ends[-1]))
    return order, _grown([*ends[np.flatnonzero(np.diff(part))].tolist(), int(ends[-1])])


def _grown(ends: list[int]) -> list[int]:
    """Ends of parts that are large enough to be worth a band of their own."""
    out = [0]
    for end in ends:
        if end - out[-1] >= _LEAST_PART or end == ends[-1]:
            out.append(end)
    return out[1:]


@dataclass(frozen=True)
class _Blocks:
    """Blocks (T, r, c) whose upper left entries are at row and column (T,)."""

    row: Ints
    column: Ints
    block: Array

    def entries(self) -> tuple[Ints, Ints, Array]:
        _, r, c = self.block.shape
        rows = np.broadcast_to(self.row[:, None, None] + np.arange(r)[:, None], self.block.shape)
        columns = np.broadcast_to(self.column[:, None, None] + np.arange(c), self.block.shape)
        return rows.ravel(), columns.ravel(), self.block.ravel()
