"""What a map has in it, in figures."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

import numpy as np

from ceilvo.daemon.editing.picture import TYPES, class_of
from ceilvo.daemon.map.database.content import MapContent
from ceilvo.daemon.map.database.spatial import cells

_SQUARE_M = 1.0
"""Side of the squares that are counted for the area: those with a landmark."""


def statistics(content: MapContent) -> dict[str, Any]:
    """Figures of a map, for people and as JSON; those of a map without landmarks are 0."""
    m = content.landmarks
    kinds = class_of(m.crossing_type)
    low, high = (m.xy_map_m.min(axis=0), m.xy_map_m.max(axis=0)) if len(m) else (np.zeros(2), np.zeros(2))
    sigma = np.sqrt(np.maximum(np.linalg.eigvalsh(m.cov_m2)[:, 1], 0.0)) if len(m) else np.zeros(1)
    return {
        "floor": content.floor,
        "landmarks": len(m),
        "types": {name: int(np.sum(kinds == i)) for i, name in enumerate(TYPES) if np.any(kinds == i)},
        "x_m": [float(low[0]), float(high[0])],
        "y_m": [float(low[1]), float(high[1])],
        "area_m2": len(np.unique(cells(m.xy_map_m, _SQUARE_M))) * _SQUARE_M**2,
        "axis_deg": float(np.degrees(content.axis_rad)),
        "sigma_median_m": float(np.median(sigma)),
        "sigma_largest_m": float(np.max(sigma)),
        "sightings": int(m.sightings.sum()),
        "expected": int(m.expected.sum()),
        "first_seen_s": _least(content.seen_s[:, 0]),
        "last_seen_s": float(np.max(content.seen_s[:, 1], initial=0.0)),
        "key_poses": sum(map(len, content.key_poses)),
        "key_pose_features": content.features,
        "sessions": [asdict(s) for s in content.sessions],
    }


def _least(times_s: np.ndarray[Any, np.dtype[np.float64]]) -> float:
    """Of those that are known."""
    known = times_s[times_s > 0.0]
    return float(known.min()) if len(known) else 0.0
