"""The drawn ceiling against arithmetic on its specification, and the listed truth against the drawing."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from ceilvo.errors import ConfigError
from ceilvo.sim.ceiling.ceiling import GROOVE, TILE, Ceiling
from ceilvo.sim.ceiling.layout import CrossingType
from ceilvo.sim.ceiling.spec import CeilingSpec
from ceilvo.types import LineKind

BARE = CeilingSpec(
    room_m=2.0, margin_m=0.5, texture=0.0, tile_spread=0.0, lamp_every=(0, 0), vents=0, spots=0, stains=0
)
FULL = CeilingSpec(room_m=4.0, margin_m=1.0, texture=0.0, stains=0)


@pytest.fixture(scope="module")
def full() -> Ceiling:
    return Ceiling(FULL, seed=3)


def sample(ceiling: Ceiling, picture: np.ndarray, xy_map: np.ndarray) -> np.ndarray:
    """Bilinear values at (..., 2) map points; the texel's address is worked out by hand, without a turned grid."""
    x0, y0 = ceiling.layout.extent[:2]
    uv = (np.asarray(xy_map) - (x0, y0)) / ceiling.spec.texel_m - 0.5
    uv = np.atleast_2d(uv).astype(np.float32).reshape(1, -1, 2)
    return cv2.remap(picture, uv, None, cv2.INTER_LINEAR)[0]


def test_bare_grid_has_the_number_of_crossings_that_arithmetic_gives() -> None:
    xy, kind = Ceiling(BARE).true_crossings()
    # from -0.5 to 2.5 m: x = 0.137 + 0.6 k, k = -1..3; y = 0.418 + 0.6 k, k = -1..3
    assert len(xy) == 25
    assert (kind == CrossingType.CROSS).all()
    np.testing.assert_allclose(np.unique(xy[:, 0].round(9)), 0.137 + 0.6 * np.arange(-1, 4))
    np.testing.assert_allclose(np.unique(xy[:, 1].round(9)), 0.418 + 0.6 * np.arange(-1, 4))


def test_darkness_across_a_groove_has_its_width_and_centre() -> None:
    spec = CeilingSpec(**{**BARE.__dict__, "lip_m": 0.0})
    c = Ceiling(spec)
    x0, y0 = c.layout.extent[:2]
    row = c.albedo[int((0.75 - y0) / spec.texel_m)].astype(float)  # y = 0.75 m is between grooves
    x = x0 + (np.arange(len(row)) + 0.5) * spec.texel_m
    for at in c.layout.grooves[0][1:-1]:
        near = np.abs(x - at) < 0.05
        level = np.polyval(np.polyfit(x[near][[0, -1]], row[near][[0, -1]], 1), x[near])
        dark = (level - row[near]) / (level - GROOVE)
        assert abs(dark.sum() * spec.texel_m - 0.008) < 1e-5
        assert abs((dark * x[near]).sum() / dark.sum() - at) < 1e-5


def test_lips_are_brighter_than_the_tile_and_the_joint_darker() -> None:
    c = Ceiling(BARE)
    x = c.layout.grooves[0][2]
    joint, lip, tile = (sample(c, c.albedo, [x + d, 0.75])[0] for d in (0.0, 0.0065, 0.1))
    assert joint < 0.3 < tile < lip
    assert abs(tile - TILE) < 0.08


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_listed_grooves_are_dark_and_what_is_not_listed_is_hidden(seed: int) -> None:
    c = Ceiling(FULL, seed)
    lines = c.true_lines()
    grooves = lines.segments[lines.kind == LineKind.GROOVE]
    assert len(grooves) > 20
    for (xa, ya), (xb, yb) in grooves:
        n = max(2, int(np.hypot(xb - xa, yb - ya) / 0.05))
        share = np.linspace(0.0, 1.0, n + 2)[1:-1]
        inside = np.column_stack([xa + share * (xb - xa), ya + share * (yb - ya)])
        assert sample(c, c.albedo, inside).max() < 0.45
    joints = grooves[[g[0, 0] in c.layout.grooves[0] or g[0, 1] in c.layout.grooves[1] for g in grooves]]
    assert len(grooves) - len(joints) > 20, "gaps, slots and rings"
    listed = np.hypot(*(joints[:, 1] - joints[:, 0]).T).sum()
    everything = sum(len(g) for g in c.layout.grooves) * (FULL.room_m + 2 * FULL.margin_m)
    hidden = sum(0.592 if p.recessed else 0.3 for p in c.layout.lamps)  # the one groove behind each lamp
    assert abs(everything - listed - hidden) < 1e-6


