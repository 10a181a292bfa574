"""Ranges and marks as the configuration says."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from ceilvo.config import Config
from ceilvo.config.reader import beside
from ceilvo.daemon.app.senses.beacons import BeaconSenses
from ceilvo.errors import ConfigError
from ceilvo.senses.heard import NOTHING
from ceilvo.sim.rig import simulated_calibration
from ceilvo.types import Frame

FILE = """\
version: 1
anchors:
  - {name: "0C14", x_m: 0.0, y_m: 1.0, z_m: 2.1}
marks:
  - {id: 7, size_m: 0.2, x_m: 4.0, y_m: -2.0, theta_deg: 90}
"""


def senses(folder: Path, **keys: object) -> BeaconSenses:
    (folder / "beacons.yaml").write_text(FILE)
    config = replace(Config(), beacons=replace(Config().beacons, file="beacons.yaml", **keys))  # type: ignore[arg-type]
    return BeaconSenses(beside(config, folder / "config.yaml"), "ceilvo/r", lambda: 10**9, lambda e: None)


def with_tag() -> Frame:
    gray = np.full((480, 640), 130, np.uint8)
    tag = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11).generateImageMarker(7, 80)
    gray[180:300, 280:400] = 255
    gray[200:280, 300:380] = tag
    return Frame(1, 10**9, gray)


def test_the_file_counts_from_the_configurations_folder(tmp_path: Path) -> None:
    known = senses(tmp_path).known
    assert [a.name for a in known.anchors] == ["0C14"] and [m.number for m in known.marks] == [7]


def test_every_third_picture_is_looked_at_while_the_place_is_sure_and_all_in_doubt(tmp_path: Path) -> None:
    s, frame = senses(tmp_path), with_tag()
    assert [len(s.shown(frame, True, NOTHING).marks) for _ in range(6)] == [0, 0, 1, 0, 0, 1]
    assert [len(s.shown(frame, False, NOTHING).marks) for _ in range(3)] == [1, 1, 1]
    assert senses(tmp_path, marks=False).shown(frame, False, NOTHING) is NOTHING


def test_lamps_are_looked_for_where_the_file_has_some(tmp_path: Path) -> None:
    gray = np.full((480, 640), 90, np.uint8)
    cv2.circle(gray, (200, 260), 14, 250, -1)
    frame = Frame(1, 10**9, gray)
    assert senses(tmp_path).shown(frame, False, NOTHING).lamps is None
    (tmp_path / "beacons.yaml").write_text("version: 1\nlamps: [{name: L1, x_m: 1, y_m: 2}]\n")
    config = replace(Config(), beacons=replace(Config().beacons, file=str(tmp_path / "beacons.yaml")))
    s = BeaconSenses(config, "ceilvo/r", lambda: 0, lambda e: None, simulated_calibration())
    lamps = s.shown(frame, False, NOTHING).lamps
    assert lamps is not None
    (lamp,) = lamps
    assert np.hypot(*(lamp.at_px - [200.0, 260.0])) < 1.0
    assert [s.shown(frame, True, NOTHING).lamps is None for _ in range(3)].count(False) == 1


def test_ranges_come_by_zenoh_where_that_is_chosen(tmp_path: Path) -> None:
    s = senses(tmp_path, ranges="zenoh")
    assert s.keys == ("ceilvo/r/ranges",)
    assert s.counters() == {"ranging": {"messages": 0, "malformed": 0}}
    topic = s._topic
    assert topic is not None
    topic.take(json.dumps({"schema": "ceilvo.ranges.1", "ranges": [{"anchor": "0C14", "range_m": 2.5}]}).encode())
    assert [(r.anchor, r.range_m) for r in s.ranges(10**9)] == [("0C14", 2.5)]


def test_by_default_nothing_is_heard() -> None:
    s = BeaconSenses(Config(), "ceilvo/r", lambda: 0, lambda e: None)
    assert (
        s.keys == ()
        and s.counters() == {}
        and s.ranges(10**18) == ()
        and s.shown(with_tag(), False, NOTHING) is NOTHING
    )


def test_a_file_that_cannot_be_used_is_named(tmp_path: Path) -> None:
    config = replace(Config(), beacons=replace(Config().beacons, file=str(tmp_path / "nothing.yaml")))
    with pytest.raises(ConfigError, match=r"nothing\.yaml.*no such file"):
        BeaconSenses(config, "ceilvo/r", lambda: 0, lambda e: None)
