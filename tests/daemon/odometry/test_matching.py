"""Mutually nearest points against a search through all pairs, one after the other."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ceilvo.daemon.odometry import matching
from ceilvo.daemon.odometry.matching import mutual_nearest


def slowly(a: np.ndarray, kind_a: np.ndarray, b: np.ndarray, kind_b: np.ndarray, radius: float) -> set[tuple[int, int]]:
    def nearest(p: np.ndarray, kind: int, points: np.ndarray, kinds: np.ndarray) -> int:
        best, at = radius, -1
        for i in range(len(points)):
            d = float(np.hypot(*(points[i] - p)))
            if kinds[i] == kind and d < best:
                best, at = d, i
        return at

    there = [nearest(p, k, b, kind_b) for p, k in zip(a, kind_a, strict=True)]
    back = [nearest(p, k, a, kind_a) for p, k in zip(b, kind_b, strict=True)]
    return {(i, j) for i, j in enumerate(there) if j >= 0 and back[j] == i}


@pytest.mark.parametrize("many", [True, False], ids=["many", "few"])
@given(
    st.integers(0, 2**31),
    st.integers(0, 40),
    st.integers(0, 40),
    st.sampled_from([1, 3, 9]),
    st.floats(0.02, 3.0),
    st.floats(0.0, 100.0),
)
def test_points_that_are_each_other_s_nearest_are_found(
    many: bool, seed: int, n: int, m: int, kinds: int, radius: float, apart: float
) -> None:
    """Whatever their number: which way is taken is no one's business."""
    rng = np.random.default_rng(seed)
    a, b = rng.uniform(-1, 1, (n, 2)), rng.uniform(-1, 1, (m, 2)) + apart * (rng.random((m, 1)) < 0.1)
    kind_a, kind_b = rng.integers(0, kinds, n), rng.integers(0, kinds, m)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(matching, "MOST_PAIRS", 0 if many else 10**9)
        i, j = mutual_nearest(a, kind_a, b, kind_b, radius)
    assert i.tolist() == sorted(i.tolist())
    assert set(zip(i.tolist(), j.tolist(), strict=True)) == slowly(a, kind_a, b, kind_b, radius)
