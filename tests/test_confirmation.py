"""The sequential test of an assumed pose."""

import numpy as np

from ceilvo.daemon.confirmation import GRID_CROSSING, Confirmation
from ceilvo.types import Observations

NIS, NIS_MAX = 1.0, 3.0
LAMP_CORNER = 5


def view(grid_known: int, grid_unknown: int, other_known: int = 0, other_unknown: int = 0) -> Observations:
    kind = [GRID_CROSSING] * (grid_known + grid_unknown) + [LAMP_CORNER] * (other_known + other_unknown)
    label = list(range(grid_known)) + [-1] * grid_unknown + list(range(100, 100 + other_known)) + [-1] * other_unknown
    n = len(kind)
    return Observations(np.zeros((n, 2)), np.ones((n, 2)), np.array(kind, np.int64), np.array(label, np.int64))


def test_one_perfect_view_is_not_enough_for_an_unsure_pose() -> None:
    assert not Confirmation(sure=False).weigh(view(30, 0, 10, 0), NIS, NIS_MAX)


def test_several_views_with_lamps_are() -> None:
    confirmation = Confirmation(sure=False)
    assert any(confirmation.weigh(view(28, 2, 3, 2), NIS, NIS_MAX) for _ in range(6))


def test_a_bare_grid_never_confirms_an_unsure_pose() -> None:
    confirmation = Confirmation(sure=False)
    assert not any(confirmation.weigh(view(30, 0), NIS, NIS_MAX) for _ in range(100))


def test_tiles_off_lamps_contradict() -> None:
    confirmation = Confirmation(sure=False)
    assert not any(confirmation.weigh(view(25, 5, 1, 5), NIS, NIS_MAX) for _ in range(100))


def test_a_sure_pose_needs_one_view_that_fits() -> None:
    assert Confirmation(sure=True).weigh(view(20, 5), NIS, NIS_MAX)
    assert not Confirmation(sure=True).weigh(view(5, 20), NIS, NIS_MAX)
    assert not Confirmation(sure=True).weigh(view(20, 5), 10.0, NIS_MAX)
    assert not Confirmation(sure=True).weigh(view(0, 0), NIS, NIS_MAX)
