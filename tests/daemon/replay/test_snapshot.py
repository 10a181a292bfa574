"""A pipeline's state as text: another one goes on from it to the last bit, whatever the filter."""

from __future__ import annotations

import contextlib
import json
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ceilvo.config import Config, Features, Filter
from ceilvo.daemon.pipeline import Pipeline
from ceilvo.daemon.replay.snapshot import SnapshotError, freeze, read_value, restore, snapshot_json, value_json
from ceilvo.daemon.replay.trajectory import estimate_json
from ceilvo.sim.camera import SimCamera
from ceilvo.sim.world import World, WorldSpec
from ceilvo.types import Crossings, Frame, Motion, WheelMotion

SEED = 11
METHODS = ("pfcf_paper", "pfcf", "pf", "ukf")


@pytest.fixture(scope="module")
def world() -> World:
    return World(WorldSpec(seed=SEED))


@pytest.fixture(scope="module")
def frames(world: World) -> list[Frame]:
    camera = SimCamera(world, 10.0, realtime=False, duration_s=3.5)
    camera.open()
    return list(iter(camera.read, None))


def fresh(world: World, method: str, seed: int = 1, full_every: int = 1) -> Pipeline:
    config = Config(filter=Filter(method=method), features=Features(full_every=full_every))
    return Pipeline(world.calibration, config, np.random.default_rng(seed))


def step(pipeline: Pipeline, frame: Frame) -> str:
    """With wheels, and a frame in which nothing is seen now and then."""
    wheels = WheelMotion(np.array([0.03, 0.0, 0.001]), np.diag([1e-4, 1e-4, 1e-4]))
    if frame.seq % 13 == 12:
        return estimate_json(pipeline.step_crossings(frame.stamp_ns, None, wheels, missing="nothing seen"))
    return estimate_json(pipeline.step(frame, wheels if frame.seq % 3 else None))


@pytest.mark.parametrize(("method", "full_every"), [*((m, 1) for m in METHODS), ("pfcf_paper", 4)])
def test_another_pipeline_goes_on_to_the_last_bit(
    world: World, frames: list[Frame], method: str, full_every: int
) -> None:
    """At several moments, into a pipeline of another seed that has seen other things."""
    one, other = fresh(world, method, full_every=full_every), fresh(world, method, seed=99, full_every=full_every)
    for frame in frames[5:9]:
        step(other, frame)
    restored = False
    for i, frame in enumerate(frames):
        if i in (11, 23):
            text = json.dumps(snapshot_json(freeze(one)))
            restore(other, json.loads(text))
            restored = True
        now = step(one, frame)
        if restored:
            assert step(other, frame) == now, f"{method}, frame {i}"


def test_what_was_frozen_does_not_change_any_more(world: World, frames: list[Frame]) -> None:
    pipeline = fresh(world, "pfcf")
    for frame in frames[:20]:
        step(pipeline, frame)
    frozen = freeze(pipeline)
    before = json.dumps(snapshot_json(frozen))
    for frame in frames[20:30]:
        step(pipeline, frame)
    assert json.dumps(snapshot_json(frozen)) == before
    assert json.dumps(snapshot_json(freeze(pipeline))) != before


def test_sightings_replay_what_frames_gave(world: World, frames: list[Frame]) -> None:
    whole, rest = fresh(world, "pfcf_paper"), fresh(world, "pfcf_paper")
    for frame in frames[:25]:
        estimate = whole.step(frame)
        assert whole.view is not None
        crossings = read_value(value_json(whole.view.crossings), Crossings)
        assert estimate_json(rest.step_crossings(frame.stamp_ns, crossings)) == estimate_json(estimate)


def test_a_state_of_something_else_is_refused(world: World, frames: list[Frame]) -> None:
    pipeline = fresh(world, "pfcf_paper")
    step(pipeline, frames[0])
    state = snapshot_json(freeze(pipeline))
    for path in (
        "os.system",
        "ceilvo.drivers.host.machine.Machine",
        "ceilvo.daemon.app.process.Daemon",
        "ceilvo.daemon.no.Thing",
    ):
        with pytest.raises(SnapshotError):
            restore(fresh(world, "pfcf_paper"), replace_name(state, path))
    with pytest.raises(SnapshotError):
        restore(fresh(world, "pfcf_paper"), {"again": 7})


def replace_name(state: dict[str, object], path: str) -> dict[str, object]:
    fields = dict(state["fields"])  # type: ignore[call-overload]
    fields["_states"] = {**fields["_states"], "object": path}
    return {**state, "fields": fields}


trees = st.recursive(
    st.none() | st.integers() | st.text(max_size=5) | st.lists(st.integers(), max_size=2),
    lambda inner: st.dictionaries(
        st.sampled_from(("number", "object", "fields", "array", "again", "enum", "dict", "float", "list", "generator")),
        inner | st.just("ceilvo.types.Motion"),
        max_size=4,
    ),
    max_leaves=12,
)


@given(trees)
def test_any_json_is_a_value_or_our_error(tree: object) -> None:
    with contextlib.suppress(SnapshotError):
        assert isinstance(read_value(json.dumps(tree).encode(), Motion), Motion | None)


def test_a_value_keeps_its_bits() -> None:
    odd = Motion(np.array([0.1, -0.0, np.nan]), np.asfortranarray(np.arange(9.0).reshape(3, 3)), 3, float("inf"), None)
    again = read_value(value_json(odd), Motion)
    assert again.prev_from_curr.tobytes() == odd.prev_from_curr.tobytes()
    assert again.cov.flags.f_contiguous and np.array_equal(again.cov, odd.cov)
    assert replace(again, prev_from_curr=odd.prev_from_curr, cov=odd.cov) == odd
    assert read_value(value_json(None), Motion) is None
    with pytest.raises(SnapshotError):
        read_value(value_json(odd), Crossings)
