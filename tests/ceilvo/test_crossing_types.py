"""Codes of crossings under turns of their axes."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from ceilvo.crossing_types import CORNER, LAMP, LINE_CROSSINGS, SPOT, crossing_type_of, quarter_turns, turned_type
from ceilvo.types import LineKind

ALL = np.arange(LINE_CROSSINGS)


def test_codes_are_the_nine_pairs() -> None:
    first, second = (k.ravel() for k in np.meshgrid([-1, 0, 1], [-1, 0, 1], indexing="ij"))
    np.testing.assert_array_equal(crossing_type_of(first, second), ALL)


def test_points_stay_what_they_are_however_axes_are_named() -> None:
    points = np.array([LAMP, SPOT, CORNER])
    for turns in range(4):
        np.testing.assert_array_equal(turned_type(points, turns), points)
        np.testing.assert_array_equal(
            turned_type(np.append(ALL, points), turns)[:LINE_CROSSINGS], turned_type(ALL, turns)
        )


def test_four_quarter_turns_change_nothing() -> None:
    np.testing.assert_array_equal(turned_type(ALL, 4), ALL)
    assert not np.array_equal(turned_type(ALL, 1), ALL)


@given(st.integers(-9, 9), st.integers(-9, 9))
def test_turns_add_up(a: int, b: int) -> None:
    np.testing.assert_array_equal(turned_type(turned_type(ALL, a), b), turned_type(ALL, a + b))


def test_a_turn_by_hand() -> None:
    """Axis 0 rises along +x, axis 1 falls along +y. Named from +y on: axis 0 falls, axis 1 points to -x and falls."""
    before = crossing_type_of(np.array([LineKind.RISING]), np.array([LineKind.FALLING]))
    after = crossing_type_of(np.array([LineKind.FALLING]), np.array([LineKind.FALLING]))
    assert turned_type(before, 1) == after


@given(st.floats(-0.25 * np.pi, 0.249 * np.pi), st.integers(-5, 5), st.floats(-0.7, 0.7))
def test_quarter_turns_bring_an_axis_next_to_its_reference(psi: float, turns: int, off: float) -> None:
    reference = psi + turns * np.pi / 2 + off
    assert quarter_turns(psi, reference) == turns % 4
