"""Combinations of configuration values that cannot work together, though each is in its range."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from dataclasses import dataclass
from urllib.parse import urlsplit

from ceilvo.calibration import Calibration
from ceilvo.config import Base, Camera, Config, Recorder, Ros2, Web, Zenoh
from ceilvo.config.serial_budget import wire_budget
from ceilvo.config.zenoh_names import endpoint_problems, on_loopback, on_this_computer, segment_problem
from ceilvo.errors import ConfigError

_ROS_NAME = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")
_ROS_TOPIC = re.compile(r"/?[A-Za-z_][A-Za-z0-9_]*(/[A-Za-z_][A-Za-z0-9_]*)*")
_MQTT_LEVEL = re.compile(r"[^/+#$][^/+#]*")
_MQTT_TLS_PORT = 8883
"""IANA's secure-mqtt."""
_FRESH_PERIODS = 1.5
"""Of the camera, that a healthy pose is old at most; chosen: one period until the next, half a one for the step."""


@dataclass(frozen=True)
class Conflict:
    """The keys that do not go together, the one to name first, and the rest of the message."""

    keys: tuple[str, ...]
    text: str


def cross_check(config: Config, calibration: Calibration | None = None, source: str = "config") -> tuple[str, ...]:
    """Refuse what cannot work; `source` names the file in messages.

    Returns:
        Notes on what works but may not be meant.

    Raises:
        ConfigError: one line a conflict.
    """
    found = conflicts(config, calibration)
    if found:
        raise ConfigError(*(f"{source}: {c.keys[0]}: {c.text}" for c in found))
    return notes(config)


def conflicts(config: Config, calibration: Calibration | None = None) -> list[Conflict]:
    """All of them, in the order of the sections."""
    return [
        *_names(config),
        *_camera(config.camera),
        *_calibration(config, calibration),
        *_states(config),
        *_base(config.base),
        *_senses(config),
        *_beacons(config),
        *_zenoh(config.zenoh),
        *_ros2(config.ros2),
        *_vda5050(config),
        *_web(config.web),
        *_recorder(config.recorder),
    ]


def notes(config: Config) -> tuple[str, ...]:
    """What works but may not be meant, one line each."""
    out = []
    camera, base, zenoh = config.camera, config.base, config.zenoh
    if base.enabled and base.rate_hz > camera.rate_hz:
        out.append(
            f"base.rate_hz: {base.rate_hz:g} is above camera.rate_hz {camera.rate_hz:g}; "
            "poses between frames repeat the last one with a greater age"
        )
    period_s = 1.0 / camera.rate_hz
    if base.enabled and base.stale_s < _FRESH_PERIODS * period_s:
        out.append(
            f"base.stale_s: {base.stale_s:g} is too short for camera.rate_hz {camera.rate_hz:g}; before each new frame "
            f"the base hears DEAD_RECKONING; set it to {math.ceil(10.0 * _FRESH_PERIODS * period_s) / 10.0:g} or more"
        )
    open_ends = [e for e in zenoh.listen if not on_this_computer(e)]
    if zenoh.enabled and open_ends and not zenoh.config_file:
        out.append(
            f"zenoh.listen: {', '.join(open_ends)} may be reached from the network, by anybody and unencrypted; "
            "zenoh.config_file can bring TLS and access control"
        )
    far = [e for e in zenoh.connect if not on_this_computer(e)]
    if zenoh.enabled and far and zenoh.mode == "peer" and not open_ends and not zenoh.config_file:
        out.append(
            f"zenoh.mode: peer behind {far[0]} is found by no peer of another computer: routers carry nothing from "
            "peer to peer, and zenoh.listen is on loopback; zenoh.mode: client lets the router carry it"
        )
    vda = config.vda5050
    if vda.user and not vda.ca_file and not on_loopback(vda.host):
        out.append(
            f"vda5050.ca_file: nothing, so the password goes unencrypted to {vda.host}; name the broker's certificates"
        )
    if vda.port == _MQTT_TLS_PORT and not vda.ca_file:
        out.append(f"vda5050.port: {vda.port} is MQTT with TLS, which vda5050.ca_file switches on; it names nothing")
    return tuple(out)


def _names(config: Config) -> Iterator[Conflict]:
    names = [("robot.name", config.robot.name), ("zenoh.prefix", config.zenoh.prefix)]
    names += [("mapd.building", config.mapd.building)]
    names += [("fleet.service", config.fleet.service)] if config.fleet.service else []
    for key, value in names:
        if problem := segment_problem(value):
            yield Conflict((key,), problem)


