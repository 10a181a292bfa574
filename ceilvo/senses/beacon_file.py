"""The file of anchors, marks and lamps: YAML that people write, or `ceilvod anchors` does."""

from __future__ import annotations

import dataclasses
import math
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar

from ceilvo import yaml_nodes
from ceilvo.errors import ConfigError, one_line
from ceilvo.files import write_atomic
from ceilvo.json_values import MAX_COORDINATE_M
from ceilvo.senses.beacons import NAME_CHARS, Anchor, Beacons, Lamp, Mark

VERSION = 1
MOST = 1000
"""Anchors, marks or lamps of a file; chosen: a building has tens."""
_SHOWN = 40
_NAME = re.compile(rf"[0-9A-Za-z_.:-]{{1,{NAME_CHARS}}}")
_HEADER = """\
# Radio anchors, marks and lamps of known place, in the map's frame; docs/ranges.md and docs/marks.md tell the lines.
"""
_ANCHOR = {
    "name": None,
    "x_m": (-MAX_COORDINATE_M, MAX_COORDINATE_M),
    "y_m": (-MAX_COORDINATE_M, MAX_COORDINATE_M),
    "z_m": (-10.0, 100.0),
    "sigma_m": (0.0, 10.0),
    "offset_m": (-1.0, 1.0),
    "offset_sigma_m": (0.0, 2.0),
    "scale": (-0.02, 0.02),
    "scale_sigma": (0.0, 0.1),
}
_MARK = {
    "id": (0.0, 100_000.0),
    "size_m": (0.01, 5.0),
    "x_m": (-MAX_COORDINATE_M, MAX_COORDINATE_M),
    "y_m": (-MAX_COORDINATE_M, MAX_COORDINATE_M),
    "theta_deg": (-360.0, 360.0),
    "sigma_m": (0.0005, 1.0),
    "sigma_deg": (0.02, 45.0),
}
_LAMP = {
    "name": None,
    "x_m": (-MAX_COORDINATE_M, MAX_COORDINATE_M),
    "y_m": (-MAX_COORDINATE_M, MAX_COORDINATE_M),
    "below_m": (0.0, 20.0),
    "sigma_m": (0.001, 1.0),
}
"""Keys with what they may be; None is a name. A key that a dataclass has a default for may be left out."""
_KEYS = {"version", "anchors", "marks", "lamps"}
_Bounds = Mapping[str, tuple[float, float] | None]
_T = TypeVar("_T")


def read_beacons(path: Path) -> Beacons:
    """
    Raises:
        ConfigError: one line for each thing that is wrong, with file, entry, value found and what was expected.
    """
    try:
        content = yaml_nodes.plain(yaml_nodes.parse(yaml_nodes.read_text(path)))
    except yaml_nodes.YamlProblem as e:
        raise ConfigError(f"{path}{f':{e.line}' if e.line else ''}: {e.what}") from None
    if not isinstance(content, dict) or not {"version"} <= set(content) <= _KEYS:
        raise ConfigError(f"{path}: found {_shown(content)}, expected the keys version, anchors, marks and lamps")
    if content["version"] != VERSION or isinstance(content["version"], bool):
        raise ConfigError(
            f"{path}: version: found {_shown(content['version'])}, expected {VERSION}; use a newer ceilvo"
        )
    problems: list[str] = []
    needed = {f.name for f in dataclasses.fields(Anchor) if f.default is dataclasses.MISSING}
    anchors = _entries(content.get("anchors"), f"{path}: anchors", _ANCHOR, needed, problems)
    needed = {"id", "size_m", "x_m", "y_m", "theta_deg"}
    marks = _entries(content.get("marks"), f"{path}: marks", _MARK, needed, problems)
    needed = {f.name for f in dataclasses.fields(Lamp) if f.default is dataclasses.MISSING}
    lamps = _entries(content.get("lamps"), f"{path}: lamps", _LAMP, needed, problems)
    for what, entries, key in (("anchors", anchors, "name"), ("marks", marks, "id"), ("lamps", lamps, "name")):
        named = [e[key] for e in entries]
        twice = sorted({str(n) for n in named if named.count(n) > 1})
        problems += [f"{path}: {what}: found {n} twice, expected each once" for n in twice]
    if problems:
        raise ConfigError(*problems)
    return Beacons(
        tuple(Anchor(**a) for a in anchors), tuple(_mark(m) for m in marks), tuple(Lamp(**one) for one in lamps)
    )


