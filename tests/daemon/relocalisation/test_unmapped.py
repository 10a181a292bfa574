"""What a map lacks more often than usual on one ceiling does not speak against places there."""

from ceilvo.daemon.relocalisation.evidence.unmapped import Unmapped


def after(spots: int, lacked: float, expected: float) -> Unmapped:
    unmapped = Unmapped()
    for _ in range(spots):
        unmapped.learn(lacked, expected)
    return unmapped


def test_a_plain_ceiling_is_as_usual_and_a_wild_one_is_known_after_a_few_spots() -> None:
    assert Unmapped().scale == after(200, 0.1, 1.0).scale == after(200, 1.3, 1.0).scale == 1.0
    assert after(60, 5.0, 1.0).scale == 4.0
    assert [after(n, 3.0, 0.5).scale for n in (0, 1, 3, 12)] == [1.0, 2.0, 2.0, 4.0]
    assert after(200, 50.0, 1.0).scale == 8.0


def test_a_ceiling_becomes_plain_again() -> None:
    unmapped = after(60, 5.0, 1.0)
    for _ in range(150):
        unmapped.learn(0.0, 1.0)
    assert unmapped.scale == 1.0
