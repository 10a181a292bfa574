"""Shifts by whole tiles that a map allows."""

import numpy as np
import pytest

from ceilvo.daemon.relocalisation.lattice import tile_shifts
from ceilvo.types import Landmarks


@pytest.mark.parametrize("axis", [0.0, 0.4, -1.2])
def test_shifts_stand_one_tile_away_along_the_axes(axis: float) -> None:
    c, s = np.cos(axis), np.sin(axis)
    grid = 0.6 * np.array([(i, j) for i in range(5) for j in range(5)]) @ np.array([[c, s], [-s, c]])
    n = len(grid)
    kinds = np.full(n, 4)
    landmarks = Landmarks(np.arange(n), grid, np.tile(np.eye(2), (n, 1, 1)), kinds, kinds)
    found = tile_shifts(landmarks, axis)
    shift = found @ np.array([[c, -s], [s, c]])
    assert found.shape == (48, 2)
    assert np.allclose(shift / 0.6, np.round(shift / 0.6))
    assert abs(np.abs(shift).max() - 1.8) < 1e-9
    assert len({(round(float(x), 6), round(float(y), 6)) for x, y in found}) == 48
    double = np.concatenate([grid, grid + 0.03])  # both edges of every joint, of one type
    both = Landmarks(np.arange(2 * n), double, np.tile(np.eye(2), (2 * n, 1, 1)), np.full(2 * n, 4), np.full(2 * n, 4))
    assert np.allclose(np.sort(np.hypot(*tile_shifts(both, axis).T))[:4], 0.6, atol=0.05)
    few = Landmarks(*(a[:3] for a in (landmarks.ids, grid, landmarks.cov_m2, kinds, kinds)))
    assert tile_shifts(few, axis).shape == (0, 2)
