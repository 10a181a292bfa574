"""Recordings and pictures by others, which live outside the repository."""

from __future__ import annotations

import os
from pathlib import Path


def data_path(name: str) -> Path:
    """Of a folder or file in $CEILVO_DATA, else in a folder shared/data beside the repository; there or not."""
    beside = Path(__file__).resolve().parents[2] / "shared" / "data"
    return Path(os.environ.get("CEILVO_DATA") or beside) / name
