"""The jackknife against fits that leave out each part."""

import numpy as np
import pytest

from ceilvo.robust import leave_one_out


@pytest.mark.parametrize("seed", range(5))
def test_it_moves_as_fits_without_each_part_do(seed: int) -> None:
    print(f"seed {seed}")
    rng = np.random.default_rng(seed)
    parts = [(rng.normal(size=(n, 3)), rng.normal(size=n)) for n in rng.integers(4, 9, 6)]
    a, b = (np.concatenate([p[i] for p in parts]) for i in (0, 1))
    whole = np.linalg.lstsq(a, b, rcond=None)[0]
    moved = []
    for out in range(len(parts)):
        rest = [p for k, p in enumerate(parts) if k != out]
        without = np.linalg.lstsq(
            np.concatenate([p[0] for p in rest]), np.concatenate([p[1] for p in rest]), rcond=None
        )
        moved.append(without[0] - whole)
    normal = np.stack([m.T @ m for m, _ in parts])
    right = np.stack([m.T @ (v - m @ whole) for m, v in parts])
    assert leave_one_out(normal, right) == pytest.approx(np.array(moved).T @ np.array(moved), rel=1e-9, abs=1e-12)
