"""One value of config.yaml as the schema wants it, or a message from "found" on that says what to write instead."""

from __future__ import annotations

import dataclasses
import difflib
import math
import re
from collections.abc import Mapping
from typing import Any, get_args

import yaml

from ceilvo import yaml_nodes
from ceilvo.config.rendering import quoted, range_text, yaml_text
from ceilvo.errors import one_line

LONGEST = 60
"""Characters of a wrong value that a message repeats: it stays one line."""
_ALIKE = 0.5
"""difflib's ratio from which a choice is suggested; chosen: a letter or two may be wrong."""


class WrongValue(Exception):
    """The message, from "found" on."""


def checked_value(node: yaml.Node, kind: Any, field: dataclasses.Field[Any]) -> Any:
    """The value of a node as the schema wants it.

    Raises:
        WrongValue: it cannot be.
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
        raise WrongValue(f"found {shown(node)}, expected {expected}; {_type_hint(node, base, field)}")
    if isinstance(value, str):
        return _checked_text(value, field, expected)
    if isinstance(value, float) and not math.isfinite(value):
        raise WrongValue(f"found {shown(node)}, expected {expected}; {_default(field)}")
    low, high = field.metadata["low"], field.metadata["high"]
    if (low is not None and value < low) or (high is not None and value > high):
        raise WrongValue(f"found {shown(node)}, expected {expected}; {_default(field)}")
    return value


def _checked_text(value: str, field: dataclasses.Field[Any], expected: str) -> str:
    choices = field.metadata["choices"]
    value = field.metadata["renamed"].get(value, value)
    if choices and value not in choices:
        near = difflib.get_close_matches(value.lower(), [c.lower() for c in choices], 1, _ALIKE)
        like = next((c for c in choices if near and c.lower() == near[0]), None)
        hint = f"did you mean {like}?" if like else _default(field)
        raise WrongValue(f"found {_clip(value)}, expected {expected}; {hint}")
    if not value.isprintable():
        raise WrongValue(f"found {_clip(value)}, expected text without control characters; type it again")
    return value


def _checked_list(node: yaml.Node, field: dataclasses.Field[Any], expected: str) -> tuple[str, ...]:
    if not isinstance(node, yaml.SequenceNode) or yaml_nodes.odd_tag(node):
        text = one_line(node.value, LONGEST) if isinstance(node, yaml.ScalarNode) else ""
        hint = f"write [{quoted(text)}]" if text else "write [] for none"
        raise WrongValue(f"found {shown(node)}, expected {expected}; {hint}")
    out = []
    for item in node.value:
        value = yaml_nodes.scalar(item) if isinstance(item, yaml.ScalarNode) else None
        if not isinstance(value, str):
            raise WrongValue(f"found {shown(item)} in the list, expected {expected}; put each entry in quotes")
        out.append(_checked_text(value, field, expected))
    return tuple(out)


def _expected(base: Any, meta: Mapping[str, Any]) -> str:
    if meta["choices"]:
        return "one of " + ", ".join(meta["choices"])
    limits = range_text(meta)
    if base is bool:
        return "true or false"
    if base in (int, float):
        name = "a whole number" if base is int else "a number"
        return f"{name} {'' if limits.startswith('from') else 'from '}{limits}" if limits else name
    return "text" if base is str else "a list of texts"


def shown(node: yaml.Node) -> str:
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
    if not quote:
        return one_line(text, LONGEST)
    return repr(text if len(text) <= LONGEST else text[: LONGEST - 3] + "...")


def _type_hint(node: yaml.Node, base: type, field: dataclasses.Field[Any]) -> str:
    text = one_line(node.value, LONGEST) if isinstance(node, yaml.ScalarNode) else ""
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
    return f"the default is {yaml_text(value)}: {field.metadata['why']}"
