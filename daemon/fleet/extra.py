"""Modules that need the libraries of the extra `fleet`, imported when they are used: most robots do without."""

from __future__ import annotations

import importlib
from typing import Any

from ceilvo.errors import CeilvoError

_LIBRARIES = {"cryptography", "msgpack"}


def loaded(module: str) -> Any:
    """A module of this package by its full name.

    Raises:
        CeilvoError: a library that it needs is not installed.
    """
    try:
        return importlib.import_module(module)
    except ModuleNotFoundError as e:
        if (e.name or "").partition(".")[0] not in _LIBRARIES:
            raise
        raise CeilvoError(f"{e.name} is not installed; pip install 'ceilvo[fleet]', or install.sh --fleet") from e
