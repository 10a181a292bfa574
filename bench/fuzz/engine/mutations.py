"""Inputs that are almost valid: bytes, words and trees of JSON changed in a few places by what readers dislike."""

from __future__ import annotations

import base64
import copy
import json
import re
import struct
from collections.abc import Callable
from random import Random
from typing import Any

Mutate = Callable[[bytes, Random], bytes]

_TOKENS = b'null true 1e309 -1 NaN [ ] { } : \n " !! &a *a \xff'.split(b" ")
_NUMBERS = (
    *(
        "0",
        "-1",
        "1",
        "2",
        "7",
        "255",
        "-0.0",
        "1e-320",
        "0.5",
        "1e6",
        "1e18",
        "1e308",
        "1e309",
        "-1e400",
        "nan",
        "inf",
    ),
    *("2147483648", "4294967295", "9223372036854775807", "9223372036854775808", "-9223372036854775809"),
    *("1" + "0" * 400, "7" * 5000, "0x10", "1_000", "1,5", "\u0663", "\u00b2", "+", "-", ".", "1e"),
)
_TEXTS = (
    *("", " ", "null", "true", "~", "no", "[]", "{}", "[1", '"', "'", "\\", "&a", "*a", "!!python/object:os.system"),
    *("../..", "/", "\0", "\x1b[2J", "\u202e", "\ud800", "\ufeff", "\r", "%s%n", "x" * 300, "y" * 5000, "[" * 3000),
)
_LARGE = "z" * 200_000
"""Rare, for every reader takes a while over it."""
_WORD = re.compile(rb"[-+]?\d+(?:\.\d*)?(?:[eE][-+]?\d+)?|[A-Za-z_][\w./-]*")
_VALUES: tuple[Any, ...] = (
    *(None, True, False, 0, 1, -1, 2, 3, 255, 10**6, 2**31, 2**32, 2**62, 2**63, -(2**63) - 1, 10**18, 10**400),
    *(0.5, -0.0, 1e-320, 1e-9, 1e9, 1e18, 1e308, float("inf"), float("-inf"), float("nan")),
    *("", "x", "nan", "\ud800", "\x1b[2J", "x" * 300, "7" * 5000),
    *([], {}, [[]], [0], {"a": 1}, [None], [[1, 2], [3]], [1e308] * 3, [0] * 1000),
)
_FLOATS = (0.0, -1.0, 1e-300, 0.5, 1e6, 1e150, 1e300, float("inf"), float("-inf"), float("nan"))
_WHOLE = (0, 1, -1, 2, 8, 9, 255, 2**31, 2**32, 2**62, 2**63 - 1, -(2**63))


def mutated(data: bytes, rng: Random) -> bytes:
    """Bytes or words of a text changed in one place to six; now and then anything at all."""
    how = rng.random()
    if how < 0.02:
        return rng.randbytes(rng.randint(0, 300))
    for _ in range(1 + min(rng.getrandbits(8) & rng.getrandbits(8) & 7, 5)):
        data = (_word_changed if how < 0.6 else _bytes_changed)(data, rng)
    return data


def mutated_json(data: bytes, rng: Random) -> bytes:
    """The tree of a JSON text changed in one place to three, mostly; what is no JSON as any bytes."""
    if rng.random() < 0.2:
        return mutated(data, rng)
    try:
        return json.dumps(mutated_tree(json.loads(data), rng)).encode("utf-8", "surrogatepass")
    except (ValueError, RecursionError):
        return mutated(data, rng)


def mutated_tree(tree: Any, rng: Random) -> Any:
    """A tree of dict, list and scalars changed in one place to three; the one that is given may be changed too."""
    holder = [tree]
    for _ in range(rng.choice((1, 1, 1, 2, 3))):
        places = _places(holder)
        _change_at(*places[rng.randrange(len(places))], rng)
    return holder[0]


def _places(tree: Any) -> list[tuple[Any, Any]]:
    """Every container with the key of every child in it."""
    out: list[tuple[Any, Any]] = []
    todo = [tree]
    while todo:
        node = todo.pop()
        for key in node if isinstance(node, dict) else range(len(node)):
            out.append((node, key))
            if isinstance(node[key], dict | list):
                todo.append(node[key])
    return out


