"""Inputs of a replay that no run has: refused with one line, whatever the pipeline would have made of them."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from ceilvo.bench.fuzz.engine.target import PERIOD_NS, crossings, pipeline, rig, wheels
from ceilvo.bench.fuzz.targets.pipeline_inputs import driven
from ceilvo.calibration import CeilingShape
from ceilvo.daemon.replay.inputs import Continuation, Input, LoadMap, SetPose, Sighting, check_plausible, read_input
from ceilvo.daemon.replay.replay import Outputs, replay
from ceilvo.daemon.replay.snapshot import snapshot_json
from ceilvo.errors import FileFormatError
from ceilvo.types import Displacement, Frame, Landmarks, Pose, WheelMotion

POSE, COV = Pose(np.array([0.1, 0.2, 0.3])), 0.01 * np.eye(3)
_NONE = np.zeros(0, np.int64)
NOTHING = Landmarks(_NONE, np.zeros((0, 2)), np.zeros((0, 2, 2)), _NONE, _NONE)


def run(*given: Input) -> int:
    return len(replay(iter(given), pipeline(), rig(), Outputs(), source="a.mcap"))


def views(count: int, first: int = 0) -> list[Sighting]:
    return [Sighting((k + 1) * PERIOD_NS, crossings(k), wheels()) for k in range(first, first + count)]


def test_what_a_run_has_is_plausible() -> None:
    landmarks = driven().filter.landmarks()
    for given in (*views(3), LoadMap(landmarks, 0.1, POSE, COV), SetPose(POSE, COV, "said")):
        check_plausible(given)
    assert run(*views(3)) == 3


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("uv_px", lambda v: v[:-1]),
        ("xy_base_m", lambda v: v[:, :1]),
        ("xy_base_m", lambda v: v + np.nan),
        ("cov_base_m2", lambda v: v[:, 0]),
        ("cov_base_m2", lambda v: -v),
        ("crossing_type", lambda v: np.array(4)),
        ("crossing_type", lambda v: v + 9),
        ("crossing_type", lambda v: v - 9),
        ("psi_rad", lambda v: float("inf")),
        ("tilt_rad", lambda v: np.zeros(3)),
        ("tilt_sigma_rad", lambda v: -1.0 - v),
        ("common_cov_m2", lambda v: np.array([[1.0, 2.0], [0.0, 1.0]])),
        ("sample_gray", lambda v: np.zeros((2, 2), np.uint8)),
        ("lines", lambda v: replace(v, axis=v.axis + 2)),
        ("lines", lambda v: replace(v, offset_m=v.offset_m[:-1])),
        ("lines", lambda v: replace(v, sigma_m=-v.sigma_m)),
        ("lines", lambda v: replace(v, kind=v.kind + 5)),
    ],
)
def test_crossings_that_do_not_fit_each_other_are_refused(name: str, change: Callable[[Any], Any]) -> None:
    seen = crossings(0)
    given = Sighting(1, replace(seen, **{name: change(getattr(seen, name))}))
    with pytest.raises(FileFormatError, match=r"Sighting in the recording: .* damaged"):
        check_plausible(given)


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("ids", lambda v: np.zeros_like(v)),
        ("ids", lambda v: v[:-1]),
        ("ids", lambda v: v - 1),
        ("xy_map_m", lambda v: v + 2e6),
        ("cov_m2", lambda v: v + np.array([[0.0, 3.0], [0.0, 0.0]])),
        ("crossing_type", lambda v: v + 9),
    ],
)
def test_maps_that_cannot_be_are_refused(name: str, change: Callable[[Any], Any]) -> None:
    m = driven().filter.landmarks()
    given = LoadMap(replace(m, **{name: change(getattr(m, name))}), 0.1, POSE, COV)
    with pytest.raises(FileFormatError, match=r"LoadMap in the recording: .* damaged"):
        check_plausible(given)


@pytest.mark.parametrize(
    "given",
    [
        LoadMap(NOTHING, 1e6, POSE, COV),
        *(LoadMap(NOTHING, 0.1, POSE, COV, ago_s) for ago_s in (-1.0, float("nan"))),
        *(LoadMap(NOTHING, 0.1, POSE, COV, 0.0, elsewhere) for elsewhere in (-0.1, 1.5, float("nan"))),
        *(LoadMap(NOTHING, 0.1, POSE, COV, ceiling=CeilingShape((0.4, drop))) for drop in (1e9, float("nan"))),
        *(LoadMap(NOTHING, 0.1, POSE, COV, ceiling=CeilingShape((), slope)) for slope in ((0.1,), (0.1, 1e9, 1.0))),
        SetPose(POSE, np.zeros((3, 3)), "no variance"),
        SetPose(Pose(np.full(3, 1e9)), COV, "too far"),
        Sighting(1, None, WheelMotion(Displacement(POSE), -COV)),
    ],
)
def test_beliefs_that_cannot_be_are_refused(given: Input) -> None:
    with pytest.raises(FileFormatError, match=r"in the recording: .* damaged"):
        check_plausible(given)


@pytest.mark.parametrize("stamp_ns", [0, PERIOD_NS, 2 * PERIOD_NS])
def test_time_does_not_go_back(stamp_ns: int) -> None:
    with pytest.raises(FileFormatError, match=rf"a\.mcap: a frame or silence at {stamp_ns} ns, expected one after"):
        run(*views(2), replace(views(1)[0], stamp_ns=stamp_ns))


@pytest.mark.parametrize("stamp", ["1e400", "-1", "1" * 30, "[]", '"x"', "null"])
def test_a_stamp_that_is_none_is_refused(stamp: str) -> None:
    line = b'{"number":1,"input":"silence","stamp_ns":%s,"reason":"x","wheels":null}' % stamp.encode()
    with pytest.raises(FileFormatError, match="damaged"):
        read_input(line, lambda seq, stamp_ns: Frame(seq, stamp_ns, np.zeros((0, 0), np.uint8)))


def test_a_state_whose_arrays_do_not_fit_each_other_ends_the_replay_with_one_line() -> None:
    """Each array by itself is as it may be."""
    tree = json.loads(json.dumps(snapshot_json(driven().state, "joint")))
    assert run(Continuation(tree), *views(2, first=6)) == 2
    mean = tree["state"]["filter"]["joint"]["mean"]["array"]
    mean[1], mean[3] = [3], mean[3][:32]
    with pytest.raises(
        FileFormatError, match=r"a\.mcap: the state .* does not go together \(\w+ at \w+\.py:\d+: "
    ) as e:
        run(Continuation(tree), *views(2, first=6))
    assert "\n" not in str(e.value)


def test_a_fault_of_our_own_is_not_called_damage(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*_: object) -> None:
        raise IndexError("a fault in the pipeline")

    monkeypatch.setattr("ceilvo.daemon.replay.replay.apply", broken)
    with pytest.raises(IndexError, match="a fault in the pipeline"):
        run(*views(1))
