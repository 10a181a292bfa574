"""Reading and checking config.yaml against the schema in ceilvo.config.

A mistake is one line `FILE:LINE: section.key: found X, expected Y; hint`, and all mistakes of a file come at once.
"""

from __future__ import annotations

import dataclasses
import difflib
import logging
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeGuard, get_type_hints

import yaml

from ceilvo import yaml_nodes
from ceilvo.config.checks import conflicts
from ceilvo.config.schema import SECTIONS, Config
from ceilvo.config.values import WrongValue, checked_value, shown
from ceilvo.errors import ConfigError, one_line

log = logging.getLogger(__name__)
_CONVERTED_DIGITS = 4
"""Behind the point, of a value that was in another unit; chosen: ten-thousandths of a degree."""
_ALIKE = 0.6
"""difflib's ratio from which a name is suggested; its own default."""
_TYPES: Mapping[str, type] = {name: kind for name, kind in get_type_hints(Config).items() if name in SECTIONS}


def load_config(path: Path, overrides: Sequence[str] = ()) -> Config:
    """The configuration in a file, with `section.key=value` overrides on top, checked but for the calibration.

    Raises:
        ConfigError: everything that is wrong, one line each, also as `.problems`.
    """
    return _load(lambda: yaml_nodes.read_text(Path(path)), str(path), overrides)


def parse_config(text: str, source: str, overrides: Sequence[str] = ()) -> Config:
    """The same from a text; `source` names it in messages."""
    return _load(lambda: text, source, overrides)


def _load(read: Callable[[], str], source: str, overrides: Sequence[str]) -> Config:
    reader = _Reader(Config(), source)
    try:
        root = yaml_nodes.parse(read())
    except yaml_nodes.YamlProblem as e:
        where = f"{source}:{e.line}" if e.line else source
        raise ConfigError(f"{where}: {e.what}") from None
    reader.read(root)
    for override in overrides:
        reader.override(override)
    return reader.result(check=True)


def replace(config: Config, overrides: Iterable[str]) -> Config:
    """A copy with `section.key=value` applied, each checked on its own; `cross_check` does the combinations.

    Raises:
        ConfigError: one line for each override that is wrong.
    """
    reader = _Reader(config, "--set")
    for override in overrides:
        reader.override(override)
    return reader.result(check=False)


def calibration_path(config: Config, config_path: Path) -> Path:
    """Where the calibration is: relative names count from the configuration's folder."""
    return Path(config_path).parent / config.calibration.file


def beside(config: Config, config_path: Path) -> Config:
    """With beacons.file where it is: relative names count from the configuration's folder."""
    name = config.beacons.file
    path = str(Path(config_path).parent / name) if name else ""
    return dataclasses.replace(config, beacons=dataclasses.replace(config.beacons, file=path))


