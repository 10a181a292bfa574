"""Where Cyclone DDS has no wheel the error says so, and what to do; nothing else needs it."""

from __future__ import annotations

import sys

import pytest
from ros2_parts import calibration, parts
from zenoh_world import Robot

from ceilvo.config import Config, Ros2, Zenoh
from ceilvo.daemon import cli
from ceilvo.daemon.app.wires import wires_of
from ceilvo.drivers.ros2.dds import DdsTransport
from ceilvo.errors import ConfigError


@pytest.fixture(autouse=True)
def no_cyclone(monkeypatch: pytest.MonkeyPatch) -> None:
    """As on a computer where it cannot be installed."""
    for name in [n for n in sys.modules if n.split(".")[0] == "cyclonedds"] + ["cyclonedds"]:
        monkeypatch.setitem(sys.modules, name, None)


def test_the_error_names_the_key_the_platforms_and_the_way_out() -> None:
    p = parts()
    with pytest.raises(ConfigError) as caught:
        DdsTransport(Ros2(dds=True), p.cdr, p.ends, dict)
    assert caught.value.exit_code == 78
    assert str(caught.value) == (
        "ros2.dds: found no cyclonedds, expected it; pip install 'ceilvo[dds]' where it has a wheel (Linux x86-64), "
        "elsewhere set zenoh.wire: [ros2dds] and run zenoh-bridge-ros2dds (docs/ros2.md)"
    )


def test_the_daemon_ends_with_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    settings = ("ros2.dds=true", "base.enabled=false", "zenoh.enabled=false", "service.log_level=error")
    words = [w for s in settings for w in ("--set", s)]
    assert cli.main(["run", "--simulate", "--seconds", "1", *words]) == 78
    said = capsys.readouterr().err
    assert said.count("\n") == 1 and "ros2.dds: found no cyclonedds" in said


def test_the_other_wires_need_none() -> None:
    config = Config(zenoh=Zenoh(wire=("json", "rmw_zenoh", "ros2dds")), ros2=Ros2(fleet_tf=True))
    assert len(wires_of(config, calibration(), Robot().handlers()).others) == 1
