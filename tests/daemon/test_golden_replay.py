"""Golden drives again: every estimate as it was, to the bit on the platform that made them, to 1e-9 elsewhere.

What is right is proved elsewhere, against the simulator's truth; here nothing may change unnoticed.
"""

from __future__ import annotations

import golden_drives as drives
import numpy as np
import pytest

CASES = [(name, method) for name, methods in drives.METHODS.items() for method in methods]
SAME_PLATFORM = drives.on_the_same_platform()
ELSEWHERE = 1e-9


@pytest.mark.parametrize(("name", "method"), CASES)
def test_every_estimate_is_as_it_was(name: str, method: str) -> None:
    figures, words = drives.table(drives.estimates(drives.load(name, method)))
    with np.load(drives.HERE / f"{name}.{method}.npz", allow_pickle=False) as f:
        before, said = f["figures"], f["words"].tolist()
    assert figures.shape == before.shape
    if SAME_PLATFORM:
        unequal = np.argwhere((figures != before) & ~(np.isnan(figures) & np.isnan(before)))
        assert len(unequal) == 0, f"first unequal at frame {unequal[0][0]}, column {unequal[0][1]}"
    else:
        np.testing.assert_allclose(figures, before, rtol=ELSEWHERE, atol=ELSEWHERE, equal_nan=True)
    assert words == said


def test_a_change_of_the_method_is_noticed(monkeypatch: pytest.MonkeyPatch) -> None:
    """The comparison can fail: another seed of the filter gives other estimates."""
    monkeypatch.setattr(drives, "PIPELINE_SEED", drives.PIPELINE_SEED + 1)
    figures, _ = drives.table(drives.estimates(drives.load("lap", "pf")))
    with np.load(drives.HERE / "lap.pf.npz", allow_pickle=False) as f:
        assert np.max(np.abs(figures[:, :3] - f["figures"][:, :3])) > ELSEWHERE
