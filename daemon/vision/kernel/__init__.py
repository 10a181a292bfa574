"""The loops over single edge points: compiled where a compiler was there when ceilvo was installed, else in NumPy."""

from __future__ import annotations

try:
    from ceilvo.daemon.vision.kernel.compiled import (
        assign,
        extents,
        follow,
        hits,
        level_points,
        means,
        project,
        split,
        sums,
        vote,
    )

    COMPILED = True
except ImportError:
    from ceilvo.daemon.vision.kernel.reference import (
        assign,
        extents,
        follow,
        hits,
        level_points,
        means,
        project,
        split,
        sums,
        vote,
    )

    COMPILED = False

__all__ = [
    "COMPILED",
    "assign",
    "extents",
    "follow",
    "hits",
    "level_points",
    "means",
    "project",
    "split",
    "sums",
    "vote",
]
