"""What `make soak` makes of poses and memory that are made up: each bar can be missed."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise

import pytest

from ceilvo.bench.soak.fault_plan import Fault, Stroke, floods, strokes
from ceilvo.bench.soak.flood_verdict import flood_bars, flood_lines, floods_met
from ceilvo.bench.soak.parts import Heard, PoseRow, Usage
from ceilvo.bench.soak.poses import Poses
from ceilvo.bench.starved.command import wrong_s
from ceilvo.sim.world import World, WorldSpec
from ceilvo.types import State

RATE_HZ = 10.0
FLOODS = floods(1200.0, ["puts", "router"])
"""From 200 to 617 and from 700 to 1117 s, with 83 s to rest."""


@pytest.fixture(scope="module")
def world() -> World:
    return World(WorldSpec(seed=1))


def poses(world: World, left_out: Stroke | None = None, every: int = 2) -> Poses:
    """Ten a second; in `left_out` only every n-th."""
    rows = []
    for k in range(round(1200.0 * RATE_HZ)):
        t_s = k / RATE_HZ
        if left_out is None or not left_out.from_s <= t_s < left_out.to_s or k % every == 0:
            rows.append(PoseRow(round(1e9 * t_s), round(1e9 * t_s), State.TRACKING, 0.0, 0.0, 0.0, k))
    return Poses(Heard(rows), world, 0)


def looks(grown_to: float = 1.0, descriptors: int = 30) -> list[Usage]:
    """Every 5 s; after the first flood memory and descriptors are these."""
    before = Usage(0.0, 100_000_000, 30, 20, 0.0)
    after = replace(before, rss_bytes=round(1e8 * grown_to), descriptors=descriptors)
    return [replace(after if t > FLOODS[0].from_s else before, t_s=float(t)) for t in range(0, 1200, 5)]


def missed(found: dict[str, dict[str, object]]) -> set[str]:
    return {name for name, met, _ in flood_bars(found) if not met}


def test_one_flood_after_the_other_with_a_fifth_to_rest() -> None:
    assert [(round(s.from_s), round(s.to_s)) for s in FLOODS] == [(200, 617), (700, 1117)]
    assert floods(7200.0, ["a", "b"])[0].from_s == 600.0, "a long run is warm before"


def test_a_flood_that_costs_nothing_meets_its_bars(world: World) -> None:
    found = floods_met(poses(world), looks(), FLOODS, {"puts": 7})
    assert missed(found) == set()
    assert found["puts"]["struck"] == 7
    assert abs(found["puts"]["rate_share"] - 1.0) < 1e-3
    assert "struck 7 times" in flood_lines(found)[0]


def test_half_the_poses_are_missed_also_where_the_camera_was_away(world: World) -> None:
    away = [Stroke(Fault("unplugged", "camera", 100.0), 250.0)]
    found = floods_met(poses(world, FLOODS[0]), looks(), [*away, *FLOODS], {})
    assert missed(found) == {"rate in puts"}
    assert abs(found["puts"]["rate_share"] - 0.5) < 0.01


def test_what_a_flood_leaves_behind_is_noticed(world: World) -> None:
    assert missed(floods_met(poses(world), looks(1.2), FLOODS, {})) == {"memory after puts"}
    assert missed(floods_met(poses(world), looks(descriptors=31), FLOODS, {})) == {"memory after puts"}


def test_the_faults_of_the_plan_do_not_overlap() -> None:
    plan = strokes(3600.0)
    assert all(b.from_s >= a.to_s for a, b in pairwise(plan))


def test_a_pose_on_a_starved_computer_is_wrong_by_its_place_or_by_its_heading(world: World) -> None:
    def row(k: int, state: State, by_m: float, by_rad: float) -> PoseRow:
        x, y, theta = world.truth_at(0.1 * k)
        return PoseRow(k * 10**8, k * 10**8, state, x + by_m, y, theta + by_rad + 2.0 * math.pi, k)

    offs = [(0.29, 0.08), (0.31, 0.0), (-0.31, 0.0), (0.0, 0.09), (0.0, -0.09), (0.0, 0.0)]
    rows = [row(k, State.TRACKING, *off) for k, off in enumerate(offs)]
    rows += [row(len(rows), State.DEGRADED, 1.0, 0.0), row(len(rows) + 1, State.TRACKING, 0.0, 0.0)]
    made = Poses(Heard(rows), world, 0)
    assert abs(wrong_s(made, State.TRACKING) - 0.4) < 1e-6
    assert abs(wrong_s(made, State.DEGRADED) - 0.1) < 1e-6
