"""The bench of the place index: that it runs, that its views are true, and that bars are read off the figures."""

from __future__ import annotations

import numpy as np

from ceilvo.bench.place.ceiling.worlds import WorldSpec
from ceilvo.bench.speed import find_place as bench
from ceilvo.daemon.relocalisation.place_index.place_index import PlaceIndex

ROOM = WorldSpec("5", 0.6, "raster", 3)


def test_most_of_a_view_is_on_the_map_at_the_pose_that_it_is_from():
    room = bench.Hall(ROOM)
    index = PlaceIndex.of(room.landmarks)
    pose, view = room.view()
    there, _ = index.grid.hits(pose[None], view)
    assert np.count_nonzero(there) > 0.7 * len(view)


def test_figures_of_a_hall_and_of_maps_that_grow():
    row = bench.hall(ROOM, views=6)
    assert row["true one listed %"] > 80.0
    assert row["due and not listed"] == 0
    assert row["bytes a landmark"] > 50.0
    assert 0.0 < row["ms a view"] < 1000.0
    row = bench.grown(300, repeats=1)
    assert row["landmarks"] == 300
    assert all(v > 0.0 for v in row.values())


def test_the_bars_are_read_off_the_figures():
    hall = {"ms a view": 20.0, "bytes a landmark": 201.0, "build s": 0.1, "due and not listed": 1}
    sizes = [{"landmarks": 10, bench.ADD: 0.3}, {"landmarks": 1000, bench.ADD: 0.6}]
    verdicts = [b.verdict for b in bench.bars({"halls": [hall, {**hall, "due and not listed": 0}], "sizes": sizes})]
    assert verdicts == ["PASS", "MISS", "PASS", "MISS", "PASS", "MISS"]