def write_beacons(path: Path, beacons: Beacons) -> None:
    """Whole or not at all.

    Raises:
        ConfigError: the disk refuses.
    """
    try:
        write_atomic(path, render_beacons(beacons))
    except OSError as e:
        raise ConfigError(f"{path}: cannot be written ({e.strerror}); check the folder and its rights") from None


def render_beacons(beacons: Beacons) -> str:
    content: dict[str, Any] = {"version": VERSION}
    if beacons.anchors:
        content["anchors"] = [_rounded(dataclasses.asdict(a)) for a in beacons.anchors]
    if beacons.marks:
        content["marks"] = [_rounded(_as_entry(m)) for m in beacons.marks]
    if beacons.lamps:
        content["lamps"] = [_rounded(dataclasses.asdict(one)) for one in beacons.lamps]
    return _HEADER + yaml_nodes.dump(content)


def _entries(found: Any, where: str, bounds: _Bounds, needed: set[str], problems: list[str]) -> list[dict[str, Any]]:
    if found is None:
        return []
    if not isinstance(found, list) or len(found) > MOST:
        problems.append(f"{where}: found {_shown(found)}, expected a list of up to {MOST}")
        return []
    out = []
    for i, entry in enumerate(found):
        at = f"{where}[{i}]"
        if not isinstance(entry, dict) or not needed <= set(entry) <= set(bounds):
            keys = ", ".join(sorted(needed)) + " and perhaps " + ", ".join(sorted(set(bounds) - needed))
            problems.append(f"{at}: found {_shown(entry)}, expected {keys}")
            continue
        wrong = [f"{at}.{k}: {p}" for k, v in entry.items() if (p := _problem(v, bounds[k]))]
        problems += wrong
        if not wrong:
            out.append({k: v.upper() if bounds[k] is None else v for k, v in entry.items()})
    return out


def _problem(value: Any, bounds: tuple[float, float] | None) -> str:
    if bounds is None:
        good = isinstance(value, str) and _NAME.fullmatch(value)
        return "" if good else f'found {_shown(value)}, expected a name in quotes, as "0C14"'
    low, high = bounds
    number = isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
    return (
        "" if number and low <= value <= high else f"found {_shown(value)}, expected a number from {low:g} to {high:g}"
    )


def _mark(entry: dict[str, Any]) -> Mark:
    sigma = {"sigma_m": float(entry["sigma_m"])} if "sigma_m" in entry else {}
    sigma |= {"sigma_rad": math.radians(entry["sigma_deg"])} if "sigma_deg" in entry else {}
    place = float(entry["x_m"]), float(entry["y_m"]), math.radians(entry["theta_deg"])
    return Mark(int(entry["id"]), float(entry["size_m"]), *place, **sigma)


def _as_entry(mark: Mark) -> dict[str, Any]:
    return {
        "id": mark.number,
        "size_m": mark.size_m,
        "x_m": mark.x_m,
        "y_m": mark.y_m,
        "theta_deg": math.degrees(mark.theta_rad),
        "sigma_m": mark.sigma_m,
        "sigma_deg": math.degrees(mark.sigma_rad),
    }


def _rounded(entry: dict[str, Any]) -> dict[str, Any]:
    return {k: round(v, 5) if isinstance(v, float) else v for k, v in entry.items()}


def _shown(value: Any) -> str:
    return one_line(repr(value), _SHOWN)