def _camera(camera: Camera) -> Iterator[Conflict]:
    if camera.source != "v4l2" and not camera.path:
        yield Conflict(
            ("camera.path", "camera.source"),
            f"found nothing, expected the {camera.source} that camera.source: {camera.source} reads; name it",
        )
    if camera.source != "v4l2":
        return
    if not camera.device:
        yield Conflict(
            ("camera.device", "camera.source"), "found nothing, expected a device node; ls /dev/v4l/by-id/ shows yours"
        )
    period_us = 1e6 / camera.rate_hz
    if camera.exposure_us is not None and camera.exposure_us > period_us:
        yield Conflict(
            ("camera.exposure_us", "camera.rate_hz"),
            f"found {camera.exposure_us:g}, expected at most {period_us:.0f}, the time between two frames at "
            f"camera.rate_hz {camera.rate_hz:g}; shorten it or lower the rate",
        )
    if camera.read_timeout_s * camera.rate_hz <= 1.0:
        yield Conflict(
            ("camera.read_timeout_s", "camera.rate_hz"),
            f"found {camera.read_timeout_s:g}, expected more than {1 / camera.rate_hz:.3g}, the time between two "
            f"frames at camera.rate_hz {camera.rate_hz:g}; a healthy camera would count as lost",
        )
    if camera.reopen_min_s > camera.reopen_max_s:
        yield Conflict(
            ("camera.reopen_min_s", "camera.reopen_max_s"),
            f"found {camera.reopen_min_s:g}, expected at most camera.reopen_max_s {camera.reopen_max_s:g}; swap them?",
        )


def _calibration(config: Config, calibration: Calibration | None) -> Iterator[Conflict]:
    if not config.calibration.file:
        yield Conflict(("calibration.file",), "found nothing, expected the file that calib wrote; name it")
    if calibration is None:
        return
    have = (config.camera.width_px, config.camera.height_px)
    want = (calibration.camera.width_px, calibration.camera.height_px)
    if have != want:
        yield Conflict(
            ("camera.width_px", "camera.height_px"),
            f"found {have[0]} x {have[1]} pixels, expected {want[0]} x {want[1]} as in the calibration; "
            "set width_px and height_px to that or calibrate at the new size",
        )


def _states(config: Config) -> Iterator[Conflict]:
    s = config.states
    if s.lost_sigma_m <= s.degraded_sigma_m:
        yield Conflict(
            ("states.lost_sigma_m", "states.degraded_sigma_m"),
            f"found {s.lost_sigma_m:g}, expected more than states.degraded_sigma_m {s.degraded_sigma_m:g}; "
            "a pose must degrade before it is lost",
        )
    if s.nis_lost <= s.nis_high:
        yield Conflict(
            ("states.nis_lost", "states.nis_high"),
            f"found {s.nis_lost:g}, expected more than states.nis_high {s.nis_high:g}; "
            "a pose must degrade before it is lost",
        )


def _base(base: Base) -> Iterator[Conflict]:
    if not base.enabled:
        return
    if not base.port:
        yield Conflict(("base.port",), "found nothing, expected a serial device; name it or set base.enabled to false")
    if base.predict and base.protocol == 1:
        yield Conflict(
            ("base.predict", "base.protocol"),
            "found true, expected false with base.protocol: 1, in which the age says how far the base itself must move "
            "the pose on; set base.protocol: 2, or base.predict: false",
        )
    budget = wire_budget(base)
    if not budget.fits:
        yield Conflict(
            ("base.rate_hz", "base.baud", "base.turnaround_ms", "base.function", "base.parity"),
            f"found {base.rate_hz:g}, expected at most {math.floor(100 * budget.max_rate_hz) / 100:g} "
            f"at base.baud {base.baud}: {budget.arithmetic}; lower the rate or raise the baud",
        )
    if not budget.timeout_fits:
        yield Conflict(
            ("base.timeout_s", "base.baud", "base.turnaround_ms", "base.function", "base.parity"),
            f"found {base.timeout_s:g}, expected at least {budget.answer_s:.3g}, which an answer takes at base.baud "
            f"{base.baud} with base.turnaround_ms {base.turnaround_ms:g}; every one would come too late",
        )


def _senses(config: Config) -> Iterator[Conflict]:
    s, base = config.senses, config.base
    if s.gyro == "base" and (not base.enabled or base.protocol == 1):
        yield Conflict(
            ("senses.gyro", "base.enabled", "base.protocol"),
            "found base, expected a base that has a gyro in its registers; set base.protocol: 2, or senses.gyro: none",
        )
    if s.gyro == "topic" and not config.zenoh.enabled:
        yield Conflict(("senses.gyro", "zenoh.enabled"), "found topic, expected zenoh.enabled: true to hear it")
    if s.wheels and not (base.enabled and base.use_wheels):
        yield Conflict(
            ("senses.wheels", "base.use_wheels"), "found true, expected wheels to learn of; set base.use_wheels: true"
        )


def _beacons(config: Config) -> Iterator[Conflict]:
    beacons, base = config.beacons, config.base
    if beacons.ranges == "zenoh" and not config.zenoh.enabled:
        text = "found zenoh, expected zenoh.enabled: true to hear it; switch it on, or choose serial"
        yield Conflict(("beacons.ranges", "zenoh.enabled"), text)
    if beacons.ranges == "serial" and base.enabled and beacons.port == base.port:
        text = f"found {beacons.port}, which is base.port, expected a port of its own; see /dev/serial/by-id/"
        yield Conflict(("beacons.port", "base.port"), text)


