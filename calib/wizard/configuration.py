"""Changing keys in a configuration's text and leaving everything else in it as it is, comments as well."""

from __future__ import annotations

import os
import stat
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml

from ceilvo import yaml_nodes
from ceilvo.config.reader import parse_config
from ceilvo.config.rendering import yaml_text
from ceilvo.errors import ConfigError, one_line
from ceilvo.files import write_atomic

_INDENT = "  "


def with_values(text: str, source: str, values: Mapping[str, Any]) -> str:
    """The text with these values by `section.key`; a key or section that is not there is added.

    Args:
        source: names the text in messages.

    Raises:
        ConfigError: the text or what would come of it is no good configuration.
    """
    parse_config(text, source)
    for name, value in values.items():
        section, _, key = name.partition(".")
        text = _with_value(text, section, key, yaml_text(value))
    parse_config(text, source)
    return text


def change_config(path: Path, values: Mapping[str, Any]) -> Path:
    """Change keys of a file; the file as it was is kept beside it.

    Returns:
        The file as it was, NAME.bak.

    Raises:
        ConfigError: it cannot be read or written, or a value is wrong; then the file is as it was.
    """
    try:
        old = yaml_nodes.read_text(path)
    except yaml_nodes.YamlProblem as e:
        raise ConfigError(f"{path}: {e.what}") from None
    new = with_values(old, str(path), values)
    kept = path.with_name(path.name + ".bak")
    try:
        mode = stat.S_IMODE(path.stat().st_mode)
        write_atomic(kept, old, mode)
        write_atomic(path, new, mode)
    except OSError as e:
        who = "root" if os.geteuid() == 0 else f"user {os.geteuid()}"
        raise ConfigError(
            f"{path}: cannot be written by {who} ({one_line(e.strerror)}); write there yourself: "
            + ", ".join(f"{name}: {yaml_text(value)}" for name, value in values.items())
        ) from None
    return kept


def _with_value(text: str, section: str, key: str, value: str) -> str:
    root = yaml_nodes.parse(text)
    under = _child(root, section)
    if under is None:
        gap = "" if not text or text.endswith("\n") else "\n"
        return f"{text}{gap}\n{section}:\n{_INDENT}{key}: {value}\n"
    name_node, node = under
    if not isinstance(node, yaml.MappingNode) or not node.value:
        at = name_node.end_mark.index + 1  # behind the colon
        return f"{text[:at]}\n{_INDENT}{key}: {value}{text[at:]}"
    found = _child(node, key)
    if found is not None:
        start, end = found[1].start_mark.index, found[1].end_mark.index
        gap = "" if text[:start].endswith((" ", "\t")) else " "
        return f"{text[:start]}{gap}{value}{text[end:]}"
    first = node.value[0][0].start_mark
    if node.flow_style:
        return f"{text[: first.index]}{key}: {value}, {text[first.index :]}"
    return f"{text[: first.index]}{key}: {value}\n{' ' * first.column}{text[first.index :]}"


def _child(node: yaml.Node | None, name: str) -> tuple[yaml.Node, yaml.Node] | None:
    pairs = node.value if isinstance(node, yaml.MappingNode) else []
    return next(((k, v) for k, v in pairs if isinstance(k, yaml.ScalarNode) and k.value == name), None)
