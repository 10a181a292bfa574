"""`ceilvod watch`, `view`, `web`, `vda5050` and `export`: programs that read the daemon on Zenoh, or its recordings."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from ceilvo.config import Config
from ceilvo.config.arguments import command, from_up
from ceilvo.errors import ConfigError

if TYPE_CHECKING:
    from ceilvo.config.arguments import Commands

Options = Callable[[argparse.ArgumentParser], None]
ConfigOf = Callable[[argparse.Namespace], Config]


def add(commands: Commands, config_options: Options, config_of: ConfigOf) -> None:
    """The commands' parsers; `config_options` adds --config and --set, which `config_of` reads."""
    p = command(commands, "watch", "print what a Zenoh subscriber gets", "ceilvod watch --robot robot1")
    config_options(p)
    p.add_argument("--robot", default="*", metavar="NAME", help="one robot (default: every one)")
    p.add_argument("--json", action="store_true", help="every message as it came, one line each")
    p.add_argument("--count", type=from_up(1), metavar="N", help="end after N poses")
    p.set_defaults(do=lambda options: _watch(options, config_of(options)))

    p = command(commands, "view", "show a running robot in Foxglove", "ceilvod view --foxglove --robot robot1")
    config_options(p)
    how = p.add_mutually_exclusive_group(required=True)
    how.add_argument("--foxglove", action="store_true", help="by Foxglove's websocket")
    how.add_argument("--mcap", type=Path, metavar="FILE", help="into a new file that Foxglove opens, until Ctrl-C")
    p.add_argument("--robot", metavar="NAME", help="which one (default: robot.name)")
    p.add_argument("--host", default="127.0.0.1", metavar="ADDRESS", help="to listen on (default: loopback only)")
    p.add_argument("--port", type=from_up(0), default=8765, metavar="N", help="0 = a free one (default: 8765)")
    p.set_defaults(do=lambda options: _view(options, config_of(options)))

    p = command(commands, "web", "show a running robot in a browser", "ceilvod web --config /etc/ceilvo/config.yaml")
    config_options(p)
    p.add_argument(
        "--simulate", action="store_true", help="for the robot of 'ceilvod run --simulate': no camera needed"
    )
    p.set_defaults(do=lambda options: _web(options, config_of(options)))

    example = "ceilvod export drive.mcap drive_ros2.mcap --ros2"
    p = command(commands, "export", "write a recording for other tools", example)
    p.add_argument("source", type=Path, metavar="SOURCE", help="recording, or a folder with the files of one run")
    p.add_argument("out", type=Path, metavar="OUT", help="new MCAP file")
    p.add_argument("--ros2", action="store_true", required=True, help="as a ROS 2 bag: CDR, with definitions")
    p.add_argument(
        "--set", action="append", default=[], metavar="ros2.KEY=VALUE", help="frames, topics; may be repeated"
    )
    p.set_defaults(do=_export)

    p = command(commands, "vda5050", "tell a fleet by MQTT where the robot is", "ceilvod vda5050 --config config.yaml")
    config_options(p)
    p.set_defaults(do=lambda options: _vda5050(config_of(options)))


def _watch(options: argparse.Namespace, config: Config) -> int:
    from ceilvo.daemon.app.readers.watch import watch_robots

    return watch_robots(config.zenoh, options.robot, options.json, options.count)


def _view(options: argparse.Namespace, config: Config) -> int:
    from ceilvo.daemon.app.readers.view import keep_robot, view_robot

    if options.mcap is not None:
        return keep_robot(config.zenoh, options.robot or config.robot.name, options.mcap)
    return view_robot(config.zenoh, options.robot or config.robot.name, options.host, options.port)


def _export(options: argparse.Namespace) -> int:
    from ceilvo.daemon.app.readers.export import export_ros2

    return export_ros2(options.source, options.out, tuple(options.set))


def _vda5050(config: Config) -> int:
    from ceilvo.daemon.app.readers.vda5050 import tell_fleet

    return tell_fleet(config)


def _web(options: argparse.Namespace, config: Config) -> int:
    from ceilvo.config.checks import cross_check

    try:
        from ceilvo.daemon.app.readers.web import serve_pages
    except ModuleNotFoundError as e:
        if not str(e.name).startswith("aiohttp"):
            raise
        raise ConfigError("web: found no aiohttp, expected it; pip install 'ceilvo[web]'") from e
    cross_check(config)
    return serve_pages(config, options.config, options.simulate)
