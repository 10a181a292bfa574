"""A view that no motion explains: lines that were mistaken, or a robot that somebody moves."""

from dataclasses import replace

import numpy as np
import pytest

from ceilvo.daemon.odometry.course import CARRIED_PS, JUMPED, Course, moved_by_hand, moved_or_flickered
from ceilvo.daemon.relocalisation.doubts import UNLIKELY

SEED, TIMES = 5, 500
GUESS = np.array([0.02, -0.01, 0.03])


def course() -> Course:
    return Course(GUESS, np.eye(3) * 1e-6, 1 / 30, 1 / 30, np.zeros(3), 1 / 30, by_wheels=False, refused=None)


def chance(x_m: float, y_m: float, turned_rad: float = 0.0) -> float:
    return moved_by_hand(GUESS + np.array([x_m, y_m, turned_rad]), course(), 0.0)


def test_lines_that_were_mistaken_by_a_centimetre_say_little_and_half_a_tile_says_all() -> None:
    print(f"15 mm: {chance(0.015, 0.0):.4f}, 4 cm: {chance(0.0, 0.04):.3f}")
    assert chance(0.015, 0.0) < UNLIKELY < chance(0.0, 0.04) < 0.1
    assert chance(0.3, 0.0) == JUMPED
    assert moved_by_hand(None, course(), 0.0) == JUMPED


def test_a_robot_that_may_have_left_the_view_by_itself_was_hardly_moved_by_hand() -> None:
    """Bayes: a hand, a damaged view as likely as that, or other ceiling in view."""
    blind_s = 0.9
    out_of_the_dark = replace(course(), elapsed_s=blind_s)
    for elsewhere in (1e-6, 1e-3, 0.02, 0.5):
        hand, damaged = CARRIED_PS * blind_s, CARRIED_PS * blind_s
        of_all = hand / (hand + damaged + elsewhere)
        assert moved_by_hand(None, out_of_the_dark, elsewhere) == pytest.approx(of_all)
    assert moved_by_hand(None, out_of_the_dark, 0.5) < UNLIKELY
    assert moved_by_hand(None, course(), 1e-12) == pytest.approx(JUMPED, rel=1e-6)


def test_a_robot_that_is_turned_on_the_spot_is_not_overlooked() -> None:
    assert chance(0.0, 0.0, 0.5) > 0.25
    assert chance(0.0, 0.0, -0.5) == pytest.approx(chance(0.0, 0.0, 0.5))


@pytest.mark.parametrize(("tile_m", "duration_s", "fps"), [(0.3, 0.1, 30.0), (0.6, 0.1, 30.0), (0.6, 0.1, 15.0)])
def test_a_hand_that_moves_a_robot_by_a_tile_is_seen_on_its_way(tile_m: float, duration_s: float, fps: float) -> None:
    """Whenever it begins between two frames; the views on the way show it modulo a tile."""
    missed = 0
    for begin_s in np.random.default_rng(SEED).uniform(0.0, 1.0 / fps, TIMES):
        part = np.clip((np.arange(1.0, 10.0) / fps - begin_s) / duration_s, 0.0, 1.0)
        way_m = tile_m * (3.0 * part**2 - 2.0 * part**3)
        off_m = way_m - tile_m * np.round(way_m / tile_m)
        missed += max(chance(float(off), 0.0) for off in off_m) < UNLIKELY
    print(f"seed {SEED}: {missed} of {TIMES} unseen")
    assert missed == 0


def test_a_few_points_that_come_and_go_are_no_hand_but_many_or_view_after_view_are() -> None:
    one = moved_or_flickered(4, 2, 0.25, 1, 1 / 30)
    again = moved_or_flickered(4, 2, 0.25, 5, 5 / 30)
    many = moved_or_flickered(9, 3, 0.1, 1, 1 / 30)
    print(
        f"four points that fit nothing: {one:.1e}, five times in a row {again:.3f}; nine of ten that stay: {many:.3f}"
    )
    assert one < 1e-4 < again
    assert many > UNLIKELY
    assert moved_or_flickered(9, 3, 0.1, 8, 8 / 30) == JUMPED
    assert moved_or_flickered(4, 2, 0.0, 1, 0.0) == 0.0, "in no time nobody moves it"


@pytest.mark.parametrize(("points", "needed", "disagreeing"), [(3, 2, 0.3), (5, 2, 0.4), (8, 3, 0.2)])
def test_the_chance_that_a_few_points_flicker_alone_is_counted(points: int, needed: int, disagreeing: float) -> None:
    stay = np.random.default_rng(SEED).random((200_000, points)) > disagreeing
    counted = float(np.mean(np.count_nonzero(stay, axis=1) < needed))
    elapsed_s = 0.01
    said = moved_or_flickered(points, needed, disagreeing, 1, elapsed_s)
    expected = CARRIED_PS * elapsed_s / (CARRIED_PS * elapsed_s + counted)
    print(f"seed {SEED}: too few agree in {counted:.4f}")
    assert said == pytest.approx(expected, rel=0.1)
