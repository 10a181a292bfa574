"""Combinations that cannot work, though each value is in its range."""

from __future__ import annotations

import dataclasses
import re

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ceilvo.calibration import Calibration, NoiseCurves, projection_matrix
from ceilvo.camera import CameraModel
from ceilvo.config import Base, Config
from ceilvo.config.checks import cross_check, notes
from ceilvo.config.reader import replace
from ceilvo.config.serial_budget import wire_budget
from ceilvo.errors import ConfigError

LENS = CameraModel("pinhole", 640, 480, 400.0, 400.0, 319.5, 239.5)
CALIBRATION = Calibration(
    LENS, projection_matrix(LENS, np.eye(3), (0.0, 0.0), 2.0), NoiseCurves((0.01,), (0.01,), 0.01, 0.0, 2.0)
)


def conflicts(*overrides: str) -> tuple[str, ...]:
    try:
        cross_check(replace(Config(), overrides), CALIBRATION, "c.yaml")
    except ConfigError as e:
        return e.problems
    return ()


def test_the_defaults_fit_together() -> None:
    assert conflicts() == ()
    assert cross_check(Config()) == ()


CONFLICTS = [
    (["robot.name=a/b"], "c.yaml: robot.name: found 'a/b', expected one segment of a Zenoh key"),
    (["robot.name="], "c.yaml: robot.name: found nothing, expected one segment of a Zenoh key"),
    (['zenoh.prefix="@x"'], "c.yaml: zenoh.prefix: found '@x', expected one segment"),
    (["camera.source=folder"], "c.yaml: camera.path: found nothing, expected the folder that camera.source: folder"),
    (["camera.source=video"], "c.yaml: camera.path: found nothing, expected the video that camera.source: video"),
    (["camera.device="], "c.yaml: camera.device: found nothing, expected a device node"),
    (["camera.exposure_us=40000"], "c.yaml: camera.exposure_us: found 40000, expected at most 33333, the time between"),
    (
        ["camera.read_timeout_s=0.1", "camera.rate_hz=10"],
        "c.yaml: camera.read_timeout_s: found 0.1, expected more than 0.1",
    ),
    (["camera.reopen_min_s=3"], "c.yaml: camera.reopen_min_s: found 3, expected at most camera.reopen_max_s 1"),
    (
        ["camera.width_px=1280", "camera.height_px=720"],
        "c.yaml: camera.width_px: found 1280 x 720 pixels, expected 640 x 480",
    ),
    (
        ["camera.height_px=640"],
        "c.yaml: camera.width_px: found 640 x 640 pixels, expected 640 x 480 as in the calibration",
    ),
    (["calibration.file="], "c.yaml: calibration.file: found nothing, expected the file that calib wrote"),
    (
        ["states.lost_sigma_m=0.05"],
        "c.yaml: states.lost_sigma_m: found 0.05, expected more than states.degraded_sigma_m 0.05",
    ),
    (["states.nis_lost=3"], "c.yaml: states.nis_lost: found 3, expected more than states.nis_high 3"),
    (["base.port="], "c.yaml: base.port: found nothing, expected a serial device"),
    (["base.timeout_s=0.005"], "c.yaml: base.timeout_s: found 0.005, expected at least"),
    (["zenoh.listen=[localhost]"], "c.yaml: zenoh.listen: found 'localhost', expected protocol/address"),
    (["zenoh.connect=['tcp/']"], "c.yaml: zenoh.connect: found 'tcp/', expected protocol/address"),
    (
        ["recorder.kept_bytes=100000000"],
        "c.yaml: recorder.kept_bytes: found 100000000, expected at least recorder.ring_bytes 200000000",
    ),
    (
        ["vda5050.interface_name=a/b"],
        "c.yaml: vda5050.interface_name: found 'a/b', expected one level of an MQTT topic",
    ),
    (["vda5050.interface_name=$SYS"], "c.yaml: vda5050.interface_name: found '$SYS', expected one level"),
    (["vda5050.manufacturer="], "c.yaml: vda5050.manufacturer: found '', expected one level"),
    (["vda5050.manufacturer=a+b"], "c.yaml: vda5050.manufacturer: found 'a+b', expected one level"),
    (["vda5050.serial_number=a#"], "c.yaml: vda5050.serial_number: found 'a#', expected one level"),
    (["vda5050.host="], "c.yaml: vda5050.host: found nothing, expected a name"),
    (["vda5050.map_id="], "c.yaml: vda5050.map_id: found nothing, expected a name"),
    (["vda5050.password_file=/etc/x"], "c.yaml: vda5050.user: found nothing, expected the user of vda5050.password"),
    (["vda5050.map_sources=[ftp://a/b]"], "c.yaml: vda5050.map_sources: found 'ftp://a/b', expected https://HOST"),
    (["vda5050.map_sources=[/srv/maps]"], "c.yaml: vda5050.map_sources: found '/srv/maps', expected https://HOST"),
    (["vda5050.map_sources=['https://u:p@h/']"], "c.yaml: vda5050.map_sources: found 'https://u:p@h/', expected https"),
    (["vda5050.map_sources=['file://h/srv']"], "c.yaml: vda5050.map_sources: found 'file://h/srv', expected https://"),
    (["vda5050.map_sources=['https://h/?a=b']"], "c.yaml: vda5050.map_sources: found 'https://h/?a=b', expected no ?"),
    (["web.host="], "c.yaml: web.host: found nothing, expected an address"),
    (
        ["web.certificate_file=/etc/c.pem"],
        "c.yaml: web.key_file: found nothing, expected a file, which web.cert",
    ),
    (
        ["web.key_file=/etc/c.key"],
        "c.yaml: web.certificate_file: found nothing, expected a file, which web.key_fil",
    ),
    (
        ["web.behind_proxy=true"],
        "c.yaml: web.token_file: found nothing, expected a file with a token, for web.beh",
    ),
    (
        ["web.host=10.0.0.2", "web.behind_proxy=true"],
        "c.yaml: web.token_file: found nothing, expected a file with",
    ),
    (["web.host=0.0.0.0", "web.token_file=/t"], "c.yaml: web.certificate_file: found nothing, expected a certificate"),
    (
        ["web.host='::'", "web.certificate_file=/c", "web.key_file=/k"],
        "c.yaml: web.token_file: found nothing, expected a file with a token, for web.host :: lets other computers in",
    ),
    (["zenoh.mode=client", "zenoh.multicast=false"], "c.yaml: zenoh.connect: found nothing, expected a router"),
]


