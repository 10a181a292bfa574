"""Reading, checking and rendering config.yaml against the schema in ceilvo.config.

A mistake is one line `FILE:LINE: section.key: found X, expected Y; hint`, and all mistakes of a file come at once.
`python -m ceilvo.config.reader` prints the file with all defaults.
"""

from __future__ import annotations

import dataclasses
import difflib
import json
import math
import re
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeGuard, get_args, get_type_hints

import yaml

from ceilvo import yaml_nodes
from ceilvo.config.checks import conflicts, cross_check, notes
from ceilvo.config.schema import SECTIONS, Config
from ceilvo.errors import ConfigError

__all__ = ["calibration_path", "cross_check", "load_config", "notes", "parse_config", "render_config", "replace"]

_TYPES: Mapping[str, type] = {name: kind for name, kind in get_type_hints(Config).items() if name in SECTIONS}
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
    "states": "when a pose is called good, degraded or lost",
    "base": "the base controller, Modbus RTU",
    "zenoh": "the bus",
    "service": "the process",
    "recorder": "what is kept to find out later what happened",
}
_HEADER = """\
# Configuration of ceilvod. These are the defaults; a key that is left out has its default.
# `ceilvod check-config FILE` checks a file without starting. Explained in docs/configuration.md.
"""
_PLAIN_TEXT = re.compile(r"[A-Za-z/][A-Za-z0-9_./-]*")
_NOT_PLAIN = {"true", "false", "null", "yes", "no", "on", "off", "y", "n"}


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


def render_config(config: Config) -> str:
    """YAML with every key, its unit, range and reason; `load_config` reads the same configuration back."""
    return _HEADER + "".join(_render_section(name, getattr(config, name)) for name in SECTIONS)


def _render_section(name: str, section: Any) -> str:
    lines = [f"\n# {_ABOUT[name]}", f"{name}:"]
    for f in dataclasses.fields(section):
        facts = ", ".join(s for s in (_unit(f.name), _range(f.metadata)) if s)
        lines.append(f"  # {f.metadata['why']}" + (f" [{facts}]" if facts else ""))
        lines.append(f"  {f.name}: {_yaml(getattr(section, f.name))}")
    return "\n".join(lines) + "\n"


def _unit(name: str) -> str:
    for suffix in sorted(_UNITS, key=len, reverse=True):
        if name.endswith(suffix):
            return _UNITS[suffix]
    return ""


def _range(meta: Mapping[str, Any]) -> str:
    if meta["choices"]:
        return " | ".join(meta["choices"])
    if meta["low"] is None and meta["high"] is None:
        return ""
    if meta["high"] is None:
        return f"from {_short(meta['low'])}"
    return f"{_short(meta['low'])} to {_short(meta['high'])}"


def _short(value: float) -> str:
    return str(int(value)) if float(value).is_integer() and abs(value) < 1e12 else repr(value)


def _yaml(value: Any) -> str:
    if value is None:
        return "null"
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, (tuple, list)):
        return "[" + ", ".join(_quoted(v) for v in value) + "]"
    if isinstance(value, str):
        plain = _PLAIN_TEXT.fullmatch(value) and value.lower() not in _NOT_PLAIN
        return value if plain else _quoted(value)
    text = repr(value)
    return text.replace("e", ".0e") if "e" in text and "." not in text else text  # YAML 1.1 wants the point


