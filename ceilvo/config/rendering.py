"""config.yaml with every key, its unit, range and reason. `python -m ceilvo.config.rendering` prints the defaults."""

from __future__ import annotations

import dataclasses
import json
import re
import sys
from collections.abc import Mapping
from typing import Any

from ceilvo.config.schema import SECTIONS, Config

_UNITS = {
    "_px": "px",
    "_m": "m",
    "_s": "s",
    "_us": "us",
    "_ms": "ms",
    "_hz": "Hz",
    "_deg": "deg",
    "_rad": "rad",
    "_mps": "m/s",
    "_mps2": "m/s^2",
    "_radps": "rad/s",
    "_radps2": "rad/s^2",
    "_dps": "deg/s",
    "_bytes": "bytes",
    "baud": "bit/s",
}
_ABOUT = {
    "robot": "which robot this is",
    "camera": "where frames come from",
    "calibration": "what commissioning found out",
    "features": "from pixels to lines and crossings",
    "odometry": "from crossings to motion",
    "filter": "from motion and landmarks to pose (PFCF)",
    "senses": "motion beside the camera: time, wheels, gyro (docs/fusion.md); all off by default",
    "states": "when a pose is called good, degraded or lost",
    "base": "the base controller, Modbus RTU",
    "beacons": "radio ranges and marks (docs/ranges.md, docs/marks.md); off without a file",
    "zenoh": "the bus",
    "ros2": "ROS 2 without ROS, docs/ros2.md; on by zenoh.wire, or by dds or fleet_tf here",
    "vda5050": "what `ceilvod vda5050` tells a fleet manager, docs/fleets.md",
    "web": "pages for a browser: `ceilvod web`, docs/web.md",
    "service": "the process",
    "recorder": "what is kept to find out later what happened",
    "fleet": "Maps that robots of a building share (docs/fleet.md)",
    "mapd": "The service that keeps them: ceilvod mapd",
}
_HEADER = """\
# Configuration of ceilvod. These are the defaults; a key that is left out has its default.
# `ceilvod check-config FILE` checks a file without starting. Explained in docs/configuration.md.
"""
_PLAIN_TEXT = re.compile(r"[A-Za-z/][A-Za-z0-9_./-]*")
_NOT_PLAIN = {"true", "false", "null", "yes", "no", "on", "off", "y", "n"}


def render_config(config: Config) -> str:
    """YAML with every key, its unit, range and reason; `load_config` reads the same configuration back."""
    return _HEADER + "".join(_render_section(name, getattr(config, name)) for name in SECTIONS)


def _render_section(name: str, section: Any) -> str:
    lines = [f"\n# {_ABOUT[name]}", f"{name}:"]
    for f in dataclasses.fields(section):
        facts = ", ".join(s for s in (_unit(f.name), range_text(f.metadata)) if s)
        lines.append(f"  # {f.metadata['why']}" + (f" [{facts}]" if facts else ""))
        lines.append(f"  {f.name}: {yaml_text(getattr(section, f.name))}")
    return "\n".join(lines) + "\n"


def _unit(name: str) -> str:
    for suffix in sorted(_UNITS, key=len, reverse=True):
        if name.endswith(suffix):
            return _UNITS[suffix]
    return ""


def range_text(meta: Mapping[str, Any]) -> str:
    if meta["choices"]:
        return " | ".join(meta["choices"])
    if meta["low"] is None and meta["high"] is None:
        return ""
    if meta["high"] is None:
        return f"from {_short(meta['low'])}"
    return f"{_short(meta['low'])} to {_short(meta['high'])}"


def _short(value: float) -> str:
    return str(int(value)) if float(value).is_integer() and abs(value) < 1e12 else repr(value)


def yaml_text(value: Any) -> str:
    if value is None:
        return "null"
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, (tuple, list)):
        return "[" + ", ".join(quoted(v) for v in value) + "]"
    if isinstance(value, str):
        plain = _PLAIN_TEXT.fullmatch(value) and value.lower() not in _NOT_PLAIN
        return value if plain else quoted(value)
    text = repr(value)
    return text.replace("e", ".0e") if "e" in text and "." not in text else text  # YAML 1.1 wants the point


def quoted(value: str) -> str:
    return json.dumps(value, ensure_ascii=False)


if __name__ == "__main__":
    sys.stdout.write(render_config(Config()))