@pytest.mark.parametrize(("overrides", "start"), CONFLICTS, ids=lambda v: v[0] if isinstance(v, list) else "")
def test_a_conflict_is_one_clear_line(overrides: list[str], start: str) -> None:
    found = conflicts(*overrides)
    assert len(found) == 1, found
    assert found[0].startswith(start)


@pytest.mark.parametrize("bad", ["a/b", "a b", "a*", "$x", "a#", "a?", "a\u00a0b", "", "@a", "a\nb"])
def test_what_is_no_key_segment(bad: str) -> None:
    config = dataclasses.replace(Config(), robot=dataclasses.replace(Config().robot, name=bad))
    with pytest.raises(ConfigError, match=r"robot\.name"):
        cross_check(config)


def test_the_names_that_pass_are_one_segment_for_zenoh_itself() -> None:
    zenoh = pytest.importorskip("zenoh")
    for name in ("robot1", "Halle-3_nord", "ä.b", "a@b"):
        assert conflicts(f"robot.name={name}") == ()
        key = zenoh.KeyExpr(f"ceilvo/{name}/pose")
        assert zenoh.KeyExpr("ceilvo/*/pose").includes(key)


@pytest.mark.parametrize("host", ["127.0.0.1", "localhost", "::1", "0.0.0.0", "robot1.local", "fd00::2"])
def test_pages_for_other_computers_pass_with_a_token_and_tls_or_a_proxy(host: str) -> None:
    token, tls = "web.token_file=/t", ["web.certificate_file=/c", "web.key_file=/k"]
    assert conflicts(f"web.host='{host}'", token, *tls) == conflicts(
        f"web.host='{host}'", token, "web.behind_proxy=true"
    )
    assert conflicts(f"web.host='{host}'", token, *tls) == ()
    assert bool(conflicts(f"web.host='{host}'")) == (host not in ("127.0.0.1", "localhost", "::1"))


def test_a_fleet_managers_values_that_pass() -> None:
    sources = "vda5050.map_sources=[https://maps.example/robots/, 'http://10.0.0.2:8080/', file:///srv/maps]"
    assert conflicts("vda5050.serial_number=robot 7", "vda5050.manufacturer=ACME GmbH", sources) == ()


@pytest.mark.parametrize(
    ("overrides", "says"),
    [
        ([], ""),
        (["vda5050.user=me"], ""),
        (
            ["vda5050.user=me", "vda5050.host=mqtt.example"],
            "vda5050.ca_file: nothing, so the password goes",
        ),
        (["vda5050.user=me", "vda5050.host=mqtt.example", "vda5050.ca_file=/etc/ca.pem"], ""),
        (["vda5050.port=8883"], "vda5050.port: 8883 is MQTT with TLS"),
        (["vda5050.port=8883", "vda5050.ca_file=/etc/ca.pem"], ""),
    ],
)
def test_notes_on_a_fleet_managers_values(overrides: list[str], says: str) -> None:
    found = [n for n in notes(replace(Config(), overrides)) if n.startswith("vda5050")]
    assert len(found) == bool(says) and all(n.startswith(says) for n in found)


def test_a_rate_beyond_the_baud_shows_the_arithmetic() -> None:
    found = conflicts("base.baud=9600")
    budget = wire_budget(Base(baud=9600))
    assert not budget.fits
    rate = [p for p in found if "base.rate_hz" in p]
    assert len(rate) == 1
    assert "expected at most 9.32 at base.baud 9600" in rate[0]
    assert 9.32 <= budget.max_rate_hz < 9.33
    assert budget.arithmetic in rate[0]
    assert "lower the rate or raise the baud" in rate[0]