def test_crossings_behind_a_lamp_are_not_listed_and_its_neighbours_are_tees(full: Ceiling) -> None:
    xy, kind = full.true_crossings()
    troffer = next(p for p in full.layout.lamps if p.recessed)
    x0, y0, x1, y1 = troffer.rect
    middle = np.array([0.5 * (x0 + x1), y0 - 0.004])  # the groove it hides ends at its long sides
    nearest = np.hypot(*(xy - middle).T).argmin()
    np.testing.assert_allclose(xy[nearest], middle, atol=1e-9)
    assert kind[nearest] == CrossingType.TEE
    grid = kind <= CrossingType.TEE
    inside = (xy[:, 0] > x0) & (xy[:, 0] < x1) & (xy[:, 1] > y0) & (xy[:, 1] < y1)
    assert not (inside & grid).any()
    assert (kind == CrossingType.LAMP).sum() == 4 * len(full.layout.lamps)


def test_edges_rise_and_fall_as_listed(full: Ceiling) -> None:
    day, lamps = full.radiance()
    picture = day + lamps
    lines = full.true_lines()
    edges = lines.kind != LineKind.GROOVE
    assert edges.sum() > 20
    seen = set()
    for (a, b), axis, kind in zip(lines.segments[edges], lines.axis[edges], lines.kind[edges], strict=True):
        normal = np.array([1.0, 0.0]) if axis == 0 else np.array([0.0, 1.0])
        middle = 0.5 * (a + b) + 0.013 * normal[::-1]  # beside the middle, where diffusers have no centre
        if np.hypot(*(b - a)) < 0.1:
            middle = 0.5 * (a + b)
        before, after = sample(full, picture, np.array([middle - 0.006 * normal, middle + 0.006 * normal]))
        assert np.sign(after - before) == kind
        seen.add((int(axis), int(kind)))
    assert seen == {(0, 1), (0, -1), (1, 1), (1, -1)}


def test_a_turned_grid_has_its_crossings_turned_about_the_room_centre() -> None:
    yaw = 0.3
    turned = Ceiling(CeilingSpec(**{**BARE.__dict__, "grid_yaw_rad": yaw}))
    xy, _ = turned.true_crossings()
    c, s = np.cos(yaw), np.sin(yaw)
    one = np.array([0.137 + 0.6, 0.418 + 0.6]) - 1.0
    expected = np.array([c * one[0] - s * one[1], s * one[0] + c * one[1]]) + 1.0
    assert np.hypot(*(xy - expected).T).min() < 1e-9
    uv = (turned.texel_from_map @ [*expected, 1.0])[:2].astype(np.float32)
    assert cv2.remap(turned.albedo, uv.reshape(1, 1, 2), None, cv2.INTER_LINEAR)[0, 0] < 0.25


def test_lamps_shine_only_when_lit_and_the_room_darkens_without_them(full: Ceiling) -> None:
    first = full.layout.lamps[0]
    centre = np.array([[0.5 * (first.rect[0] + first.rect[2]), 0.5 * (first.rect[1] + first.rect[3])]])
    tile = np.array([[full.layout.grooves[0][4] + 0.1, full.layout.grooves[1][4] + 0.1]])
    light = {lit: sum(full.radiance(lit, 0.3)) for lit in (None, (), (0,), (1,))}
    assert sample(full, light[None], centre) > 3.0
    assert sample(full, light[(0,)], centre) > 3.0
    assert sample(full, light[(1,)], centre) < 0.9
    assert sample(full, light[()], centre) < 0.3
    np.testing.assert_allclose(sample(full, light[()], tile), 0.3 * sample(full, full.albedo, tile), rtol=1e-5)


