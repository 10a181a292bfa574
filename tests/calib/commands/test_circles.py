"""Typed poses of `calib circles`, and what they say of the tape on a virtual bench."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from ceilvo import se2
from ceilvo.calib.commands import circles
from ceilvo.calib.practice.virtual_bench import VirtualBench
from ceilvo.calib.session.session import Session
from ceilvo.calib.targets.sources import ListSource, Picture


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("1 2", "expected three numbers"),
        ("a b c", "expected three numbers"),
        ("600 0 0", "looks like millimetres"),
        ("1 0 400", "expected degrees"),
        ("nan 0 0", "expected numbers"),
    ],
)
def test_a_pose_that_is_none_is_said_so(text: str, reason: str) -> None:
    answer = circles.parse_pose(text)
    assert isinstance(answer, str) and reason in answer


def test_a_pose_is_read_with_or_without_commas() -> None:
    for text in ("0.5, -0.25, 90", "0.5 -0.25 90"):
        np.testing.assert_allclose(circles.parse_pose(text), [0.5, -0.25, 0.5 * np.pi])


def test_the_feature_is_expected_where_it_is() -> None:
    """Robot a metre in front of the feature, looking away from it: the feature is a metre behind."""
    np.testing.assert_allclose(circles.expected(np.array([1.0, 0.0, 0.0])), [-1.0, 0.0], atol=1e-12)
    pose = np.array([0.3, -0.2, 1.1])
    np.testing.assert_allclose(se2.transform(pose, circles.expected(pose)[None])[0], [0, 0], atol=1e-12)


def test_circles_on_the_virtual_bench_find_the_tapes_noise(tmp_path: Path) -> None:
    """1 mm of tape on either axis, 2 mrad of heading; who errs is answer and asked again; Ctrl-C loses none."""
    bench, session, notes = VirtualBench(), Session(tmp_path), list[str]()
    subject = {"source": "virtual bench"}

    def collect(prompt: circles.Prompt) -> list[dict[str, float]]:
        take = circles.taker(ListSource("virtual bench", bench.circles(each=8)[1]))
        return circles.collect(bench.rig, session, subject, take, (0.0, 0.0), prompt, notes.append)

    said = bench.circles(each=8)[0]
    typed = iter(["0.1 0.1", *said[:5]])

    def interrupted(number: int, _: str) -> str:
        if number == 5:
            raise KeyboardInterrupt
        return next(typed)

    with pytest.raises(KeyboardInterrupt):
        collect(interrupted)
    assert "expected three numbers" in notes[0]
    assert len(session.samples(circles.SAMPLES, subject)) == 5
    samples = collect(lambda number, _: said[number] if number < len(said) else "")
    assert "going on after 5 poses of the run before" in notes
    assert len(samples) == 24
    errors = circles.errors_of(bench.rig, samples)
    for e in (errors.dx_m, errors.dy_m):
        assert 0.5e-3 < float(np.sqrt(np.mean(e**2))) < 2.5e-3
    assert 1e-3 < float(np.sqrt(np.mean(errors.dtheta_rad**2))) < 3.5e-3


def test_a_pose_that_does_not_go_with_the_picture_is_rejected() -> None:
    bench = VirtualBench()
    pictures: Iterator[Picture] = bench.circles(radii_m=(0.5,), each=1)[1]
    reader = circles.CeilingReader(bench.rig.camera, (0.0, 0.0))
    answer = circles.look(bench.rig, reader, next(pictures), np.array([0.25, 0.9, 2.0]))
    assert "are x, y and heading right?" in answer["rejected"]
