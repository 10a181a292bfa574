"""Map and state files as they were once written, and ways to spoil them."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from typing import Any

# Files as versions 1 and 2 wrote them; they must load for as long as those versions are supported.
MAP_V1 = (
    '{"format": "ceilvo-map", "version": 1, "sha256": '
    '"546255ca890883bd371800c4e6ff4e739b983e8c18568988f55be0da34504165", "content": {"map_axis_rad": 0.25, '
    '"landmarks": {"id": [3, 8], "xy_map_m": [[1.5, -2.0], [0.1, 4.0]], '
    '"cov_xx_xy_yy_m2": [[0.0004, 0.0001, 0.0009], [0.01, 0.0, 0.02]], "kind": [4, 0], "sightings": [12, 3]}}}\n'
)
MAP_V2 = (
    '{"format": "ceilvo-map", "version": 2, "sha256": '
    '"a31f8162e0250c8da52978254654373b8209f0b59519a0e459b392d93a8cf61a", "content": {"map_axis_rad": 0.25, '
    '"landmarks": {"id": "AwAAAAAAAAAIAAAAAAAAAA==", "xy_map_m": "AAAAAAAA+D8AAAAAAAAAwJqZmZmZmbk/AAAAAAAAEEA=", '
    '"cov_xx_xy_yy_m2": "LUMc6+I2Oj8tQxzr4jYaP5LLf0i/fU0/exSuR+F6hD8AAAAAAAAAAHsUrkfhepQ/", '
    '"kind": "BAAAAAAAAAAAAAAAAAAAAA==", "sightings": "DAAAAAAAAAADAAAAAAAAAA==", '
    '"expected": "FAAAAAAAAAADAAAAAAAAAA=="}}}\n'
)
STATE_V1 = (
    '{"format": "ceilvo-state", "version": 1, "sha256": '
    '"1edde77ea6e1eb1fe532f61bfa4a2f83fdea66cb50ed95e0169876dfbc97ae8a", "content": {"pose_map_from_base": '
    '{"x_m": 1.25, "y_m": -0.5, "theta_rad": 3.0}, "cov": [[0.01, 0.0, 0.0], [0.0, 0.02, 0.001], [0.0, 0.001, 0.003]], '
    '"state": "TRACKING", "stamp_ns": 123456789012345}}\n'
)
STATE_V2 = (
    '{"format": "ceilvo-state", "version": 2, "sha256": '
    '"e35f00cd08d7e4e23f71ddbf0ff33b56fbb4f082e50f486b312991b18fcd2552", "content": {"pose_map_from_base": '
    '{"x_m": 1.25, "y_m": -0.5, "theta_rad": 3.0}, "cov": [[0.01, 0.0, 0.0], [0.0, 0.02, 0.001], [0.0, 0.001, 0.003]], '
    '"state": "RELOCALISING", "stamp_ns": 123456789012345, "elsewhere": 0.2}}\n'
)
STATE_V4 = (
    '{"format": "ceilvo-state", "version": 4, "sha256": '
    '"2dff33f528fd23dfc5ca80f816c1f8b49aef9f9f234765a6857586461f116f30", "content": {"pose_map_from_base": '
    '{"x_m": 1.25, "y_m": -0.5, "theta_rad": 3.0}, '
    '"cov": [[0.0001, 0.0, 0.0], [0.0, 0.0004, 0.0], [0.0, 0.0, 0.0009]], '
    '"state": "TRACKING", "stamp_ns": 123456789012345, "elsewhere": 0.2, "frame": "a frame", '
    '"drops_m": [0.4, -0.15]}}\n'
)


def signed(document: dict[str, Any]) -> str:
    """A document with the checksum that its content calls for."""
    text = json.dumps(document["content"], sort_keys=True, separators=(",", ":"))
    return json.dumps({**document, "sha256": hashlib.sha256(text.encode()).hexdigest()})


def edited(text: str, change: Callable[[dict[str, Any]], Any]) -> str:
    document: dict[str, Any] = json.loads(text)
    change(document)
    return signed(document)


def table(key: str, value: Any) -> Callable[[dict[str, Any]], Any]:
    return lambda d: d["content"]["landmarks"].__setitem__(key, value)
