"""`ceilvod map anchors` on a drive whose anchors are known."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from ceilvo.bench.place.case import drive_in, load_known
from ceilvo.bench.place.ceiling.worlds import WorldSpec, make_world
from ceilvo.config import Config
from ceilvo.daemon.building.radio import anchoring
from ceilvo.daemon.pipeline import Pipeline
from ceilvo.daemon.relocalisation.doubts import JUST_NOW_S
from ceilvo.daemon.replay.inputs import Input, LoadMap, Sighting
from ceilvo.errors import CeilvoError
from ceilvo.senses.beacon_file import read_beacons, write_beacons
from ceilvo.senses.beacons import Anchor, Beacons, Mark
from ceilvo.senses.heard import NOTHING, Heard
from ceilvo.sim.radio import Radio, RadioSpec
from ceilvo.sim.rig import simulated_calibration
from ceilvo.types import Pose

ANCHORS = (Anchor("A000", -1.0, 0.5, 2.0), Anchor("B000", 6.0, 1.0, 2.2))
MARK = Mark(3, 0.2, 1.0, 1.0, 0.0)


def driven(seconds: float, ranges: bool) -> list[Input]:
    """What a pipeline was given on a drive in a room of 5 m; ranges carry stamps between the frames."""
    world = make_world(WorldSpec("5", 0.6, "sparse", 4))
    drive = drive_in(world, np.random.default_rng(4), False, 5.0, True, 0.5)
    landmarks = load_known(drive, world, np.random.default_rng(4))
    start = Pose(drive.pose)
    radio = Radio(ANCHORS, RadioSpec(noise_m=0.05, obstructed=0.1), np.random.default_rng(1))
    inputs: list[Input] = [LoadMap(landmarks, world.features.axis_rad, start, np.diag([1e-6] * 3), ago_s=JUST_NOW_S)]
    give = drive.camera.give

    def noted(pipeline: Any, stamp_ns: int, seen: Any, wheels: Any, heard: Heard = NOTHING) -> Any:
        inputs.append(Sighting(stamp_ns, seen, wheels, heard))
        return give(pipeline, stamp_ns, seen, wheels, heard)

    drive.camera.give = noted  # type: ignore[method-assign]
    if ranges:
        drive.senses = lambda stamp_ns: Heard(ranges=radio.ranges(stamp_ns, np.array([*drive.pose[:2], 0.5])))
    drive.go(seconds)
    return inputs


def recorded(monkeypatch: pytest.MonkeyPatch, inputs: list[Input]) -> None:
    """In place of files: pixels are not what this is about."""
    calibration = simulated_calibration(tile_m=0.6)
    config = Config()

    def given(run: Any) -> Any:
        def stream() -> Iterator[Input]:
            yield from inputs

        made = lambda: Pipeline(calibration, config, np.random.default_rng(1))  # noqa: E731
        return SimpleNamespace(config=config, calibration=calibration, inputs=stream(), pipeline=made)

    monkeypatch.setattr(anchoring, "opened", given)
    monkeypatch.setattr(anchoring, "runs_in", lambda source: [(source,)])


def test_anchors_are_found_and_written_beside_what_is_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    recorded(monkeypatch, driven(38.0, ranges=True))
    into = tmp_path / "beacons.yaml"
    write_beacons(into, Beacons((replace(ANCHORS[0], x_m=9.0), Anchor("OLD", 1.0, 2.0, 3.0)), (MARK,)))
    text, code = anchoring.locate_anchors([Path("drive.mcap")], into, 2.0, dry_run=False)
    print(text)
    found = read_beacons(into)
    assert (
        code == 0
        and [m.number for m in found.marks] == [3]
        and [a.name for a in found.anchors] == ["A000", "B000", "OLD"]
    )
    for a, true in zip(found.anchors, ANCHORS, strict=False):
        off = float(np.hypot(a.x_m - true.x_m, a.y_m - true.y_m))
        assert off < 0.25, (a, off)


def test_a_drive_without_ranges_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    recorded(monkeypatch, driven(2.0, ranges=False))
    with pytest.raises(CeilvoError, match=r"found no ranges while the pose was TRACKING.*ceilvod record"):
        anchoring.locate_anchors([Path("drive.mcap")], tmp_path / "beacons.yaml", 2.0, dry_run=True)
    assert not list(tmp_path.iterdir())