def _quoted(value: str) -> str:
    return json.dumps(value, ensure_ascii=False)


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
            self._problem(root, "", f"found {_found(root)}, expected sections such as 'camera:' with keys below them")
            return
        for name, at, node in self._pairs(root, ""):
            if name not in _TYPES:
                self._problem(at, name, f"found an unknown section, expected {_known_section(name)}")
            elif _is_mapping(node):
                for key, at_key, value in self._pairs(node, name):
                    self._take(name, key, value, f"{self._source}:{yaml_nodes.line_of(at_key)}")
            elif not (isinstance(node, yaml.ScalarNode) and node.value == "" and not node.style):
                self._problem(at, name, f"found {_found(node)}, expected keys, indented below '{name}:'")

    def override(self, text: str) -> None:
        name, eq, value = text.partition("=")
        section, dot, key = name.strip().partition(".")
        where = f"--set {text}"
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
        if key not in schema:
            self._problems.append(f"{where}: {full}: found an unknown key, expected {_known_key(section, key)}")
            return
        self._where[full] = where
        kind = get_type_hints(_TYPES[section])[key]
        try:
            self._values[section][key] = _checked(node, kind, schema[key])
        except _Wrong as e:
            self._bad.add(full)
            self._problems.append(f"{where}: {full}: {e}")

    def _pairs(self, node: yaml.MappingNode, section: str) -> list[tuple[str, yaml.Node, yaml.Node]]:
        """Names with key and value nodes; problems with the keys themselves are reported and left out."""
        out: dict[str, tuple[str, yaml.Node, yaml.Node]] = {}
        for k, v in node.value:
            name = yaml_nodes.scalar(k) if isinstance(k, yaml.ScalarNode) else None
            if not isinstance(name, str):
                self._problem(k, section, f"found {_found(k)} as a key, expected a name")
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
        self._problems.append(f"{self._source}:{yaml_nodes.line_of(node)}: {name}{': ' if name else ''}{text}")


def _is_mapping(node: yaml.Node) -> TypeGuard[yaml.MappingNode]:
    return isinstance(node, yaml.MappingNode) and not yaml_nodes.odd_tag(node)


class _Wrong(Exception):
    pass


def _checked(node: yaml.Node, kind: Any, field: dataclasses.Field[Any]) -> Any:
    """The value of a node as the schema wants it.

    Raises:
        _Wrong: with the message from "found" on.
    """
    optional = type(None) in get_args(kind)
    base = next((t for t in get_args(kind) if t is not type(None)), kind) if optional else kind
    expected = _expected(base, field.metadata) + (" or null" if optional else "")
    if base not in (bool, int, float, str):
        return _checked_list(node, field, expected)
    value = yaml_nodes.scalar(node) if isinstance(node, yaml.ScalarNode) else yaml_nodes.Tagged("")
    if value is None and optional:
        return None
    if base is float and isinstance(value, int) and not isinstance(value, bool):
        value = float(value)
    if type(value) is not base:
        raise _Wrong(f"found {_found(node)}, expected {expected}; {_type_hint(node, base, field)}")
    if isinstance(value, str):
        return _checked_text(value, field, expected)
    if isinstance(value, float) and not math.isfinite(value):
        raise _Wrong(f"found {_found(node)}, expected {expected}; {_default(field)}")
    low, high = field.metadata["low"], field.metadata["high"]
    if (low is not None and value < low) or (high is not None and value > high):
        raise _Wrong(f"found {_found(node)}, expected {expected}; {_default(field)}")
    return value


def _checked_text(value: str, field: dataclasses.Field[Any], expected: str) -> str:
    choices = field.metadata["choices"]
    if choices and value not in choices:
        near = difflib.get_close_matches(value.lower(), [c.lower() for c in choices], 1, 0.5)
        like = next((c for c in choices if near and c.lower() == near[0]), None)
        hint = f"did you mean {like}?" if like else _default(field)
        raise _Wrong(f"found {_clip(value)}, expected {expected}; {hint}")
    if not value.isprintable():
        raise _Wrong(f"found {_clip(value)}, expected text without control characters; type it again")
    return value


def _checked_list(node: yaml.Node, field: dataclasses.Field[Any], expected: str) -> tuple[str, ...]:
    if not isinstance(node, yaml.SequenceNode) or yaml_nodes.odd_tag(node):
        text = node.value if isinstance(node, yaml.ScalarNode) else ""
        hint = f"write [{_quoted(text)}]" if text else "write [] for none"
        raise _Wrong(f"found {_found(node)}, expected {expected}; {hint}")
    out = []
    for item in node.value:
        value = yaml_nodes.scalar(item) if isinstance(item, yaml.ScalarNode) else None
        if not isinstance(value, str):
            raise _Wrong(f"found {_found(item)} in the list, expected {expected}; put each entry in quotes")
        out.append(_checked_text(value, field, expected))
    return tuple(out)


