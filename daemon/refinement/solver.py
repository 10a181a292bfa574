"""Solves the normal equations: poses are eliminated, landmarks in an order that leaves a band, the border last."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import LinAlgError, cho_solve_banded, cholesky_banded
from scipy.linalg.lapack import dtbtrs
from scipy.sparse import bsr_array, coo_array
from scipy.sparse.csgraph import reverse_cuthill_mckee

from ceilvo.daemon.refinement.equations import BORDER, Equations
from ceilvo.errors import CeilvoError
from ceilvo.types import Array, Ints

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
        self._band: Array | None = None

    def step(self, e: Equations, damping: float) -> Step:
        """One step; damping is added to the diagonal, relative to it.

        Raises:
            RefinementError: the equations are singular, or too wide for the memory.
        """
        grow = 1.0 + damping
        pp, ll, bb = (m * (1.0 + (grow - 1.0) * np.eye(m.shape[-1])) for m in (e.pp, e.ll, e.bb))
        gone = pp[self._gone]
        inverse = np.linalg.inv(gone)
        a = self._blocks(e.lp[self._of_gone])
        middle = bsr_array((inverse, np.arange(len(gone)), np.arange(len(gone) + 1)), shape=(3 * len(gone),) * 2)
        through = a @ middle if len(gone) else a
        product = (through @ a.T).tocoo()
        product.data *= -1.0
        to_border = np.zeros((self._size, BORDER + 1))
        to_border[: 2 * self._landmarks, :BORDER] = e.lb.reshape(-1, BORDER)
        to_border[: 2 * self._landmarks, BORDER] = e.l.ravel()
        at = self._place[self._kept][:, None] + np.arange(3)
        to_border[at, :BORDER], to_border[at, BORDER] = e.pb[self._kept], e.p[self._kept]
        right = np.concatenate([e.pb[self._gone], e.p[self._gone, :, None]], axis=2)
        to_border[: 2 * self._landmarks] -= through @ right.reshape(-1, BORDER + 1)
        solved = self._solved([self._direct(e, pp, ll), product], to_border)
        folded = np.concatenate([bb, e.b[:, None]], axis=1) - to_border[:, :BORDER].T @ solved
        folded -= np.einsum("kib,kij,kjc->bc", right[..., :BORDER], inverse, right, optimize=True)
        border = -np.linalg.solve(folded[:, :BORDER], folded[:, BORDER])
        x = -(solved[:, BORDER] + solved[:, :BORDER] @ border)
        poses = np.empty((len(pp), 3))
        poses[self._kept] = x[at]
        rest = right[..., BORDER] + right[..., :BORDER] @ border
        rest += (a.T @ x[: 2 * self._landmarks]).reshape(-1, 3)
        poses[self._gone] = -np.einsum("kij,kj->ki", inverse, rest)
        self.border_cov = np.linalg.inv(folded[:, :BORDER])
        return Step(poses, x[: 2 * self._landmarks].reshape(-1, 2), border)

    def drawn(self, rng: np.random.Generator, count: int) -> Array:
        """(count, L, 2) errors of the landmarks, drawn from what the last equations leave; the border is held."""
        assert self._band is not None and self._order is not None
        noise = rng.standard_normal((self._size, count))
        solved, info = dtbtrs(self._band, noise, uplo="L", trans="T")
        assert info == 0
        out = np.empty_like(noise)
        out[self._order] = solved
        return np.asarray(out[: 2 * self._landmarks].T.reshape(count, -1, 2))

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

    def _solved(self, parts: list[coo_array], right: Array) -> Array:
        """The inverse of the sum of the parts times (n, m), by a Cholesky decomposition of the band."""
        order, rank = self._ordered(parts)
        places = [(rank[p.row], rank[p.col], p.data) for p in parts]
        parts.clear()
        places = [(row[low], column[low], data[low]) for row, column, data in places for low in (row >= column,)]
        width = max(int(np.max(row - column)) for row, column, _ in places) + 1
        if 8 * width * self._size > MOST_BAND_BYTES:
            raise RefinementError(
                f"refinement needs {8e-9 * width * self._size:.0f} GB for {self._landmarks} landmarks, expected at "
                f"most {MOST_BAND_BYTES / 2**30:.0f} GB: refine the building's parts one by one (ceilvod map crop)"
            )
        self._band = None
        band = np.zeros((width, self._size), order="F")
        for row, column, data in places:
            band[row - column, column] += data
        del places
        try:
            self._band = cholesky_banded(band, overwrite_ab=True, lower=True, check_finite=False)
        except LinAlgError as e:
            raise RefinementError(f"the views do not tie the map together: {e}") from e
        out = np.empty_like(right)
        out[order] = cho_solve_banded((self._band, True), right[order], check_finite=False)
        return out

    def _ordered(self, parts: list[coo_array]) -> tuple[Ints, NDArray[np.int32]]:
        """The unknowns in the order of the band, and the rank of each."""
        if self._order is None:
            rows, columns = (np.concatenate([getattr(p, k) for p in parts]) for k in ("row", "col"))
            ones = np.ones(len(rows), np.int8)
            pattern = coo_array((ones, (rows, columns)), shape=(self._size, self._size)).tocsr()
            self._order = np.asarray(reverse_cuthill_mckee(pattern, symmetric_mode=True), np.int64)
        rank = np.empty(self._size, np.int32)  # half the memory of all the places that it is looked up for
        rank[self._order] = np.arange(self._size, dtype=np.int32)
        return self._order, rank


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
