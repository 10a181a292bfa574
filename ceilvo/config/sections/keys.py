"""What a key of config.yaml is: a dataclass field with its reason, range and former names."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import field
from typing import Any


def key(
    default: Any,
    why: str,
    *,
    low: float | None = None,
    high: float | None = None,
    choices: tuple[str, ...] | None = None,
    renamed: Mapping[str, str] | None = None,
    was: tuple[str, float] | None = None,
) -> Any:
    """A configuration key: its default, the one-line reason, and the closed range or the choices it must be in.

    Choices that older configurations call by another name are still read: `renamed`. So are keys of another name and
    unit: `was` has the name, and how many of the old unit are one of the new.
    """
    meta = {"why": why, "low": low, "high": high, "choices": choices, "renamed": renamed or {}, "was": was}
    if isinstance(default, list):
        return field(default_factory=lambda: tuple(default), metadata=meta)
    return field(default=default, metadata=meta)
