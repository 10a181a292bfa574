"""Two views laid on each other: what a line that is called something else takes with it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ceilvo.crossing_types import JOINTS, crossing_type_of
from ceilvo.daemon.odometry.sight import Matched, Sight
from ceilvo.types import Crossings, Ints, LineKind

SIDE = 6
ANOTHER = int(crossing_type_of(np.array([LineKind.RISING]), np.array([LineKind.GROOVE]))[0])


def grid(kind: Ints, psi_rad: float = 0.0) -> Crossings:
    x, y = (0.6 * v.ravel() for v in np.meshgrid(np.arange(SIDE), np.arange(SIDE)))
    c, s = np.cos(psi_rad), np.sin(psi_rad)
    xy = np.column_stack([c * x - s * y, s * x + c * y])
    cov, psi = np.tile(1e-6 * np.eye(2), (SIDE**2, 1, 1)), psi_rad
    return Crossings(xy * 100.0, xy, cov, kind, psi, 1e-3, np.zeros(2), np.zeros(2), np.zeros((2, 2)))


@pytest.mark.parametrize("psi_rad", [0.0, 0.4])
@pytest.mark.parametrize("lines", [1, 2])
def test_a_line_that_is_called_something_else_counts_as_one_crossing(psi_rad: float, lines: int) -> None:
    joints = np.full(SIDE**2, JOINTS)
    kind = joints.copy()
    kind.reshape(SIDE, SIDE)[:, :lines] = ANOTHER  # all crossings of the lines at x = 0, .6
    before, now = Sight.of(grid(joints, psi_rad)), Sight.of(grid(kind, psi_rad))
    same, other, gone, lost = Matched.of(before, now, np.zeros((1, 3)), 0).counts[0].sum(axis=1)
    assert same == pytest.approx(SIDE * (SIDE - lines))
    assert other == pytest.approx(lines)
    assert gone == lost == 0.0


@pytest.mark.parametrize(("missing", "worth"), [(JOINTS, 3), (ANOTHER, SIDE)])
def test_a_line_of_joints_that_is_missing_counts_as_three_and_one_of_a_lamp_in_full(missing: int, worth: int) -> None:
    kind = np.full((SIDE, SIDE), JOINTS)
    kind[:, 2] = missing  # all crossings of the line at x = 1.2
    whole = grid(kind.ravel())
    left = np.tile(np.arange(SIDE) != 2, SIDE)
    part = replace(whole, uv_px=whole.uv_px[left], xy_base_m=whole.xy_base_m[left])
    part = replace(part, cov_base_m2=whole.cov_base_m2[left], crossing_type=whole.crossing_type[left])
    for before, now in ((whole, part), (part, whole)):
        counts = Matched.of(Sight.of(before), Sight.of(now), np.zeros((1, 3)), 0).counts[0].sum(axis=1)
        assert counts[0] == pytest.approx(SIDE * (SIDE - 1))
        assert sorted(counts[1:]) == pytest.approx([0.0, 0.0, worth])


def test_crossings_that_are_mistaken_on_lines_of_their_own_count_each() -> None:
    kind = np.full(SIDE**2, JOINTS)
    kind.reshape(SIDE, SIDE)[np.arange(SIDE), np.arange(SIDE)] = ANOTHER  # a diagonal
    counts = Matched.of(Sight.of(grid(np.full(SIDE**2, JOINTS))), Sight.of(grid(kind)), np.zeros((1, 3)), 0).counts
    assert counts[0, 1].sum() == pytest.approx(SIDE)
