"""What is switched off costs nothing: no library is loaded, no thread runs, nothing is declared."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

LOOK = """
import json, sys, threading
from ros2_parts import calibration
from zenoh_world import Robot
from ceilvo.config import Config
from ceilvo.config.reader import replace
from ceilvo.daemon.app import process
from ceilvo.daemon.app.wires import wires_of
before = set(sys.modules)
wires = wires_of(replace(Config(), sys.argv[1:]), calibration(), Robot().handlers())
for wire in wires.others:
    wire.open()
names = [t.name for t in threading.enumerate()]
print(json.dumps([len(wires.others), wires.bus is not None, names, sorted({m.split(".")[0] for m in sys.modules})]))
for wire in wires.others:
    wire.close()
"""
COMMON = Path(__file__).resolve().parents[2] / "common"
OTHERS = {"rosbags", "xxhash", "cyclonedds", "paho", "foxglove", "zenoh_ros2_sdk", "mcap", "foxglove_schemas_protobuf"}


def look(*settings: str) -> tuple[int, bool, list[str], set[str]]:
    done = subprocess.run(
        [sys.executable, "-c", LOOK, *settings],
        cwd=COMMON,
        capture_output=True,
        text=True,
        check=True,
    )
    others, bus, threads, modules = json.loads(done.stdout)
    return others, bus, threads, set(modules)


@pytest.mark.parametrize("settings", [(), ("zenoh.enabled=false",), ("zenoh.wire=[json]", "ros2.domain_id=3")])
def test_json_alone_has_no_other_wire(settings: tuple[str, ...]) -> None:
    others, bus, threads, modules = look(*settings)
    assert (others, bus) == (0, "zenoh.enabled=false" not in settings)
    assert threads == ["MainThread"] and modules & OTHERS == set()


def test_the_same_look_finds_a_wire_that_is_on() -> None:
    others, _, threads, modules = look("zenoh.wire=[json,rmw_zenoh]")
    assert others == 1 and "ros2" in threads and modules & OTHERS == {"rosbags"}
