"""Steps on a small and on a large map: the two maps, what robots drive on, and bars that are read off the figures."""

from __future__ import annotations

import numpy as np
import pytest

from ceilvo import se2
from ceilvo.bench.place import command, steps
from ceilvo.errors import CeilvoError
from ceilvo.types import Pose

COUNTS = (100, 1_200)


@pytest.fixture(scope="module")
def site() -> steps.Site:
    return steps.Site.of("20", 0.6, 3)


def test_a_map_is_what_is_nearest_and_what_lies_beyond_the_new_ground(site: steps.Site) -> None:
    few, many = (site.known(COUNTS[0], n, steps.NEW_GROUND_M) for n in COUNTS)
    middle = se2.transform(Pose(site.world.map_from_ceiling), np.array([[10.0, 10.0]]))
    few_m, many_m = (np.hypot(*(m.xy_map_m - middle).T) for m in (few, many))
    assert (len(few), len(many)) == COUNTS
    assert few_m.max() < 3.3
    assert set(few.ids) <= set(many.ids) and len(set(many.ids)) == len(many)
    assert np.count_nonzero((many_m > few_m.max()) & (many_m <= steps.NEW_GROUND_M)) == 0
    assert np.hypot(*(site.known(*COUNTS, 0.0).xy_map_m - middle).T).max() < steps.NEW_GROUND_M
    with pytest.raises(CeilvoError, match="expected 100,000"):
        site.known(100, 100_000, 0.0)


def test_the_grid_goes_on_from_one_hall_to_the_next(site: steps.Site) -> None:
    xy = se2.transform(Pose(se2.inverse(site.world.map_from_ceiling)), site.landmarks.xy_map_m)
    grid = site.landmarks.crossing_type == np.bincount(site.landmarks.crossing_type).argmax()
    first_m = xy[grid & (xy[:, 0] < 19.0)][0]
    off_m = np.abs((xy[grid, 0] - first_m[0] + 0.3) % 0.6 - 0.3)
    here, beside = off_m[xy[grid, 0] < 19.0], off_m[xy[grid, 0] > 21.0]
    assert min(len(here), len(beside)) > 500
    assert np.median(here) < 0.01 and np.median(beside) < 0.01


def test_robots_on_both_maps_are_sure_and_one_of_the_drives_maps(site: steps.Site) -> None:
    rows = steps.measured(site, COUNTS, 4.0, 3)
    assert [(r["drive"], r["loaded"]) for r in rows] == [(d, n) for d in ("known map", "mapping") for n in COUNTS]
    assert all(r["run"]["state_s"].get("TRACKING", 0.0) > 3.5 for r in rows)
    assert all(0.0 < r["step_ms"]["median"] <= r["step_ms"]["p99"] for r in rows)
    on_known, mapping = [[r["ended"] - r["began"] for r in rows if r["drive"] == d] for d in ("known map", "mapping")]
    assert min(mapping) > 10 > max(on_known)
    assert rows[1]["began"] - rows[0]["began"] > 1_000


def test_what_is_remembered_is_at_least_what_says_where_landmarks_are(site: steps.Site) -> None:
    figures = steps.remembered(site, COUNTS, 3)
    assert 48.0 < figures["held"] < 1_000.0  # place and covariance, 8 bytes a number
    assert figures["loading"] > figures["held"]


def test_bars_are_read_off_the_figures() -> None:
    rows = [
        {"drive": drive, "loaded": n, "step_ms": {"median": median, "p99": p99}}
        for drive, n, median, p99 in (
            *(("known map", 100, 10.0, 20.0), ("known map", 100_000, 12.0, 25.0)),
            *(("mapping", 100, 10.0, 20.0), ("mapping", 100_000, 12.1, 24.0)),
        )
    ]
    verdicts = [b.verdict for b in steps.bars(rows, {"held": 201.0, "loading": 150.0})]
    assert verdicts == ["PASS", "MISS", "MISS", "PASS", "MISS"]
    assert steps.bars(rows, {"held": 200.0, "loading": 900.0})[-1].met


def test_help_shows_a_command_to_copy(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        command.main(["steps", "--help"])
    assert "python -m ceilvo.bench.place steps --seconds 120" in capsys.readouterr().out