class _Reader:
    """Collects values and problems, first from a file, then from overrides."""

    def __init__(self, start: Config, source: str) -> None:
        self._source = source
        self._values = {s: {f.name: getattr(getattr(start, s), f.name) for f in _keys(s)} for s in SECTIONS}
        self._where: dict[str, str] = {}
        self._bad: set[str] = set()
        self._problems: list[str] = []

    def read(self, root: yaml.Node | None) -> None:
        if root is None:
            return
        if not _is_mapping(root):
            self._problem(root, "", f"found {shown(root)}, expected sections such as 'camera:' with keys below them")
            return
        for name, at, node in self._pairs(root, ""):
            if name not in _TYPES:
                self._problem(at, name, f"found an unknown section, expected {_known_section(name)}")
            elif _is_mapping(node):
                for key, at_key, value in self._pairs(node, name):
                    self._take(name, key, value, f"{self._source}:{yaml_nodes.line_of(at_key)}")
            elif not (isinstance(node, yaml.ScalarNode) and node.value == "" and not node.style):
                self._problem(at, name, f"found {shown(node)}, expected keys, indented below '{name}:'")

    def override(self, text: str) -> None:
        name, eq, value = text.partition("=")
        section, dot, key = name.strip().partition(".")
        where = f"--set {one_line(text)}"
        if not eq or not dot:
            self._problems.append(f"{where}: expected section.key=value; for example camera.rate_hz=15")
            return
        if section not in _TYPES:
            self._problems.append(f"{where}: found an unknown section, expected {_known_section(section)}")
            return
        try:
            node = yaml_nodes.parse(value)
        except yaml_nodes.YamlProblem as e:
            self._problems.append(f"{where}: {e.what}")
            return
        mark = yaml.Mark("--set", 0, 0, 0, None, 0)
        self._take(section, key, node or yaml.ScalarNode("tag:yaml.org,2002:str", "", mark, mark), where)

    def result(self, *, check: bool) -> Config:
        config = Config(**{s: _TYPES[s](**self._values[s]) for s in SECTIONS})
        if check:
            for c in conflicts(config):
                if self._bad.isdisjoint(c.keys):
                    where = next((self._where[k] for k in c.keys if k in self._where), self._source)
                    self._problems.append(f"{where}: {c.keys[0]}: {c.text}")
        if self._problems:
            raise ConfigError(*self._problems)
        return config

    def _take(self, section: str, key: str, node: yaml.Node, where: str) -> None:
        full = f"{section}.{key}"
        schema = {f.name: f for f in _keys(section)}
        now = next((f for f in schema.values() if f.metadata["was"] and f.metadata["was"][0] == key), None)
        if now is not None:
            self._take(section, now.name, _converted(node, now), f"{where}: {full}, now")
            log.warning(
                "%s: %s is now %s.%s, which is %s", where, full, section, now.name, self._values[section][now.name]
            )
            return
        if key not in schema:
            self._problems.append(
                f"{where}: {one_line(full)}: found an unknown key, expected {_known_key(section, key)}"
            )
            return
        self._where[full] = where
        kind = get_type_hints(_TYPES[section])[key]
        try:
            self._values[section][key] = value = checked_value(node, kind, schema[key])
            if isinstance(node, yaml.ScalarNode) and node.value in schema[key].metadata["renamed"]:
                log.warning("%s: %s: %s is now called %s; it means the same", where, full, node.value, value)
        except WrongValue as e:
            self._bad.add(full)
            self._problems.append(f"{where}: {full}: {e}")

    def _pairs(self, node: yaml.MappingNode, section: str) -> list[tuple[str, yaml.Node, yaml.Node]]:
        """Names with key and value nodes; problems with the keys themselves are reported and left out."""
        out: dict[str, tuple[str, yaml.Node, yaml.Node]] = {}
        for k, v in node.value:
            name = yaml_nodes.scalar(k) if isinstance(k, yaml.ScalarNode) else None
            if not isinstance(name, str):
                self._problem(k, section, f"found {shown(k)} as a key, expected a name")
                continue
            if name in out:
                full = f"{section}.{name}" if section else name
                other = yaml_nodes.line_of(out[name][1])
                self._bad.add(full)
                self._problem(k, full, f"found it twice, expected it once; remove it here or on line {other}")
                continue
            out[name] = (name, k, v)
        return list(out.values())

    def _problem(self, node: yaml.Node, name: str, text: str) -> None:
        self._problems.append(
            f"{self._source}:{yaml_nodes.line_of(node)}: {one_line(name)}{': ' if name else ''}{text}"
        )


def _converted(node: yaml.Node, now: dataclasses.Field[Any]) -> yaml.Node:
    """A number of a key's old unit in the new one; what is no number is left as it is, to be refused as such."""
    value = yaml_nodes.scalar(node) if isinstance(node, yaml.ScalarNode) else None
    if isinstance(value, bool) or not isinstance(value, int | float):
        return node
    text = repr(round(value / now.metadata["was"][1], _CONVERTED_DIGITS))
    return yaml.ScalarNode("tag:yaml.org,2002:float", text, node.start_mark, node.end_mark)


def _is_mapping(node: yaml.Node) -> TypeGuard[yaml.MappingNode]:
    return isinstance(node, yaml.MappingNode) and not yaml_nodes.odd_tag(node)


def _keys(section: str) -> tuple[dataclasses.Field[Any], ...]:
    return dataclasses.fields(_TYPES[section])


def _known_section(name: str) -> str:
    everything = ", ".join(SECTIONS)
    homes = [s for s in SECTIONS if name in {f.name for f in _keys(s)}]
    near = difflib.get_close_matches(name, SECTIONS, 1, _ALIKE)
    if near:
        return f"one of {everything}; did you mean {near[0]}?"
    if homes:
        return f"one of {everything}; {name} is a key of {' and '.join(homes)}, indent it there"
    return f"one of {everything}; remove it"


def _known_key(section: str, key: str) -> str:
    names = [f.name for f in _keys(section)]
    homes = [s for s in SECTIONS if key in {f.name for f in _keys(s)}]
    near = difflib.get_close_matches(key, names, 1, _ALIKE)
    if near:
        return f"a key of {section}; did you mean {near[0]}?"
    listed = ", ".join(names)
    if homes:
        return f"one of {listed}; {key} is a key of {' and '.join(homes)}"
    return f"one of {listed}; remove it"