def _expected(base: Any, meta: Mapping[str, Any]) -> str:
    if meta["choices"]:
        return "one of " + ", ".join(meta["choices"])
    limits = _range(meta)
    if base is bool:
        return "true or false"
    if base in (int, float):
        name = "a whole number" if base is int else "a number"
        return f"{name} {'' if limits.startswith('from') else 'from '}{limits}" if limits else name
    return "text" if base is str else "a list of texts"


def _found(node: yaml.Node) -> str:
    if yaml_nodes.odd_tag(node):
        return f"a value with the tag {yaml_nodes.odd_tag(node)}"
    if isinstance(node, yaml.MappingNode):
        return "keys and values"
    if isinstance(node, yaml.SequenceNode):
        return "a list"
    value = yaml_nodes.scalar(node) if isinstance(node, yaml.ScalarNode) else None
    if isinstance(value, yaml_nodes.Tagged):
        return f"a value with the tag {value.tag}"
    if value is None:
        return "nothing" if node.value == "" else "null"
    return f"the text {_clip(value)}" if isinstance(value, str) else _clip(str(node.value), quote=False)


def _clip(text: str, *, quote: bool = True) -> str:
    short = text if len(text) <= 60 else text[:57] + "..."
    return repr(short) if quote else short


def _type_hint(node: yaml.Node, base: type, field: dataclasses.Field[Any]) -> str:
    text = str(node.value) if isinstance(node, yaml.ScalarNode) else ""
    if base is str and text:
        return "put it in quotes"
    if base is bool and text.lower() in ("yes", "on", "y", "1"):
        return "write true"
    if base is bool and text.lower() in ("no", "off", "n", "0"):
        return "write false"
    if base in (int, float) and re.fullmatch(r"[-+]?[0-9.]+", text) and node.tag.endswith(":str"):
        return "remove the quotes"
    if base is float and re.fullmatch(r"[-+]?[0-9]+,[0-9]+", text):
        return f"write {text.replace(',', '.')}"
    if base in (int, float) and re.fullmatch(r"[-+]?[0-9.]+ ?[A-Za-z/%]+", text):
        return "write the number alone, the unit is in the key's name"
    if base is int and re.fullmatch(r"[-+]?[0-9]+\.0*", text):
        return f"write {text.split('.')[0]}"
    return _default(field)


def _default(field: dataclasses.Field[Any]) -> str:
    factory = field.default_factory
    value = field.default if factory is dataclasses.MISSING else factory()
    return f"the default is {_yaml(value)}: {field.metadata['why']}"


def _keys(section: str) -> tuple[dataclasses.Field[Any], ...]:
    return dataclasses.fields(_TYPES[section])


def _known_section(name: str) -> str:
    everything = ", ".join(SECTIONS)
    homes = [s for s in SECTIONS if name in {f.name for f in _keys(s)}]
    near = difflib.get_close_matches(name, SECTIONS, 1, 0.6)
    if near:
        return f"one of {everything}; did you mean {near[0]}?"
    if homes:
        return f"one of {everything}; {name} is a key of {' and '.join(homes)}, indent it there"
    return f"one of {everything}; remove it"


def _known_key(section: str, key: str) -> str:
    names = [f.name for f in _keys(section)]
    homes = [s for s in SECTIONS if key in {f.name for f in _keys(s)}]
    near = difflib.get_close_matches(key, names, 1, 0.6)
    if near:
        return f"a key of {section}; did you mean {near[0]}?"
    listed = ", ".join(names)
    if homes:
        return f"one of {listed}; {key} is a key of {' and '.join(homes)}"
    return f"one of {listed}; remove it"


if __name__ == "__main__":
    sys.stdout.write(render_config(Config()))
