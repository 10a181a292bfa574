"""The bench of a fleet, small: real processes and Zenoh, two kills of the service, and robots that lie."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from ceilvo.bench.fleet.hostile import LIES
from ceilvo.bench.fleet.run import Plan, judged, run

PLAN = Plan(
    robots=9,
    processes=1,
    rounds=3,
    kills=1,
    size_m=(20.0, 10.0),
    surveyed_m=10.0,
    region_m=(12.0, 10.0),
    round_s=0.0,
    renovated_at=3,
    lies=("shifted", "garbage", "unknown key", "invented 1", "invented 2"),
    merge_period_s=0.2,
)


def test_nothing_is_lost_and_nobody_changes_what_others_use(tmp_path: Path) -> None:
    out = run(PLAN, tmp_path)
    found = judged(out)
    assert out.kills == 1 and len(out.robots) == 9
    assert found.acknowledged > 300 and found.lost == 0
    assert found.invented == 0 and found.behind == 0
    assert found.landmarks > 700 and found.rms_m < 0.004
    lies = {r["lie"]: r["answers"] for r in out.robots if r["lie"]}
    assert (
        not lies["shifted"].get("taken") and not lies["garbage"].get("taken") and not lies["unknown key"].get("taken")
    )
    assert set(PLAN.lies) <= set(LIES)
    # the judge sees what is lost, invented and behind
    assert out.map is not None
    half = replace(out, map=out.map.of(np.arange(len(out.map) // 2)), claimed=np.empty((0, 3)), root="other")
    assert judged(half).lost > 0 and judged(half).behind == 4
    beside = replace(out.map, xy_map_m=out.map.xy_map_m + 0.15 * (np.arange(len(out.map)) % 2)[:, None])
    assert judged(replace(out, map=beside)).invented > 100
