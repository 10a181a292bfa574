"""Everybody who reads the daemon: its own JSON on Zenoh, and ROS 2 in the ways that are configured."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

import zenoh

from ceilvo.calibration import Calibration
from ceilvo.config import Config
from ceilvo.daemon.app.senses.hearing import Hearing
from ceilvo.drivers.bus.requests import Handlers, Requests
from ceilvo.drivers.bus.zenoh_bus import ZenohBus
from ceilvo.drivers.ports import Wire


@dataclass(frozen=True)
class Wires:
    """
    Attributes:
        bus: None where Zenoh is off.
        others: beside it; opened before it and closed after it.
    """

    bus: ZenohBus | None
    others: tuple[Wire, ...] = ()


def wires_of(config: Config, calibration: Calibration, handlers: Handlers, hearing: Hearing | None = None) -> Wires:
    """As configured; opens nothing.

    Raises:
        ConfigError: a library that one of them needs is not there.
        BusError: as ZenohBus.
    """
    named = config.zenoh.wire if config.zenoh.enabled else ()
    if not {"rmw_zenoh", "ros2dds"} & set(named) and not config.ros2.dds and not config.ros2.fleet_tf:
        return Wires(_bus(config, handlers, hearing, []))
    return _with_ros2(config, calibration, handlers, named, hearing)


def _bus(
    config: Config, handlers: Handlers, hearing: Hearing | None, speakers: list[Callable[[zenoh.Session], None]]
) -> ZenohBus | None:
    if not config.zenoh.enabled:
        return None
    if hearing is None or not hearing.keys:
        return ZenohBus(config.zenoh, config.robot.name, handlers, speakers=speakers)
    heard = [*speakers, hearing.declare]
    return ZenohBus(config.zenoh, config.robot.name, handlers, speakers=heard, welcome=hearing.keys)


def _with_ros2(
    config: Config, calibration: Calibration, handlers: Handlers, named: tuple[str, ...], hearing: Hearing | None
) -> Wires:
    from ceilvo.drivers.ros2.cdr import Cdr  # who speaks no ROS 2 needs no rosbags
    from ceilvo.drivers.ros2.conversion import Conversion
    from ceilvo.drivers.ros2.endpoints import Endpoint, endpoints
    from ceilvo.drivers.ros2.intake import Intake
    from ceilvo.drivers.ros2.naming import Naming, RmwZenoh, Ros2dds
    from ceilvo.drivers.ros2.node import Ros2Node
    from ceilvo.drivers.ros2.transport import FleetTransport, Transport, ZenohTransport

    cdr, ends, robot = Cdr(config.ros2.distribution), endpoints(config.ros2, config.robot.name), config.robot.name
    conversion = Conversion(config.ros2, robot, calibration, cdr)

    def latched() -> dict[Endpoint, bytes]:
        return {ends.tf_static: cdr.encode(conversion.tf(conversion.base_from_camera(time.time_ns())))}

    namings: dict[str, Naming] = {"rmw_zenoh": RmwZenoh(config.ros2, cdr), "ros2dds": Ros2dds()}
    on_zenoh = [ZenohTransport(naming, ends, latched) for name, naming in namings.items() if name in named]
    speakers: list[Callable[[zenoh.Session], None]] = [t.declare for t in on_zenoh]
    transports: list[Transport] = list(on_zenoh)
    if config.ros2.fleet_tf:
        fleet = FleetTransport(ends)
        speakers.append(fleet.declare)
        transports.append(fleet)
    if config.ros2.dds:
        from ceilvo.drivers.ros2.dds import DdsTransport

        transports.append(DdsTransport(config.ros2, cdr, ends, latched))
    bus = _bus(config, handlers, hearing, speakers)
    requests = Requests(robot, handlers) if bus is None else bus.requests
    intake = Intake(config.ros2, cdr, ends, requests.answer)
    return Wires(bus, (Ros2Node(config.ros2, conversion, cdr, ends, transports, intake),))