@given(
    baud=st.sampled_from([1200, 9600, 19200, 57600, 115200, 1000000]),
    rate=st.floats(0.1, 200.0),
    function=st.sampled_from(["fc23", "fc16_fc04"]),
    parity=st.sampled_from(["N", "E"]),
)
def test_what_the_bits_alone_exceed_is_always_refused(baud: int, rate: float, function: str, parity: str) -> None:
    """An independent lower bound: 38 bytes of pose and 20 of status, 11 bits each, with nothing around them."""
    base = Base(baud=baud, rate_hz=rate, function=function, parity=parity, turnaround_ms=0.0, timeout_s=5.0)
    if rate * 58 * 11 > baud:
        with pytest.raises(ConfigError, match=r"base\.rate_hz"):
            cross_check(dataclasses.replace(Config(), base=base))


def test_the_rate_that_the_message_offers_is_accepted() -> None:
    found = conflicts("base.baud=9600", "base.timeout_s=1.0")
    offered = re.search(r"expected at most ([0-9.]+) at", found[0])
    assert offered
    rate = float(offered[1])
    assert conflicts("base.baud=9600", "base.timeout_s=1.0", f"base.rate_hz={rate}") == ()
    assert len(conflicts("base.baud=9600", "base.timeout_s=1.0", f"base.rate_hz={rate + 0.01}")) == 1


def test_what_is_switched_off_is_not_judged() -> None:
    assert conflicts("base.enabled=false", "base.baud=1200", "base.port=") == ()
    assert conflicts("zenoh.enabled=false", "zenoh.listen=[x]") == ()
    assert conflicts("camera.source=video", "camera.path=a.mp4", "camera.exposure_us=1e6", "camera.device=") == ()


def test_all_conflicts_come_at_once() -> None:
    assert len(conflicts("robot.name=a/b", "camera.reopen_min_s=3", "states.nis_lost=2", "base.port=")) == 4


def test_without_a_calibration_the_size_is_not_judged() -> None:
    assert cross_check(replace(Config(), ["camera.width_px=1280"])) == ()


def test_notes_are_no_errors() -> None:
    fast = cross_check(replace(Config(), ["camera.rate_hz=15"]))
    assert fast == notes(replace(Config(), ["camera.rate_hz=15"]))
    assert len(fast) == 1
    assert fast[0].startswith("base.rate_hz: 20 is above camera.rate_hz 15")
    slow = ["camera.rate_hz=2", "base.rate_hz=2"]
    assert [n.split(";")[-1] for n in notes(replace(Config(), slow))] == [" set it to 0.8 or more"]
    assert notes(replace(Config(), [*slow, "base.stale_s=0.8"])) == ()
    assert notes(replace(Config(), ["camera.rate_hz=3", "base.rate_hz=3"])) == ()
    for end in ("tcp/0.0.0.0:7447", "tcp/[::]:7447", "tcp/127.example.org:7447", "udp/192.168.0.2:7447"):
        wide = notes(replace(Config(), [f"zenoh.listen=['{end}']"]))
        assert len(wide) == 1
        assert wide[0].startswith(f"zenoh.listen: {end} may be reached from the network")
    far = ["zenoh.connect=[tcp/192.168.0.2:7447]"]
    assert [n.split(" is found")[0] for n in notes(replace(Config(), far))] == [
        "zenoh.mode: peer behind tcp/192.168.0.2:7447"
    ]
    assert notes(replace(Config(), [*far, "zenoh.mode=client"])) == ()
    assert notes(replace(Config(), ["zenoh.connect=[tcp/127.0.0.1:7447]"])) == ()
    for end in ("tcp/127.0.0.1:0", "tcp/[::1]:7447", "tcp/localhost:7447"):
        assert notes(replace(Config(), [f"zenoh.listen=['{end}']"])) == ()


@pytest.mark.parametrize(
    ("overrides", "says"),
    [
        (["base.predict=true"], "base.predict: found true, expected false with base.protocol: 1"),
        (["base.predict=true", "base.protocol=2"], ""),
        (["senses.gyro=base"], "senses.gyro: found base, expected a base that has a gyro in its registers"),
        (["senses.gyro=base", "base.protocol=2"], ""),
        (["senses.gyro=topic", "zenoh.enabled=false"], "senses.gyro: found topic, expected zenoh.enabled: true"),
        (["senses.wheels=true", "base.use_wheels=false"], "senses.wheels: found true, expected wheels to learn of"),
        (["senses.wheels=true", "senses.time=true", "senses.drive=omni"], ""),
        (["beacons.ranges=zenoh", "zenoh.enabled=false"], "beacons.ranges: found zenoh, expected zenoh.enabled: true"),
        (
            ["beacons.ranges=serial", "beacons.port=/dev/ttyUSB0"],
            "beacons.port: found /dev/ttyUSB0, which is base.port",
        ),
        (["beacons.ranges=serial"], ""),
    ],
)
def test_senses_need_what_they_listen_to(overrides: list[str], says: str) -> None:
    found = conflicts(*overrides)
    assert len(found) == bool(says)
    assert all(says in p for p in found)
