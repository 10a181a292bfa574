"""What counts as a sign that the robot was moved."""

import numpy as np
import pytest

from ceilvo.daemon.relocalisation import doubts


@pytest.mark.parametrize(
    ("crossings", "usual", "jump"),
    [
        (10, 60.0, True),
        (9, 60.0, False),
        (5, 60.0, False),
        (5, 8.0, True),
        (4, 6.0, True),
        (3, 6.0, False),
        (3, 0.0, False),
    ],
)
def test_as_many_crossings_as_are_usual_there_and_no_motion_are_a_jump(
    crossings: int, usual: float, jump: bool
) -> None:
    assert doubts.shows_a_jump(crossings, usual) == jump


def test_a_lost_frame_is_a_small_doubt_and_a_jump_a_large_one() -> None:
    lost = doubts.of_gap(1e-6 * np.eye(3), 0.1, False, 1e-3)
    jumped = doubts.of_gap(1e-6 * np.eye(3), 0.1, True, 1e-3)
    assert lost.elsewhere < doubts.UNLIKELY < jumped.elsewhere
