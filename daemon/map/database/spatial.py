"""Landmarks by where they are: an R*Tree where SQLite has one, else squares of a grid with an index."""

from __future__ import annotations

import sqlite3
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from ceilvo.types import Array, Ints

BOX_M = 0.25
"""Side of the squares that a landmark counts as being in; chosen: it moves by millimetres, so that most saves leave
the R*Tree as it is."""
CELL_M = 2.0
"""Side of a cell of the grid; chosen: a region of a room touches some dozens."""
SIDE = 1 << 24
"""Cells are numbered row by row; MAX_COORDINATE_M in squares of BOX_M fits."""
_MOST_COLUMNS = 1000
"""Of a region that is looked up by columns of cells; a wider one is read from the table. Chosen."""


def cells(xy_m: Array, cell_m: float) -> Ints:
    """(N,) numbers of the square cells that points (N, 2) are in."""
    at = np.floor(np.asarray(xy_m, np.float64) / cell_m).astype(np.int64) + SIDE // 2
    return np.asarray(at[:, 0] * SIDE + at[:, 1], np.int64)


class Spatial(Protocol):
    """Rows of the table landmarks, by their keys."""

    def moved(self, before_m: Array, after_m: Array) -> NDArray[np.bool_]:
        """(N,) which of those that went from (N, 2) to (N, 2) need to be put again."""
        ...

    def put(self, keys: list[int], xy_m: Array) -> None: ...

    def remove(self, keys: list[int]) -> None: ...

    def clear(self) -> None: ...

    def candidates(self, low_m: Array, high_m: Array) -> list[int] | None:
        """Keys of all that may be in a box (2,), (2,), and of some beside; None: it would be as well to look at all."""
        ...

    def misplaced(self) -> bool:
        """Whether a landmark is not where it would be looked for."""
        ...


def spatial_of(db: sqlite3.Connection) -> Spatial:
    there = db.execute("SELECT 1 FROM sqlite_master WHERE name = 'landmark_boxes'").fetchone()
    return RTree(db) if there else Grid(db)


class RTree:
    """Boxes of BOX_M."""

    def __init__(self, db: sqlite3.Connection) -> None:
        self._db = db

    def moved(self, before_m: Array, after_m: Array) -> NDArray[np.bool_]:
        return np.asarray(cells(before_m, BOX_M) != cells(after_m, BOX_M))

    def put(self, keys: list[int], xy_m: Array) -> None:
        low = np.floor(np.asarray(xy_m) / BOX_M) * BOX_M
        boxes = np.column_stack([low[:, 0], low[:, 0] + BOX_M, low[:, 1], low[:, 1] + BOX_M]).tolist()
        rows = ((key, *box) for key, box in zip(keys, boxes, strict=True))
        self._db.executemany("INSERT OR REPLACE INTO landmark_boxes VALUES (?, ?, ?, ?, ?)", rows)

    def remove(self, keys: list[int]) -> None:
        self._db.executemany("DELETE FROM landmark_boxes WHERE key = ?", ((k,) for k in keys))

    def clear(self) -> None:
        self._db.execute("DELETE FROM landmark_boxes")

    def candidates(self, low_m: Array, high_m: Array) -> list[int] | None:
        box = (float(high_m[0]), float(low_m[0]), float(high_m[1]), float(low_m[1]))
        found = self._db.execute(
            "SELECT key FROM landmark_boxes WHERE x0 <= ? AND x1 >= ? AND y0 <= ? AND y1 >= ?", box
        )
        return [key for (key,) in found]

    def misplaced(self) -> bool:
        if self._db.execute("SELECT rtreecheck('landmark_boxes')").fetchone()[0] != "ok":
            return True
        inside = self._db.execute(
            "SELECT count(*) FROM landmarks AS l JOIN landmark_boxes AS b ON b.key = l.key"
            " WHERE l.x BETWEEN b.x0 AND b.x1 AND l.y BETWEEN b.y0 AND b.y1"
        ).fetchone()[0]
        sizes = self._db.execute("SELECT (SELECT count(*) FROM landmarks), (SELECT count(*) FROM landmark_boxes)")
        return bool(sizes.fetchone() != (inside, inside))


class Grid:
    """Cells of CELL_M."""

    def __init__(self, db: sqlite3.Connection) -> None:
        self._db = db

    def moved(self, before_m: Array, after_m: Array) -> NDArray[np.bool_]:
        return np.asarray(cells(before_m, CELL_M) != cells(after_m, CELL_M))

    def put(self, keys: list[int], xy_m: Array) -> None:
        rows = zip(keys, cells(xy_m, CELL_M).tolist(), strict=True)
        self._db.executemany("INSERT OR REPLACE INTO landmark_cells VALUES (?, ?)", rows)

    def remove(self, keys: list[int]) -> None:
        self._db.executemany("DELETE FROM landmark_cells WHERE key = ?", ((k,) for k in keys))

    def clear(self) -> None:
        self._db.execute("DELETE FROM landmark_cells")

    def candidates(self, low_m: Array, high_m: Array) -> list[int] | None:
        first, last = cells(np.stack([low_m, high_m]), CELL_M).tolist()
        if last // SIDE - first // SIDE > _MOST_COLUMNS:
            return None
        columns = ((x * SIDE + first % SIDE, x * SIDE + last % SIDE) for x in range(first // SIDE, last // SIDE + 1))
        query = "SELECT key FROM landmark_cells WHERE cell BETWEEN ? AND ?"
        return [key for column in columns for (key,) in self._db.execute(query, column)]

    def misplaced(self) -> bool:
        rows = self._db.execute("SELECT l.x, l.y, c.cell FROM landmarks AS l LEFT JOIN landmark_cells AS c USING (key)")
        table = np.array([(x, y, cell if type(cell) is int else -1) for x, y, cell in rows], object).reshape(-1, 3)
        wrong = cells(table[:, :2].astype(np.float64), CELL_M) != table[:, 2].astype(np.int64)
        return bool(np.any(wrong))
