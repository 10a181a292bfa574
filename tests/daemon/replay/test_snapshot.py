"""A pipeline's state as text: another one goes on from it to the last bit, whatever the filter."""

from __future__ import annotations

import contextlib
import json
import re
from collections.abc import Callable
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import golden_drives as drives
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from ceilvo.calibration_file import parse_calibration
from ceilvo.config import Config, Features, Filter
from ceilvo.daemon import cli
from ceilvo.daemon.pipeline import Pipeline
from ceilvo.daemon.replay.snapshot import SnapshotError, freeze, read_value, restore, snapshot_json, value_json
from ceilvo.daemon.replay.trajectory import estimate_json
from ceilvo.drivers.recording.mcap_reader import open_recording
from ceilvo.sim.camera import SimCamera
from ceilvo.sim.world import World, WorldSpec
from ceilvo.types import Crossings, Frame, Motion, WheelMotion

SEED = 11
METHODS = ("pfcf_paper", "joint", "pf", "ukf")


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
            text = json.dumps(snapshot_json(freeze(one), method))
            restore(other, json.loads(text))
            restored = True
        now = step(one, frame)
        if restored:
            assert step(other, frame) == now, f"{method}, frame {i}"


def test_what_was_frozen_does_not_change_any_more(world: World, frames: list[Frame]) -> None:
    pipeline = fresh(world, "joint")
    for frame in frames[:20]:
        step(pipeline, frame)
    frozen = freeze(pipeline)
    before = json.dumps(snapshot_json(frozen, "joint"))
    for frame in frames[20:30]:
        step(pipeline, frame)
    assert json.dumps(snapshot_json(frozen, "joint")) == before
    assert json.dumps(snapshot_json(freeze(pipeline), "joint")) != before


def test_sightings_replay_what_frames_gave(world: World, frames: list[Frame]) -> None:
    whole, rest = fresh(world, "pfcf_paper"), fresh(world, "pfcf_paper")
    for frame in frames[:25]:
        estimate = whole.step(frame)
        assert whole.vision.view is not None
        crossings = read_value(value_json(whole.vision.view.crossings), Crossings)
        assert estimate_json(rest.step_crossings(frame.stamp_ns, crossings)) == estimate_json(estimate)


def test_a_state_has_no_names_of_the_program(world: World, frames: list[Frame]) -> None:
    """So that a rename does not invalidate a recording."""
    pipeline = fresh(world, "joint")
    step(pipeline, frames[0])

    def keys(tree: object) -> set[str]:
        if isinstance(tree, list):
            return set().union(*map(keys, tree))
        return set(tree).union(*map(keys, tree.values())) if isinstance(tree, dict) else set()

    tree = snapshot_json(freeze(pipeline), "joint")
    assert not [k for k in keys(tree) if k.startswith("_")]
    assert not re.search(r"ceilvo\.|Pipeline|State\b|Pfcf", json.dumps(tree))


def test_a_state_says_the_old_name_of_its_filter(world: World, frames: list[Frame]) -> None:
    """Recordings of ceilvo 0.1 call the default filter pfcf."""
    pipeline, again = fresh(world, "joint"), fresh(world, "joint")
    step(pipeline, frames[0])
    restore(again, {**snapshot_json(freeze(pipeline), "joint"), "method": "pfcf"})
    assert json.dumps(snapshot_json(freeze(again), "joint")) == json.dumps(snapshot_json(freeze(pipeline), "joint"))
    with pytest.raises(SnapshotError, match="pfcf"):
        restore(fresh(world, "ukf"), {**snapshot_json(freeze(pipeline), "joint"), "method": "pfcf"})


BROKEN: dict[str, Callable[[dict[str, Any]], object]] = {
    "another version": lambda t: t.update(version=4),
    "another filter": lambda t: t.update(method="ukf"),
    "a field is missing": lambda t: t["state"].pop("relocaliser"),
    "a field too many": lambda t: t["state"].update(more=1),
    "text for a number": lambda t: t["state"].update(seq="7"),
    "an array of another type": lambda t: t["state"]["dead_reckoning"]["odom"]["array"].__setitem__(0, "|S8"),
    "an array of another size": lambda t: t["state"]["dead_reckoning"]["odom"]["array"].__setitem__(1, [4]),
    "no such state": lambda t: t["state"]["states"].update(current=99),
}


