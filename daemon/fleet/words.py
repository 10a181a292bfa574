"""The words of `ceilvod mapd`, and those of `ceilvod map` that speak with it."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from ceilvo.config.arguments import command, from_up
from ceilvo.daemon.fleet.extra import loaded

if TYPE_CHECKING:
    from ceilvo.config.arguments import Commands

_SERVICE, _ROBOT = "ceilvo.daemon.fleet.service.command", "ceilvo.daemon.fleet.robot.command"


def add(commands: Commands, config_options: Callable[[argparse.ArgumentParser], None]) -> None:
    """`mapd` and what follows it."""
    text = "the map service of a building, for a fleet of robots"
    p = command(commands, "mapd", text, "ceilvod mapd run --db building.db --config config.yaml")
    words = p.add_subparsers(title="commands", required=True)
    p = _one(words, "mapd", "run", "run the service", "--db building.db --config config.yaml", _SERVICE)
    config_options(p)
    _one(words, "mapd", "pending", "offers that wait for a person", "--db building.db", _SERVICE)
    for name, text in (("approve", "take offers that wait"), ("reject", "never take offers that wait")):
        p = _one(words, "mapd", name, text, "--db building.db 12 13", _SERVICE)
        p.add_argument("numbers", type=from_up(1), nargs="*", metavar="NUMBER", help="as 'pending' lists them")
        p.add_argument("--all", action="store_true", help="all that wait now")
        p.add_argument("--png", type=Path, metavar="PICTURE", help="draw the offer, and do nothing else")
    p = _one(words, "mapd", "stats", "what the service has taken and refused", "--db building.db", _SERVICE)
    p.add_argument("--json", action="store_true", help="as JSON")
    p = _one(words, "mapd", "keys", "whose offers are heard", "--db building.db --add robot1 --key 3b6a...", _SERVICE)
    what = p.add_mutually_exclusive_group()
    what.add_argument("--add", metavar="NAME", help="a robot, with --key; known already: its name or trust changes")
    what.add_argument("--remove", metavar="NAME", help="a robot; what of its waits is forgotten")
    p.add_argument("--key", metavar="HEX", help="public key, as 'ceilvod map key' prints it on the robot")
    p.add_argument("--trusted", action="store_true", help="what it signs needs nobody else's agreement")


def add_to_map(words: Commands, config_options: Callable[[argparse.ArgumentParser], None]) -> None:
    """`map fetch`, `map offer` and `map key`."""
    text = "bring the newest map of the fleet, and put the robot's own on it"
    p = _one(words, "map", "fetch", text, "map.db --config config.yaml", _ROBOT, file=True)
    config_options(p)
    p.add_argument("--dry-run", action="store_true", help="fetch, say what would change, leave the robot's map")
    p.add_argument("--replace", action="store_true", help="in the place of a map that is none of the fleet's")
    text = "offer the fleet what this robot has learnt"
    p = _one(words, "map", "offer", text, "map.db --config config.yaml", _ROBOT, file=True)
    config_options(p)
    p.add_argument("--dry-run", action="store_true", help="say what would be offered")
    p = command(words, "key", "make this robot's key, or show its public part", "ceilvod map key /etc/ceilvo/robot.key")
    p.add_argument("file", type=Path, metavar="FILE", help="private key; made where there is none")
    p.set_defaults(do=_run(_ROBOT, "key"))


def _one(
    words: Commands, program: str, name: str, text: str, example: str, module: str, file: bool = False
) -> argparse.ArgumentParser:
    p = command(words, name, text, f"ceilvod {program} {name} {example}")
    if file:
        p.add_argument("file", type=Path, metavar="DB", help="the robot's database of maps, made where there is none")
    else:
        p.add_argument("--db", type=Path, required=True, metavar="DB", help="database of the building's maps")
    p.set_defaults(do=_run(module, name))
    return p


def _run(module: str, name: str) -> Callable[[argparse.Namespace], int]:
    return lambda options: int(getattr(loaded(module), name)(options))
