"""Places on tiled ceilings: rasters of lamps with gaps, bare grids, lamps that are new."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import place_maps

from ceilvo.daemon.relocalisation.place_index.place_index import PlaceIndex

TILE_M = 0.6


def raster(rng, width=40, height=30, every=(4, 3), gaps=0.15):
    """Lamps on a raster with gaps; the map, and (N, 2) tiles with a lamp."""
    lamps = np.stack(np.meshgrid(np.arange(1, width, every[0]), np.arange(1, height, every[1])), -1).reshape(-1, 2)
    lamps = lamps[rng.random(len(lamps)) > gaps]
    return place_maps.tiles(width, height, TILE_M, lamps), lamps


def test_on_a_raster_of_lamps_all_places_that_look_the_same_are_kept():
    rng = np.random.default_rng(5)
    known, lamps = raster(rng)
    index = PlaceIndex.of(known)
    lamp = lamps[len(lamps) // 2]
    pose = np.append(TILE_M * (lamp + 0.5) + [0.1, -0.05], 0.0)
    view = place_maps.view_of(known, pose, rng, half_m=(1.0, 0.8))
    found = index.candidates(view, margin=2.0)
    assert found.complete
    assert place_maps.listed(found.pose, pose)
    alike = TILE_M * (lamps - lamp) + pose[:2]
    for xy in alike[np.all((alike > 1.2) & (alike < TILE_M * np.array([40, 30]) - 1.2), axis=1)]:
        assert place_maps.listed(found.pose, [*xy, 0.0])
    assert found.false_alarm_probability[0] == 1.0
    few = index.candidates(view, margin=2.0, most=len(found) // 2)
    assert len(few) == len(found) // 2
    assert not few.complete
    np.testing.assert_array_equal(few.explained, found.explained[: len(few)])


def test_a_gap_in_the_raster_tells_places_apart():
    """Where a lamp of the pattern is missing in the view, places that have one miss it."""
    rng = np.random.default_rng(6)
    known, lamps = raster(rng, gaps=0.0)
    gap = np.flatnonzero((lamps == [17, 13]).all(axis=1))[0]
    pose = np.append(TILE_M * (lamps[gap] + 0.5) + [1.0, 0.1], 0.0)
    known = place_maps.tiles(40, 30, TILE_M, np.delete(lamps, gap, axis=0))
    found = PlaceIndex.of(known).candidates(place_maps.view_of(known, pose, rng, half_m=(2.4, 1.8)))
    assert place_maps.listed(found.pose, pose)
    alike = [pose[:2], 2.0 * TILE_M * (lamps[gap] + 0.5) - pose[:2]]  # lamps are square, so half a turn shows the same
    apart = np.min([np.hypot(*(found.pose[:, :2] - xy).T) for xy in alike], axis=0)
    assert np.all(apart[:2] < 0.05)
    whole = found.explained + found.contradicted == found.seen  # elsewhere the view reaches beyond the map
    assert np.all(found.missed[whole & (apart > 0.05)] >= found.missed[0] + 4)


def test_a_bare_grid_is_no_place():
    rng = np.random.default_rng(7)
    known, lamps = raster(rng, width=160, height=120, every=(40, 40), gaps=0.0)
    bare = np.append(TILE_M * (lamps[0] + 18.0), 0.2)
    found = PlaceIndex.of(known).candidates(place_maps.view_of(known, bare, rng))
    assert len(found) == 0
    assert not found.complete


def hall_with_lamps(lamps):
    """Joints that are too many to be tried, and lamps (N, 2) by their tile."""
    return place_maps.tiles(110, 110, TILE_M, np.array(lamps))


def with_features(view, xy, kind):
    """A view with more features (N, 2) in base, of types (N,)."""
    xy = np.concatenate([view.xy_base_m, xy])
    kind = np.concatenate([view.crossing_type, kind])
    return replace(view, xy_base_m=xy, var_m2=np.full(xy.shape, 1e-5), crossing_type=kind, label=np.full(len(xy), -1))


def test_a_new_lamp_on_a_bare_grid_does_not_make_the_rim_of_the_map_the_only_place():
    """What the lamp explains is listed, but all bare places, among them the right one, would be better."""
    rng = np.random.default_rng(18)
    joints = hall_with_lamps(np.zeros((0, 2), np.int64))
    lamp, kind = np.array([[0.1, 0.1], [0.4, 0.2], [0.2, 0.5], [0.5, 0.4]]), np.full(4, 1)
    xy = np.concatenate([joints.xy_map_m, lamp])
    known = place_maps.map_of(xy, np.concatenate([joints.crossing_type, kind]))
    pose = np.array([TILE_M * 50.5, TILE_M * 50.5, 0.0])
    bare = place_maps.view_of(known, pose, rng, half_m=(1.5, 1.5))
    view = replace(with_features(bare, lamp + 0.9, kind), visible_m=np.empty((0, 2)))
    index = PlaceIndex.of(known)
    found = index.candidates(view)
    rim = np.array([-0.9, -0.9, 0.0])
    assert place_maps.listed(found.pose, rim)
    assert index.counts(pose[None], view)[0][0] > 1.5 * found.explained[0]
    assert not place_maps.listed(found.pose, pose)
    assert not found.complete


def test_a_place_that_explains_all_is_found_beside_one_that_contradicts_nothing():
    """The first one looked at has most of the view on unmapped ground; the right one has five false features."""
    rng = np.random.default_rng(19)
    known = hall_with_lamps([[0, 0], [50, 50], [70, 30]])
    pose = np.array([TILE_M * 50.5 - 1.2, TILE_M * 50.5 - 1.2, 0.0])
    view = place_maps.view_of(known, pose, rng, half_m=(1.5, 1.5))
    view = with_features(view, rng.uniform(-1.4, 0.5, (5, 2)), np.full(5, 1))
    index = PlaceIndex.of(known)
    rim = np.array([TILE_M * 0.5 - 1.2, TILE_M * 0.5 - 1.2, 0.0])
    assert np.all(index.counts(rim[None], view)[1] < index.counts(pose[None], view)[1])
    found = index.candidates(view)
    assert place_maps.listed(found.pose, pose)
    assert place_maps.listed(found.pose, pose + np.array([20 * TILE_M, -20 * TILE_M, 0.0]))


def test_a_bare_grid_that_is_small_is_all_its_places():
    rng = np.random.default_rng(8)
    known = place_maps.tiles(7, 7, TILE_M, np.zeros((0, 2), np.int64))
    pose = np.array([2.0, 2.2, 0.0])
    view = place_maps.view_of(known, pose, rng, half_m=(0.8, 0.8))
    found = PlaceIndex.of(known).candidates(view)
    assert found.complete
    steps = TILE_M * np.array([(i, j) for i in (-1, 0, 1) for j in (-1, 0, 1)])
    assert all(place_maps.listed(found.pose, [*(pose[:2] + s), 0.0]) for s in steps)
    assert len(np.unique(np.round(found.pose[:, 2], 3))) == 4
    assert found.explained[0] == found.seen