@pytest.mark.parametrize("broken", BROKEN)
def test_a_state_of_something_else_is_refused(world: World, frames: list[Frame], broken: str) -> None:
    pipeline = fresh(world, "pfcf_paper")
    step(pipeline, frames[0])
    tree = json.loads(json.dumps(snapshot_json(freeze(pipeline), "pfcf_paper")))
    BROKEN[broken](tree)
    with pytest.raises(SnapshotError, match="pipeline state"):
        restore(fresh(world, "pfcf_paper"), tree)


FLIGHTS = sorted((drives.HERE.parent / "flight").glob("*.mcap"))


@pytest.mark.parametrize("file", FLIGHTS, ids=lambda f: f.stem)
def test_recordings_of_0_1_still_replay(file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """They begin in the middle of a run, with a state as that version kept it; what it was sure of is where it was."""
    assert cli.main(["replay", str(file), "--jsonl", str(tmp_path / "out.jsonl")]) in (0, 1)
    print(capsys.readouterr().out.splitlines()[-1])
    made = [json.loads(line) for line in (tmp_path / "out.jsonl").read_text().splitlines()]
    then = [json.loads(m.data) for m in open_recording(file).messages() if m.topic == "/estimate"]
    assert len(made) == len(then) >= 7
    both = [(a, b) for a, b in zip(made, then, strict=True) if a["state"] == b["state"] == "TRACKING"]
    for a, b in both:
        assert np.hypot(*(np.array(a["pose_map_from_base"]) - b["pose_map_from_base"])[:2]) < 0.01


@pytest.mark.parametrize("file", FLIGHTS, ids=lambda f: f.stem)
def test_a_damaged_state_of_0_1_is_our_error(file: Path) -> None:
    state = next(m for m in open_recording(file).messages() if m.topic == "/input")
    body = json.loads(state.data)["state"]
    method = "joint" if file.stem in ("tracking", "hypothesis", "gap", "frames") else file.stem
    calibration = parse_calibration(open_recording(file).text("calibration.yaml"), "calibration")
    pipeline = Pipeline(calibration, Config(filter=Filter(method=method, particles=16)), np.random.default_rng(1))
    del body["fields"]["_odom"]
    with pytest.raises(SnapshotError, match="_odom"):
        restore(pipeline, body)


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
    rest = [f.name for f in fields(Motion) if f.name not in ("prev_from_curr", "cov")]
    assert all(np.array_equal(getattr(again, name), getattr(odd, name)) for name in rest)
    assert read_value(value_json(None), Motion) is None
    with pytest.raises(SnapshotError):
        read_value(value_json(odd), Crossings)


@dataclass
class Wide:
    count: NDArray[np.int64]
    doubt: NDArray[np.float64]


@dataclass
class Narrow:
    count: NDArray[np.int16]
    doubt: NDArray[np.float32]


def test_columns_that_were_wider_in_earlier_versions_are_read() -> None:
    """Where their numbers fit; narrower ones are of no version."""
    kept = read_value(value_json(Wide(np.array([3, -70]), np.array([0.5, 2.0]))), Narrow)
    assert kept is not None and kept.count.dtype == np.int16 and kept.doubt.dtype == np.float32
    assert kept.count.tolist() == [3, -70] and kept.doubt.tolist() == [0.5, 2.0]
    with pytest.raises(SnapshotError, match="numbers that fit <i2"):
        read_value(value_json(Wide(np.array([70_000]), np.zeros(1))), Narrow)
    with pytest.raises(SnapshotError, match="found <i2, expected <i8"):
        read_value(value_json(Narrow(np.array([3], np.int16), np.zeros(1, np.float32))), Wide)
