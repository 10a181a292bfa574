"""How well the board's pictures cover what must be covered, and what to hold where next."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray

from ceilvo.calib.solve.intrinsics import Shot, board_pose
from ceilvo.calib.solve.lens import guessed_camera

Light: TypeAlias = NDArray[np.int64]

_CELLS = (6, 8)
"""Rows and columns of the picture's parts that corners are counted in."""
_BLACK = 12
"""Median grey level below which a part of the picture is black; a sensor's dark level and a lens' stray light are
below it, chosen."""
_ASPECT, _HALF_A_PART = 4.0 / 3.0, 0.08
"""Width of the picture over its height, and half a part's side over its height."""
_LEANING_DEG = 15.0
"""From which a board leans: flatter ones cannot tell the focal length from the distance."""


@dataclass(frozen=True)
class Coverage:
    """How well the shots cover what must be covered.

    Attributes:
        cells: (6, 8) corners in each part of the picture.
        lit: (6, 8) whether the lens shows anything there: a circular fisheye leaves a black rim.
        area: fraction of the lit parts with a corner in them.
        reach: farthest corner from the middle over half the diagonal, or over what is lit of it.
        tilted: shots in which the board leans by 15 deg or more.
        distance_ratio: farthest over nearest board.
    """

    cells: NDArray[np.int64]
    lit: NDArray[np.bool_]
    area: float
    reach: float
    tilted: int
    distance_ratio: float

    GATE_AREA = 0.70
    """Fraction of the parts of the picture with a corner in them; chosen, as the three below."""
    GATE_REACH = 0.70
    """Farthest corner over half the diagonal: the distortion is largest there."""
    GATE_TILTED = 3
    """Leaning shots."""
    GATE_RATIO = 1.2
    """Farthest over nearest board."""

    def missing(self) -> list[str]:
        """What to do next; empty when the gate is passed."""
        out = []
        if self.area < self.GATE_AREA or self.reach < self.GATE_REACH:
            out.append(f"hold the board where the picture is empty: {self.empty_places()}")
        if self.tilted < self.GATE_TILTED:
            out.append(f"lean the board by 20 to 45 deg: {self.tilted} such pictures, {self.GATE_TILTED} needed")
        if self.distance_ratio < self.GATE_RATIO:
            out.append(
                f"vary the distance: farthest over nearest is {self.distance_ratio:.2f}, {self.GATE_RATIO} needed"
            )
        return out

    def empty_places(self) -> str:
        rows, columns = ("top", "middle", "bottom"), ("left", "centre", "right")
        return ", ".join(f"{rows[i]} {columns[j]}" for i, j in self.empty_parts()) or "the corners"

    def empty_parts(self) -> list[tuple[int, int]]:
        """Row and column of each ninth of the picture that is not covered yet."""
        out = []
        for i, row in enumerate(np.array_split(self.cells, 3, axis=0)):
            for j, part in enumerate(np.array_split(row, 3, axis=1)):
                seen = part[self.lit_parts(i, j)]
                if seen.size and np.mean(seen > 0) < self.GATE_AREA:
                    out.append((i, j))
        return out

    def lit_parts(self, i: int, j: int) -> NDArray[np.bool_]:
        """Of the ninth of the picture in row i and column j, which of its parts are lit."""
        return np.array_split(np.array_split(self.lit, 3, axis=0)[i], 3, axis=1)[j]

    @property
    def text(self) -> str:
        return (
            f"area {100 * self.area:.0f} %, reach {100 * self.reach:.0f} %, leaning {self.tilted}, "
            f"distance 1:{self.distance_ratio:.2f}"
        )


def light_of(gray: NDArray[np.uint8]) -> Light:
    """(6, 8) median grey level of each part of a picture (H, W)."""
    rows = np.array_split(gray, _CELLS[0], axis=0)
    return np.array([[int(np.median(part)) for part in np.array_split(row, _CELLS[1], axis=1)] for row in rows])