def test_a_seed_is_a_ceiling() -> None:
    spec = CeilingSpec(room_m=2.0, margin_m=0.5)
    a, b, other = Ceiling(spec, 5), Ceiling(spec, 5), Ceiling(spec, 6)
    np.testing.assert_array_equal(a.albedo, b.albedo)
    assert not np.array_equal(a.albedo, other.albedo)
    assert a.layout.panels == b.layout.panels


@pytest.mark.parametrize("bad", [{"tile_m": 0.0}, {"texel_m": -1.0}, {"groove_m": 0.4}])
def test_impossible_ceilings_are_refused(bad: dict[str, float]) -> None:
    with pytest.raises(ConfigError, match=next(iter(bad))):
        CeilingSpec(**bad)


def test_intersections_hold_every_crossing_and_more(full: Ceiling) -> None:
    xy, _ = full.true_crossings()
    near = full.true_intersections(reach_m=0.01)
    distance = np.hypot(*(xy[:, None] - near[None]).transpose(2, 0, 1)).min(axis=1)
    vent = next(p for p in full.layout.panels if p.kind == "vent")  # its slots' corners, not the opening's
    assert (distance < 1e-9).sum() >= len(xy) - 4 * sum(p.kind == "vent" for p in full.layout.panels)
    slot = vent.steps()[0]
    assert np.hypot(*(near - np.array(slot[:2])).T).min() < 1e-9
    assert len(full.true_intersections(reach_m=0.1)) > len(near)


def test_bare_intersections_are_the_crossings() -> None:
    c = Ceiling(BARE)
    order = lambda a: a[np.lexsort(a.T.round(6))]  # noqa: E731
    np.testing.assert_allclose(order(c.true_intersections(0.05)), order(c.true_crossings()[0]), atol=1e-9)


def test_hexagons_have_joints_half_a_tile_from_their_middle_and_nowhere_nearer() -> None:
    spec = CeilingSpec(pattern="hexagons", vents=0, spots=0, stains=0, lamp_every=(0, 0), texture=0.0, room_m=3.0)
    ceiling = Ceiling(spec, seed=4)
    middle = np.array(spec.grid_offset_m) + spec.tile_m * np.array([2.0, np.sqrt(3.0)])
    angle = np.pi / 3.0 * np.arange(6)
    out = np.column_stack([np.cos(angle), np.sin(angle)])
    joint, inside = (sample(ceiling, ceiling.albedo, middle + k * spec.tile_m * out) for k in (0.5, 0.45))
    assert np.max(joint) < 0.5 * TILE < np.min(inside)


def test_slats_run_one_way() -> None:
    spec = CeilingSpec(pattern="slats", vents=0, spots=0, stains=0, lamp_every=(0, 0), texture=0.0, room_m=3.0)
    ceiling = Ceiling(spec, seed=4)
    lines = ceiling.true_lines()
    at = np.unique(np.round(lines.segments[:, 0, 0], 6))
    assert set(lines.axis.tolist()) == {0} and len(ceiling.true_crossings()[0]) == 0
    assert np.allclose(np.diff(at), spec.slat_m)
    inside = at[(at > 0.5) & (at < 2.5)]
    groove = sample(ceiling, ceiling.albedo, np.column_stack([inside, np.full(len(inside), 1.5)]))
    assert np.max(groove) < 0.5 * TILE


def test_round_lamps_shine_round_their_middles_and_have_no_corners() -> None:
    ceiling = Ceiling(CeilingSpec(joints=False, vents=0, spots=0, stains=0, round_lamps=True, room_m=3.0), seed=4)
    x0, y0, x1, y1 = ceiling.layout.lamps[0].inner
    middle, radius = np.array([0.5 * (x0 + x1), 0.5 * (y0 + y1)]), 0.5 * (x1 - x0)
    angle = 2.0 * np.pi * np.arange(12) / 12
    out = np.column_stack([np.cos(angle), np.sin(angle)])
    light = sum(ceiling.radiance())
    assert np.min(sample(ceiling, light, middle + 0.9 * radius * out)) > 3.0
    assert np.max(sample(ceiling, light, middle + 1.1 * radius * out)) < 2.0
    assert len(ceiling.true_crossings()[0]) == 0
