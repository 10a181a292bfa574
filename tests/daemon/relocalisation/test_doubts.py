"""What counts as a sign that the robot was moved."""

import numpy as np
import pytest

from ceilvo.daemon.odometry.course import JUMPED
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


TILE_M = np.array([0.6, 0.6])


def stored(ago_s: float, before: float = 0.0) -> doubts.Doubt:
    return doubts.of_stored(0.05**2 * np.eye(3), ago_s, before)


def test_a_stored_pose_is_doubted_more_the_longer_ago_it_was_stored() -> None:
    doubted = [stored(ago_s).elsewhere for ago_s in (0.0, 5.0, 20.0, 60.0, 61.0, np.inf)]
    assert doubted == sorted(doubted) and 0.0 < doubted[0] < doubts.UNLIKELY < doubted[-1]
    assert doubted[3] == pytest.approx(doubts.LIFTED) and doubted[4] == doubted[5] == doubts.STORED_WRONG


def test_tiles_that_lie_exactly_as_stored_speak_for_a_robot_that_nobody_touched() -> None:
    plain = stored(60.0).unknown
    exactly, nudged, carried = (
        stored(60.0).unknown_by_tiles(np.array(off), TILE_M)
        for off in ((0.001, -0.001, 0.0005), (0.03, 0.02, 0.02), (0.28, 0.3, 0.5))
    )
    assert exactly == pytest.approx(plain - doubts.MOST_UNTOUCHED)
    assert exactly < nudged < plain < carried
    assert nudged == pytest.approx(plain - stored(60.0).alignment(np.array([0.03, 0.02, 0.02]), TILE_M))


def test_how_tiles_lie_says_less_of_what_was_doubted_when_the_pose_was_stored() -> None:
    here = np.zeros(3)
    sure, doubtful = stored(5.0), stored(5.0, before=0.2)
    gained = [d.unknown - d.unknown_by_tiles(here, TILE_M) for d in (sure, doubtful)]
    assert gained[0] == pytest.approx(doubts.MOST_UNTOUCHED)
    assert gained[1] == pytest.approx(doubtful.alignment(here, TILE_M), abs=0.1)


@pytest.mark.parametrize("tile_m", [0.3, 0.6, 1.25])
def test_a_robot_that_nobody_touched_is_at_no_other_tile_however_bare_the_ceiling(tile_m: float) -> None:
    """All rivals together are less likely than states.false_place_rate; but not where it had been carried before."""
    tiles, steps = np.array([tile_m, tile_m]), np.arange(-6, 7)
    off = np.array([[i * tile_m, j * tile_m, 0.0] for i in steps for j in steps if (i, j) != (0, 0)])
    here = np.array([0.001, -0.001, 0.0005])
    elsewhere, doubted, nudged = (
        float(np.sum(np.exp(doubt.log_odds(off, fit, tiles))))
        for doubt, fit in ((stored(60.0), here), (stored(60.0, before=0.01), here), (stored(60.0), 30.0 * here))
    )
    print(f"tiles of {tile_m} m: {elsewhere:.1e}; doubted before {doubted:.1e}; nudged {nudged:.1e}")
    assert elsewhere < 0.5e-4
    assert doubted > 0.005
    assert nudged > 1e-4


def test_a_lost_frame_is_a_small_doubt_and_a_jump_a_large_one() -> None:
    lost = doubts.of_gap(1e-6 * np.eye(3), 0.1, 0.0, 1e-3)
    jumped = doubts.of_gap(1e-6 * np.eye(3), 0.1, JUMPED, 1e-3)
    assert lost.elsewhere < doubts.UNLIKELY < jumped.elsewhere
