"""Maps in frames of their own, joined or refused, against the hall that both were made from."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ceilvo.bench.join.pairs import Case, pair
from ceilvo.daemon.building.evidence import Counts, false_alarm, scores
from ceilvo.daemon.building.frames import ALARM, Frame, frame_of
from ceilvo.daemon.building.joined import join
from ceilvo.daemon.cli import main
from ceilvo.daemon.editing import sources
from ceilvo.daemon.map.database.content import MapContent
from ceilvo.se2 import between, transform, wrap

Capture = pytest.CaptureFixture[str]
SEED = 3


def near_the_middle(m: MapContent, middle: np.ndarray, reach_m: float) -> MapContent:
    """Only a part, so that a test takes seconds."""
    keep = np.max(np.abs(m.landmarks.xy_map_m - middle), axis=1) < reach_m
    return MapContent.of(m.landmarks.of(keep), m.axis_rad)


@pytest.fixture(scope="module")
def two() -> tuple[MapContent, MapContent, np.ndarray, np.ndarray]:
    """Parts of two maps that overlap by a third, a_from_b, and the overlap's middle in b."""
    a, b, a_from_b, middle = pair(Case("sparse", SEED, 0.3))
    assert a_from_b is not None
    own = transform(a_from_b, middle[None])[0]
    return near_the_middle(a, own, 12.0), near_the_middle(b, middle, 12.0), a_from_b, middle


def test_a_map_with_overlap_is_found(two: tuple[MapContent, MapContent, np.ndarray, np.ndarray]) -> None:
    a, b, a_from_b, middle = two
    found = frame_of(a, b)
    off = transform(found.a_from_b, middle[None])[0] - transform(a_from_b, middle[None])[0]
    print(found, off)
    assert not found.refused and found.false_alarm <= ALARM
    assert np.hypot(*off) < 0.1 and abs(wrap(float(between(a_from_b, found.a_from_b)[2]))) < 0.01


def test_another_hall_is_refused(two: tuple[MapContent, MapContent, np.ndarray, np.ndarray]) -> None:
    _, other, _, middle = pair(Case("sparse", SEED + 1, 0.3))
    found = frame_of(two[0], near_the_middle(other, middle, 12.0))
    assert found.refused


@pytest.mark.parametrize("kind", ["raster", "apart-raster"])
def test_a_raster_of_lamps_is_told_by_its_gaps_and_vents_and_another_hall_with_the_same_is_refused(kind: str) -> None:
    a, b, a_from_b, middle = pair(Case(kind, 108, 0.15))
    found = frame_of(a, b)
    print(found)
    if a_from_b is None:
        assert found.refused
        return
    off = transform(found.a_from_b, middle[None])[0] - transform(a_from_b, middle[None])[0]
    assert not found.refused and found.false_alarm <= ALARM and np.hypot(*off) < 0.2


def test_bare_tiles_are_refused() -> None:
    a, b, a_from_b, middle = pair(Case("bare", SEED, 0.3))
    assert a_from_b is not None
    own = transform(a_from_b, middle[None])[0]
    assert frame_of(near_the_middle(a, own, 8.0), near_the_middle(b, middle, 8.0)).refused


def test_a_chance_is_stated_only_where_there_are_wrong_places_to_judge_by() -> None:
    rng = np.random.default_rng(1)
    wrong = -rng.exponential(2.0, 500)
    assert false_alarm(50.0, wrong[:5]) == 1.0
    assert false_alarm(float(wrong.max()), wrong) > 0.3
    assert false_alarm(60.0, wrong) < 1e-4


def test_what_contradicts_as_often_as_at_wrong_places_speaks_for_none_however_much_of_it_there_is() -> None:
    counts = Counts(np.array([20.0, 300.0, 300.0, 0.0]), np.array([1.0, 18.0, 75.0, 0.0]))
    small, large, wrong, nothing = scores(counts, 0.25).tolist()
    assert 0.0 < small < large and wrong < -10.0 and nothing == 0.0
    assert scores(counts, 0.06)[1] == pytest.approx(0.0)  # where all places show the same, the right one is no better


def test_what_the_later_map_has_no_more_goes_and_what_it_has_comes(
    two: tuple[MapContent, MapContent, np.ndarray, np.ndarray],
) -> None:
    a, b, a_from_b, _ = two
    early, late = (replace(m, seen_s=np.full_like(m.seen_s, t)) for m, t in ((a, 1.6e9), (b, 1.7e9)))
    frame = Frame(a_from_b, (9, 0), 1e-6, 1)
    done, back, undated = join(early, late, frame), join(late, early, _inverse(frame)), join(a, b, frame)
    print(done, "|", back, "|", undated)
    assert done.faded > 20 and done.refused == 0 and done.shared > 400
    assert abs(back.refused - done.faded) <= 2 and back.faded == 0  # what is near is paired from either side
    assert undated.faded == undated.refused == 0 and undated.doubtful > done.doubtful
    assert len(done.content.landmarks) == len(a.landmarks) + done.added - done.faded
    assert np.all(np.diff(done.content.landmarks.ids) > 0)


def _inverse(frame: Frame) -> Frame:
    return replace(frame, a_from_b=between(frame.a_from_b, np.zeros(3)))


def test_the_command_joins_says_what_it_did_and_refuses(
    two: tuple[MapContent, MapContent, np.ndarray, np.ndarray],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: Capture,
) -> None:
    monkeypatch.chdir(tmp_path)
    a, b, _, middle = two
    sources.write(Path("map.db"), a, "begin")
    sources.write(Path("other.db"), b, "begin")
    assert main(["map", "join", "map.db", "other.db", "--png", "join.png"]) == 0
    said = capsys.readouterr().out
    assert "a wrong place looks as good with a chance of" in said and "landmarks are in both" in said
    assert len(sources.read(Path("map.db")).landmarks) > len(a.landmarks) + 100
    far = near_the_middle(b, middle + 8.0, 3.0)
    sources.write(Path("far.db"), far, "begin")
    before = sources.read_with_hash(Path("map.db"))[1]
    bare = replace(far, landmarks=far.landmarks.of(far.landmarks.crossing_type == 4), seen_s=far.seen_s[:0])
    bare = MapContent.of(bare.landmarks, far.axis_rad)
    sources.write(Path("bare.db"), bare, "begin")
    assert main(["map", "join", "map.db", "bare.db"]) == 1
    assert "bare.db: not joined: " in capsys.readouterr().err
    assert sources.read_with_hash(Path("map.db"))[1] == before