def _zenoh(zenoh: Zenoh) -> Iterator[Conflict]:
    if not zenoh.enabled:
        return
    if not zenoh.wire:
        yield Conflict(("zenoh.wire",), "found nothing, expected at least one; write [json], or zenoh.enabled: false")
    yield from (Conflict(keys, problem) for keys, problem in endpoint_problems(zenoh))


def _ros2(ros2: Ros2) -> Iterator[Conflict]:
    for name, optional in (("node", False), ("namespace", True)):
        value = getattr(ros2, name)
        if not (optional and not value) and not _ROS_NAME.fullmatch(value.strip("/") if optional else value):
            yield Conflict((f"ros2.{name}",), f"found {value!r}, expected letters, digits and _; try ceilvo or robot1")
    for name in ("tf_topic", "pose_topic", "odom_topic"):
        value = getattr(ros2, name)
        if not _ROS_TOPIC.fullmatch(value):
            yield Conflict((f"ros2.{name}",), f"found {value!r}, expected a ROS topic such as pose or /robot1/pose")
    frames = ("map_frame", "odom_frame", "base_frame", "camera_frame")
    for name in (*frames, "fleet_frame"):
        if not _ROS_TOPIC.fullmatch(value := getattr(ros2, name)) or value.startswith("/"):
            yield Conflict((f"ros2.{name}",), f"found {value!r}, expected a frame without / in front, such as map")
    values = [getattr(ros2, name) for name in frames]
    for i, name in enumerate(frames):
        if values[i] in values[:i]:
            first = frames[values.index(values[i])]
            yield Conflict((f"ros2.{name}", f"ros2.{first}"), f"found {values[i]}, expected another than ros2.{first}")


def _vda5050(config: Config) -> Iterator[Conflict]:
    c = config.vda5050
    levels = {"interface_name": c.interface_name, "manufacturer": c.manufacturer}
    levels |= {"serial_number": c.serial_number} if c.serial_number else {}
    for name, value in levels.items():
        if not _MQTT_LEVEL.fullmatch(value) or not value.isprintable():
            yield Conflict(
                (f"vda5050.{name}",),
                f"found {value!r}, expected one level of an MQTT topic: not empty, none of / + #, no $ in front",
            )
    for name in ("host", "map_id"):
        if not getattr(c, name).strip():
            yield Conflict((f"vda5050.{name}",), "found nothing, expected a name")
    if c.password_file and not c.user:
        keys = ("vda5050.user", "vda5050.password_file")
        yield Conflict(keys, f"found nothing, expected the user of vda5050.password_file {c.password_file}")
    for source in c.map_sources:
        if problem := _source_problem(source):
            yield Conflict(("vda5050.map_sources",), f"found {source!r}, expected {problem}")


def _web(web: Web) -> Iterator[Conflict]:
    if not web.host.strip():
        yield Conflict(("web.host",), "found nothing, expected an address, such as 127.0.0.1")
        return
    for name, other in (("certificate_file", "key_file"), ("key_file", "certificate_file")):
        if getattr(web, other) and not getattr(web, name):
            keys = (f"web.{name}", f"web.{other}")
            yield Conflict(keys, f"found nothing, expected a file, which web.{other} {getattr(web, other)} goes with")
    beyond = f"web.host {web.host}" if not on_loopback(web.host) else "web.behind_proxy"
    if (not on_loopback(web.host) or web.behind_proxy) and not web.token_file:
        yield Conflict(
            ("web.token_file", "web.host", "web.behind_proxy"),
            f"found nothing, expected a file with a token, for {beyond} lets other computers in; name it",
        )
    if not (on_loopback(web.host) or web.certificate_file or web.behind_proxy):
        yield Conflict(
            ("web.certificate_file", "web.host", "web.behind_proxy"),
            f"found nothing, expected a certificate, for {beyond} sends the token over the network; name it and its "
            "web.key_file, or set web.behind_proxy: true where a proxy brings TLS",
        )


def _source_problem(source: str) -> str:
    """What a place for maps should be; "" where it is that."""
    try:
        parts = urlsplit(source)
    except ValueError:
        return "an address"
    whole = parts.scheme == "file" and not parts.netloc and parts.path.startswith("/")
    if whole or (parts.scheme in ("http", "https") and parts.hostname and "@" not in parts.netloc):
        return "" if not parts.query and not parts.fragment else "no ? or # in it"
    return "https://HOST/..., http://HOST/... or file:///FOLDER"


def _recorder(recorder: Recorder) -> Iterator[Conflict]:
    if recorder.enabled and recorder.kept_bytes < recorder.ring_bytes:
        yield Conflict(
            ("recorder.kept_bytes", "recorder.ring_bytes"),
            f"found {recorder.kept_bytes}, expected at least recorder.ring_bytes {recorder.ring_bytes}; "
            "a fault keeps the whole ring",
        )
