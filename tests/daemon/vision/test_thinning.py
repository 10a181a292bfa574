"""What of a view tells places where a grille is in it, or where it is all cells."""

from __future__ import annotations

import numpy as np
import pytest

from ceilvo.crossing_types import LAMP
from ceilvo.daemon.vision.thinning import thinned, without_cells
from ceilvo.types import Crossings

FOCAL_PX, HEIGHT_M = 410.0, 2.2
GRID = np.stack(np.meshgrid(0.6 * np.arange(-3, 3), 0.6 * np.arange(-2, 2)), -1).reshape(-1, 2) + 0.1
CELLS = np.stack(np.meshgrid(0.05 * np.arange(12), 0.05 * np.arange(11)), -1).reshape(-1, 2) + 0.15


def seen(xy: np.ndarray) -> Crossings:
    n, z = len(xy), np.zeros(2)
    uv = xy * FOCAL_PX / HEIGHT_M + 300.0
    return Crossings(uv, xy, np.zeros((n, 2, 2)), np.zeros(n, np.int64), 0.0, 0.0, z, z, np.zeros((2, 2)))


def test_a_grille_is_left_out_and_the_grid_stays() -> None:
    left = thinned(seen(np.concatenate([CELLS, GRID])), FOCAL_PX)
    np.testing.assert_array_equal(left.xy_base_m, GRID)


def test_what_remains_does_not_depend_on_how_much_of_the_grille_is_seen() -> None:
    for rows in range(3, 12):
        left = thinned(seen(np.concatenate([CELLS[: 12 * rows], GRID])), FOCAL_PX)
        assert len(left) == len(GRID)


@pytest.mark.parametrize("rows", range(4, 12))
def test_several_grilles_are_left_out_however_many_crossings_they_have(rows: int) -> None:
    """Three whole ones have as many as a ceiling that is all cells; how much of each is found changes by the frame."""
    grid = np.stack(np.meshgrid(0.3 * np.arange(-6, 7), 0.3 * np.arange(-4, 5)), -1).reshape(-1, 2) - 0.15
    grille = CELLS[: 12 * rows]
    cells = np.concatenate([np.add(grille, [aside_m, 0.0]) for aside_m in (-0.9, 0.0, 0.9)])
    apart = grid[np.min(np.hypot(*(grid[:, None] - cells).transpose(2, 0, 1)), axis=1) > 0.12]
    left = thinned(seen(np.concatenate([cells, apart])), FOCAL_PX)
    np.testing.assert_array_equal(left.xy_base_m, apart)


def test_a_grille_alone_is_better_than_nothing() -> None:
    alone = seen(CELLS)
    assert thinned(alone, FOCAL_PX) is alone


def test_corners_of_a_lamp_with_frame_and_joints_stay() -> None:
    corner = np.array([[0.0, 0.0], [0.03, 0.0], [0.0, 0.03], [0.03, 0.03]])
    lamp = np.concatenate([corner + at for at in ([0.0, 0.0], [1.16, 0.0], [0.0, 0.56], [1.16, 0.56])])
    view = seen(np.concatenate([GRID + 0.3, lamp]))
    assert thinned(view, FOCAL_PX) is view


@pytest.mark.parametrize("size", [18, 24])
def test_of_a_ceiling_that_is_all_cells_only_points_stay(size: int) -> None:
    """However the view is turned, where it ends no crossing passes for a corner."""
    angle = np.radians(29.0)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    cells = np.stack(np.meshgrid(0.1 * np.arange(-size, size), 0.1 * np.arange(-size, size)), -1).reshape(-1, 2) @ turn
    cells = cells[np.all(np.abs(cells) < [1.7, 1.2], axis=1)]
    lamps = np.array([[0.3, 0.2], [-0.9, 0.2], [0.3, -1.0]])
    view = seen(np.concatenate([cells, lamps]))
    view.crossing_type[len(cells) :] = LAMP
    assert thinned(view, FOCAL_PX) is view, "motions are found by them"
    np.testing.assert_array_equal(without_cells(view).xy_base_m, lamps)


def test_an_empty_view_stays_empty() -> None:
    empty = seen(np.zeros((0, 2)))
    assert len(thinned(empty, FOCAL_PX)) == 0