def _change_at(node: Any, key: Any, rng: Random) -> None:
    child = node[key]
    how = rng.random()
    if isinstance(child, str) and len(child) >= 8 and how < 0.6:
        node[key] = _packed_changed(child, rng)
    elif isinstance(child, list) and child and how < 0.5:
        _length_changed(child, rng)
    elif isinstance(child, int | float) and not isinstance(child, bool) and abs(child) < 1e300 and how < 0.4:
        node[key] = rng.choice((-child, child + 1, child - 1, child * 1000, 2 * child, float(child), str(child)))
    elif isinstance(node, dict) and how < 0.55:
        del node[key]
    elif isinstance(node, dict) and how < 0.6:
        node[rng.choice(("x", "", f"{key} ", *node))] = node.pop(key)
    elif how < 0.75 and isinstance(node, dict | list):
        other, its = rng.choice(_places([node])[1:] or [(node, key)])
        node[key] = copy.deepcopy(other[its])
    else:
        node[key] = copy.deepcopy(rng.choice(_VALUES))


def _length_changed(items: list[Any], rng: Random) -> None:
    at = rng.randrange(len(items))
    how = rng.randrange(4)
    if how == 0:
        del items[at]
    elif how == 1:
        items.insert(at, copy.deepcopy(items[at]))
    elif how == 2:
        items.extend(copy.deepcopy(items))
    else:
        del items[at:]


def _packed_changed(text: str, rng: Random) -> str:
    """Numbers of eight bytes in base64 stay such; any other text changes as a text."""
    try:
        data = bytearray(base64.b64decode(text, validate=True))
    except ValueError:
        data = bytearray()
    if not data or len(data) % 8:
        return _word_changed(text.encode("utf-8", "surrogatepass"), rng).decode("utf-8", "replace")
    for _ in range(rng.randint(1, 3)):
        at = 8 * rng.randrange(len(data) // 8)
        word = struct.pack("<d", rng.choice(_FLOATS)) if rng.random() < 0.6 else struct.pack("<q", rng.choice(_WHOLE))
        data[at : at + 8] = word
    if rng.random() < 0.2:
        del data[-8 * rng.randint(1, len(data) // 8) :]
    if rng.random() < 0.1:
        data = data * 2
    return base64.b64encode(data).decode("ascii")


def _word_changed(data: bytes, rng: Random) -> bytes:
    words = [m.span() for m in _WORD.finditer(data[:65536])]
    if not words:
        return _bytes_changed(data, rng)
    first, last = rng.choice(words)
    is_number = data[first : first + 1].isdigit() or data[first : first + 1] in b"+-"
    new = rng.choice(_NUMBERS if is_number == (rng.random() < 0.8) else _TEXTS)
    if rng.random() < 0.01:
        new = _LARGE
    if rng.random() < 0.15:
        other = rng.choice(words)
        return data[:first] + data[slice(*other)] + data[last:]
    return data[:first] + new.encode("utf-8", "surrogatepass") + data[last:]


def _bytes_changed(data: bytes, rng: Random) -> bytes:
    """A byte changed, some cut, doubled or replaced by something that means something."""
    out = bytearray(data)
    at = rng.randrange(len(out) + 1)
    how = rng.randrange(6)
    if how == 0 and out:
        out[at % len(out)] = rng.randrange(256)
    elif how == 1 and out:
        out[at % len(out)] ^= 1 << rng.randrange(8)
    elif how == 2:
        del out[at : at + rng.randint(1, 40)]
    elif how == 3:
        out[at:at] = out[at : at + rng.randint(1, 40)]
    elif how == 4:
        out[at : at + rng.randint(1, 8)] = rng.choice(_TOKENS)
    else:
        size = rng.choice((1, 2, 4, 8))
        word = rng.choice(_WHOLE) & ((1 << 8 * size) - 1)
        out[at : at + size] = word.to_bytes(size, rng.choice(("little", "big")))
    return bytes(out)