def lighter(light: Light | None, other: Light) -> Light:
    """The most of both, part by part.

    Raises:
        ValueError: they are not (6, 8).
    """
    if other.shape != _CELLS:
        raise ValueError(f"light of {other.shape} parts, expected {_CELLS}")
    return other if light is None else np.maximum(light, other)


def _rim(light: Light) -> NDArray[np.bool_]:
    """(6, 8) parts that are dark in every picture and farther out than all that are not."""
    dark = light < _BLACK
    row, column = np.mgrid[: _CELLS[0], : _CELLS[1]]
    r = np.hypot((row + 0.5) / _CELLS[0] - 0.5, ((column + 0.5) / _CELLS[1] - 0.5) * _ASPECT)
    return np.asarray(dark & (r > r[~dark].max(initial=0.0) - _HALF_A_PART), np.bool_)


def coverage(shots: list[Shot], size: tuple[int, int], light: Light | None = None) -> Coverage:
    """What shots cover of a picture of size (width, height) px.

    Args:
        light: (6, 8) the largest of light_of() over the pictures, None = the lens lights all of the picture.
    """
    lit = np.ones(_CELLS, np.bool_) if light is None else ~_rim(light)
    cells = np.zeros(_CELLS, np.int64)
    reach, tilts, distances = 0.0, [], []
    guess = guessed_camera(size)
    for shot in shots:
        u = np.clip((shot.uv_px / np.array(size) * _CELLS[::-1]).astype(int), 0, [_CELLS[1] - 1, _CELLS[0] - 1])
        np.add.at(cells, (u[:, 1], u[:, 0]), 1)
        off = np.hypot(*(shot.uv_px - 0.5 * np.array(size)).T)
        reach = max(reach, float(off.max()) / _lit_radius(lit, size))
        pose = board_pose(guess, shot)
        tilts.append(np.degrees(np.arccos(min(1.0, abs(float(cv2.Rodrigues(pose[:3])[0][2, 2]))))))
        distances.append(float(np.linalg.norm(pose[3:])))
    ratio = max(distances) / min(distances) if distances else 1.0
    return Coverage(
        cells, lit, float(np.mean(cells[lit] > 0)), reach, int(np.sum(np.array(tilts) >= _LEANING_DEG)), ratio
    )


def _lit_radius(lit: NDArray[np.bool_], size: tuple[int, int]) -> float:
    """From the middle to the far corner of the outermost lit part, px; half the diagonal without a rim."""
    w, h = size
    row, column = np.nonzero(lit)
    x = np.maximum(np.abs(column / _CELLS[1] - 0.5), np.abs((column + 1) / _CELLS[1] - 0.5)) * w
    y = np.maximum(np.abs(row / _CELLS[0] - 0.5), np.abs((row + 1) / _CELLS[0] - 0.5)) * h
    return float(np.hypot(x, y).max())


def coverage_picture(
    shots: list[Shot],
    size: tuple[int, int],
    gray: NDArray[np.uint8] | None = None,
    light: Light | None = None,
) -> NDArray[np.uint8]:
    """(H, W, 3) the picture with every corner so far, empty parts shaded."""
    w, h = size
    rows, columns = _CELLS
    image = np.full((h, w, 3), 60, np.uint8) if gray is None else cv2.cvtColor(gray, cv2.COLOR_GRAY2BGR) // 2
    image = np.ascontiguousarray(image)
    covered = coverage(shots, size, light)
    for (j, i), n in np.ndenumerate(covered.cells):
        if n == 0 and covered.lit[j, i]:
            a, b = (int(i * w / columns), int(j * h / rows)), (int((i + 1) * w / columns), int((j + 1) * h / rows))
            image[a[1] : b[1], a[0] : b[0], 2] = np.minimum(image[a[1] : b[1], a[0] : b[0], 2] + 70, 255)
    for shot in shots:
        for u, v in shot.uv_px:
            cv2.circle(image, (round(float(u)), round(float(v))), max(2, w // 320), (80, 220, 80), -1)
    return np.asarray(image, np.uint8)
