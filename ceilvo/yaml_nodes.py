"""YAML with line numbers and without surprises: scalars as YAML 1.2 reads them, no tags, no duplicate keys.

PyYAML parses; its YAML 1.1 types are left out, so `no` is text, `1e4` is a number and `1:30` is not.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from ceilvo.errors import one_line

MAX_BYTES = 1 << 20
"""Of a file; ours have some kilobytes, and PyYAML is slow."""
_DEPTH_MOST = 20
"""Of nesting; chosen, far more than ours have."""
_MESSAGE_CHARS = 300
"""Of a message, which may repeat what is in the file."""
_TAG_CHARS = 60
"""Of a tag in a message."""
_WIDTH = 110
"""Characters of a line that is written."""
_TAG = "tag:yaml.org,2002:"
_PATTERNS = (
    ("bool", r"true|True|TRUE|false|False|FALSE", "tTfF"),
    ("int", r"[-+]?[0-9]{1,40}", "-+0123456789"),
    (
        "float",
        r"[-+]?(?:\.[0-9]+|[0-9]+\.[0-9]*(?:[eE][-+]?[0-9]+)?|[0-9]+[eE][-+]?[0-9]+|\.[0-9]+[eE][-+]?[0-9]+)"
        r"|[-+]?\.(?:inf|Inf|INF)|\.(?:nan|NaN|NAN)",
        "-+.0123456789",
    ),
    ("null", r"~|null|Null|NULL|", ["~", "n", "N", ""]),
)


class _Loader(yaml.SafeLoader):
    yaml_implicit_resolvers: dict[str, Any] = {}  # noqa: RUF012 - PyYAML's own interface

    def compose_node(self, parent: yaml.Node | None, index: int) -> yaml.Node | None:
        if self.check_event(yaml.AliasEvent):  # a few aliases of aliases would unfold without bound
            event = self.peek_event()  # type: ignore[no-untyped-call]
            raise yaml.MarkedYAMLError(problem="an alias *name", problem_mark=event.start_mark)
        return super().compose_node(parent, index)


class _Dumper(yaml.SafeDumper):
    """Quotes whatever either version of YAML could take for something other than text."""

    def ignore_aliases(self, data: Any) -> bool:
        return True


for _name, _pattern, _first in _PATTERNS:
    for _cls in (_Loader, _Dumper):
        _cls.add_implicit_resolver(_TAG + _name, re.compile(rf"^(?:{_pattern})$"), list(_first))


class YamlProblem(Exception):
    """A text that is not the YAML we accept: the line (1-based, 0 = none) and what is wrong."""

    def __init__(self, line: int, what: str) -> None:
        super().__init__(what)
        self.line = line
        self.what = one_line(what, _MESSAGE_CHARS)


@dataclass(frozen=True)
class Tagged:
    """A scalar with a tag that we do not read, or whose text does not suit its tag."""

    tag: str


def read_text(path: Path) -> str:
    """The text of a file of at most MAX_BYTES.

    Raises:
        YamlProblem: missing, unreadable, not a regular file, too large or not UTF-8.
    """
    try:
        if path.exists() and not path.is_file():
            raise YamlProblem(0, f"found a {'folder' if path.is_dir() else 'device'}, expected a regular file")
        with path.open("rb") as f:
            raw = f.read(MAX_BYTES + 1)
    except FileNotFoundError:
        raise YamlProblem(0, "found no such file, expected a readable file") from None
    except OSError as e:
        raise YamlProblem(0, f"found a file that cannot be read ({e.strerror}), expected a readable file") from None
    except ValueError as e:
        raise YamlProblem(0, f"found an impossible file name ({e}), expected a readable file") from None
    if len(raw) > MAX_BYTES:
        raise YamlProblem(0, f"found more than {MAX_BYTES} bytes, expected at most {MAX_BYTES}; is it the right file?")
    try:
        return raw.decode("utf-8-sig")
    except UnicodeDecodeError as e:
        line = raw[: e.start].count(b"\n") + 1
        raise YamlProblem(line, f"found byte 0x{raw[e.start]:02x}, expected UTF-8 text; save it as UTF-8") from None


def parse(text: str) -> yaml.Node | None:
    """The root node, None for a text with nothing but comments.

    Raises:
        YamlProblem: not YAML, several documents, or nested too deeply.
    """
    try:
        node: yaml.Node | None = yaml.compose(text, Loader=_Loader)
    except yaml.MarkedYAMLError as e:
        mark = e.problem_mark or e.context_mark
        hint = "; indent with spaces" if "\\t" in (e.problem or "") else "; check indentation, colons and quotes"
        line = mark.line + 1 if mark else 0
        raise YamlProblem(
            line, f"found text that is not YAML ({e.problem or e.context}), expected YAML{hint}"
        ) from None
    except yaml.YAMLError as e:
        reason = getattr(e, "reason", str(e))
        line = text.count("\n", 0, getattr(e, "position", 0)) + 1
        raise YamlProblem(line, f"found a character that YAML forbids ({reason}), expected YAML text") from None
    except RecursionError:
        raise YamlProblem(0, "found nesting that is too deep to read, expected section and keys") from None
    return node


def line_of(node: yaml.Node) -> int:
    """1-based."""
    return int(node.start_mark.line) + 1


def odd_tag(node: yaml.Node) -> str:
    """The tag of a list or mapping that is more than that, else nothing."""
    usual = _TAG + ("map" if isinstance(node, yaml.MappingNode) else "seq")
    return "" if isinstance(node, yaml.ScalarNode) or node.tag == usual else _short_tag(node)


def _short_tag(node: yaml.Node) -> str:
    """For messages."""
    return one_line(node.tag.replace(_TAG, "!!"), _TAG_CHARS)


def scalar(node: yaml.ScalarNode) -> bool | int | float | str | Tagged | None:
    """The value of a scalar node."""
    kind = node.tag.removeprefix(_TAG)
    text = str(node.value)
    try:
        if kind == "str":
            return text
        if kind == "null":
            return None
        if kind == "bool":
            return {"true": True, "false": False}[text.lower()]
        if kind == "int":
            return int(text)
        if kind == "float":
            return float(text.lower().replace(".inf", "inf").replace(".nan", "nan"))
    except (KeyError, ValueError):
        pass
    return Tagged(_short_tag(node))


def plain(node: yaml.Node | None, _depth: int = 0) -> Any:
    """Nested dict, list and scalars; only text as keys.

    Raises:
        YamlProblem: a tag, a key that is not text or comes twice, or nesting that is too deep.
    """
    if node is None:
        return None
    if _depth > _DEPTH_MOST:
        raise YamlProblem(line_of(node), f"found nesting deeper than {_DEPTH_MOST} levels, expected less")
    if odd_tag(node):
        raise YamlProblem(line_of(node), f"found a value with the tag {odd_tag(node)}, expected a plain value")
    if isinstance(node, yaml.MappingNode):
        out: dict[str, Any] = {}
        for k, v in node.value:
            name = scalar(k) if isinstance(k, yaml.ScalarNode) else None
            if not isinstance(name, str):
                raise YamlProblem(line_of(k), f"found key {name!r}, expected text")
            if name in out:
                raise YamlProblem(line_of(k), f"found key {name!r} twice, expected it once")
            out[name] = plain(v, _depth + 1)
        return out
    if isinstance(node, yaml.SequenceNode):
        return [plain(v, _depth + 1) for v in node.value]
    if not isinstance(node, yaml.ScalarNode):
        raise YamlProblem(line_of(node), "found an unknown node, expected a value")
    value = scalar(node)
    if isinstance(value, Tagged):
        raise YamlProblem(line_of(node), f"found a value with the tag {value.tag}, expected a plain value")
    return value


def dump(content: Any) -> str:
    """YAML that `plain(parse(...))` reads back to the same: floats exactly, innermost lists on one line."""
    return str(yaml.dump(content, Dumper=_Dumper, sort_keys=False, default_flow_style=None, width=_WIDTH))
