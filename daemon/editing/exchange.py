"""Maps for people and other tools: JSON with everything, GeoJSON with landmarks; both can be read back."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import asdict
from typing import Any

import numpy as np

from ceilvo.daemon.map.checks import Damage, floats, ints, keys, landmarks_of, shown
from ceilvo.daemon.map.database.content import MapContent, Session
from ceilvo.daemon.map.database.key_pose_rows import rows_of_key_poses
from ceilvo.daemon.map.database.rows import LATEST_S
from ceilvo.daemon.map.document import document_of
from ceilvo.daemon.map.key_poses import KeyPoses
from ceilvo.daemon.map.transitions import Side
from ceilvo.json_values import MAX_ANGLE_RAD, MAX_ID, json_value
from ceilvo.types import Array, Landmarks

FORMAT, VERSION = "ceilvo-map-content", 1
"""Of the JSON."""
NOTE = "coordinates are metres in the map's own frame, x and y, not longitude and latitude"
_MAP, _LANDMARK, _KEY_POSE = "map", "landmark", "key pose"
"""What a feature of the GeoJSON is."""
_NUMBERS = ("cov_xx_m2", "cov_xy_m2", "cov_yy_m2", "first_seen_s", "last_seen_s")
_COUNTS = ("id", "kind", "sightings", "expected")
_PLACE = ("x_m", "y_m")
_COUNT_KEYS = {"added", "faded", "refused"}
"""Of a session; older exports lack them."""
_POSE_KEYS = {"session", "stamp_ns", "pose", "motion", "motion_cov", "direction_rad", "direction_sigma_rad", "view"}
_FEATURE_KEYS = {"x_m", "y_m", *_NUMBERS[:3], "kind", "landmark"}
_SESSION_KEYS = {"name", "begun_s", "last_s", "saves"}


def to_json(content: MapContent) -> str:
    """One line of JSON with a checksum."""
    return document_of(FORMAT, VERSION, _body(content))


def from_json(body: Any, version: int) -> MapContent:
    """From what is in the envelope.

    Raises:
        Damage: a value that no map may have; names it.
    """
    own = {"floor", "map_axis_rad", "landmarks", "sessions", "key_poses"}
    keys(body, own | ({"transitions"} & body.keys() if isinstance(body, dict) else set()), "content")
    landmarks, seen_s = _landmarks(_list(body["landmarks"], "landmarks"))
    sessions = tuple(_session(s) for s in _list(body["sessions"], "sessions"))
    key_poses = tuple(_key_poses(_list(body["key_poses"], "key_poses")))
    if unknown := {k.session for k in key_poses} - {s.name for s in sessions}:
        raise Damage(f"key_poses are of {shown(min(unknown))}, which is none of the sessions")
    axis = float(floats(body["map_axis_rad"], "map_axis_rad", (), MAX_ANGLE_RAD))
    sides = tuple(_side(s) for s in _list(body.get("transitions", []), "transitions"))
    return MapContent(landmarks, seen_s, axis, key_poses, sessions, _text(body["floor"], "floor"), sides)


def to_geojson(content: MapContent) -> str:
    """A FeatureCollection (RFC 7946): landmarks, where key poses were, and the map itself, without a place."""
    said = {"what": _MAP, "note": NOTE, "floor": content.floor, "map_axis_rad": content.axis_rad}
    features = [{"type": "Feature", "geometry": None, "properties": said}]
    for row in _table(content):
        place = [row.pop(name) for name in _PLACE]
        features.append(_point(place, {"what": _LANDMARK, **row}))
    for k in content.key_poses:
        for stamp_ns, (x, y, theta) in zip(k.stamp_ns.tolist(), k.pose.tolist(), strict=True):
            said = {"what": _KEY_POSE, "session": k.session, "stamp_ns": stamp_ns, "theta_rad": theta}
            features.append(_point([x, y], said))
    return json.dumps({"type": "FeatureCollection", "features": features}, allow_nan=False) + "\n"


def from_geojson(document: Any) -> MapContent:
    """Landmarks and axis; key poses stay behind, for their views are not in it. Other tools' properties do not matter.

    Raises:
        Damage: a value that no map may have; names it.
    """
    said: list[dict[str, Any]] = []
    rows: list[dict[str, Any]] = []
    for i, feature in enumerate(_list(document.get("features"), "features")):
        properties = feature.get("properties") if isinstance(feature, dict) else None
        if not isinstance(properties, dict):
            raise Damage(f"features[{i}] has no properties")
        if properties.get("what") == _MAP:
            said.append(properties)
        elif properties.get("what") == _LANDMARK:
            rows.append(_row(properties, feature.get("geometry"), f"features[{i}]"))
    if len(said) != 1:
        raise Damage(f"features has {len(said)} with the property what = {_MAP}, expected 1 with the map_axis_rad")
    landmarks, seen_s = _landmarks(rows)
    axis = float(floats(said[0].get("map_axis_rad"), "map_axis_rad", (), MAX_ANGLE_RAD))
    return MapContent(landmarks, seen_s, axis, floor=_text(said[0].get("floor"), "floor"))


def _row(properties: dict[str, Any], geometry: Any, where: str) -> dict[str, Any]:
    if not isinstance(geometry, dict) or geometry.get("type") != "Point":
        raise Damage(f"{where}.geometry is {shown(geometry)}, expected a Point")
    place = geometry.get("coordinates")
    if not isinstance(place, list) or len(place) < 2:
        raise Damage(f"{where}.geometry.coordinates is {shown(place)}, expected x and y in m")
    missing = sorted({*_NUMBERS, *_COUNTS} - properties.keys())
    if missing:
        raise Damage(f"{where}.properties: missing {', '.join(missing)}")
    return {**{k: properties[k] for k in (*_NUMBERS, *_COUNTS)}, **dict(zip(_PLACE, place, strict=False))}


def _point(place: list[float], properties: dict[str, Any]) -> dict[str, Any]:
    return {"type": "Feature", "geometry": {"type": "Point", "coordinates": place}, "properties": properties}


def _body(content: MapContent) -> dict[str, Any]:
    return {
        "floor": content.floor,
        "map_axis_rad": float(content.axis_rad),
        "landmarks": list(_table(content)),
        "sessions": [asdict(s) for s in content.sessions],
        "transitions": [asdict(s) for s in content.sides],
        "key_poses": [pose for k in content.key_poses for pose in _poses(k)],
    }


def _table(content: MapContent) -> Iterator[dict[str, Any]]:
    m = content.landmarks
    columns = {
        "id": m.ids,
        "kind": m.crossing_type,
        "x_m": m.xy_map_m[:, 0],
        "y_m": m.xy_map_m[:, 1],
        "cov_xx_m2": m.cov_m2[:, 0, 0],
        "cov_xy_m2": m.cov_m2[:, 0, 1],
        "cov_yy_m2": m.cov_m2[:, 1, 1],
        "sightings": m.sightings,
        "expected": m.expected,
        "first_seen_s": content.seen_s[:, 0],
        "last_seen_s": content.seen_s[:, 1],
    }
    for row in zip(*(c.tolist() for c in columns.values()), strict=True):
        yield dict(zip(columns, row, strict=True))


def _landmarks(rows: list[Any]) -> tuple[Landmarks, Array]:
    wanted = {*_NUMBERS, *_COUNTS, *_PLACE}
    for i, row in enumerate(rows):
        keys(row, wanted, f"landmarks[{i}]")
    table: dict[str, Any] = {name: [row[name] for row in rows] for name in _COUNTS}
    table["xy_map_m"] = [[row[name] for name in _PLACE] for row in rows]
    table["cov_xx_xy_yy_m2"] = [[row[name] for name in _NUMBERS[:3]] for row in rows]
    landmarks = landmarks_of(table)
    times = [[row["first_seen_s"], row["last_seen_s"]] for row in rows]
    seen_s = floats(times, "landmarks.first_seen_s, last_seen_s", (len(rows), 2), LATEST_S)
    order = np.argsort(landmarks.ids, kind="stable")
    return landmarks.of(order), seen_s[order]


def _side(value: Any) -> Side:
    keys(value, {"name", "kind", "x_m", "y_m", "theta_rad"}, "transitions")
    pose = floats([value[k] for k in ("x_m", "y_m", "theta_rad")], "transitions.x_m, y_m, theta_rad", (3,), MAX_ID)
    return Side.at(_text(value["name"], "transitions.name"), _text(value["kind"], "transitions.kind"), pose)


def _session(value: Any) -> Session:
    keys(value, _SESSION_KEYS | (_COUNT_KEYS if _COUNT_KEYS & value.keys() else set()), "sessions")
    begun_s, last_s = floats([value["begun_s"], value["last_s"]], "sessions.begun_s, last_s", (2,), LATEST_S).tolist()
    counts = {k: int(ints([value.get(k, 0)], f"sessions.{k}", 0, MAX_ID)[0]) for k in ("saves", *_COUNT_KEYS)}
    return Session(_text(value["name"], "sessions.name"), begun_s, last_s, **counts)


def _poses(k: KeyPoses) -> Iterator[dict[str, Any]]:
    start = np.searchsorted(k.view, np.arange(len(k) + 1))
    xy, cov = k.xy_base_m.tolist(), k.cov_base_m2.tolist()
    kind, landmark = k.crossing_type.tolist(), k.landmark.tolist()
    for i in range(len(k)):
        yield {
            "session": k.session,
            "stamp_ns": int(k.stamp_ns[i]),
            "pose": k.pose[i].tolist(),
            "motion": k.motion[i].tolist(),
            "motion_cov": json_value(k.motion_cov[i]),  # null: nothing is known
            "direction_rad": float(k.direction_rad[i]),
            "direction_sigma_rad": float(k.direction_sigma_rad[i]),
            "view": [
                {
                    "x_m": xy[o][0],
                    "y_m": xy[o][1],
                    "cov_xx_m2": cov[o][0][0],
                    "cov_xy_m2": cov[o][0][1],
                    "cov_yy_m2": cov[o][1][1],
                    "kind": kind[o],
                    "landmark": landmark[o],
                }
                for o in range(start[i], start[i + 1])
            ],
        }


def _key_poses(rows: list[Any]) -> Iterator[KeyPoses]:
    """Row by row, and a session at a time."""
    sessions: dict[str, list[dict[str, Any]]] = {}
    for i, row in enumerate(rows):
        keys(row, _POSE_KEYS, f"key_poses[{i}]")
        for feature in _list(row["view"], f"key_poses[{i}].view"):
            keys(feature, _FEATURE_KEYS, f"key_poses[{i}].view")
        sessions.setdefault(_text(row["session"], "key_poses.session"), []).append(row)
    for name, poses in sessions.items():
        k = _one_session(name, poses)
        rows_of_key_poses(k)  # checks it
        yield k


def _one_session(name: str, poses: list[dict[str, Any]]) -> KeyPoses:
    n = len(poses)
    features = [(i, f) for i, pose in enumerate(poses) for f in pose["view"]]
    o = len(features)
    limit = float("inf")
    unknown = [_unknown(pose["motion_cov"]) for pose in poses]
    packed = floats([[f[c] for c in _NUMBERS[:3]] for _, f in features], "key_poses.view.cov", (o, 3), limit)
    return KeyPoses(
        session=name,
        stamp_ns=ints([p["stamp_ns"] for p in poses], "key_poses.stamp_ns", 0, MAX_ID),
        pose=floats([p["pose"] for p in poses], "key_poses.pose", (n, 3), limit),
        motion=floats([p["motion"] for p in poses], "key_poses.motion", (n, 3), limit),
        motion_cov=floats(unknown, "key_poses.motion_cov", (n, 3, 3), limit),
        direction_rad=floats([p["direction_rad"] for p in poses], "key_poses.direction_rad", (n,), limit),
        direction_sigma_rad=floats(
            [p["direction_sigma_rad"] for p in poses], "key_poses.direction_sigma_rad", (n,), limit
        ),
        view=np.array([i for i, _ in features], np.int64),
        xy_base_m=floats([[f[c] for c in _PLACE] for _, f in features], "key_poses.view.x_m, y_m", (o, 2), limit),
        cov_base_m2=packed[:, [0, 1, 1, 2]].reshape(-1, 2, 2),
        crossing_type=ints([f["kind"] for _, f in features], "key_poses.view.kind", 0, MAX_ID),
        landmark=ints([f["landmark"] for _, f in features], "key_poses.view.landmark", -1, MAX_ID),
    )


def _unknown(value: Any) -> Any:
    """A matrix with infinity where it says null."""
    if isinstance(value, list):
        return [_unknown(v) for v in value]
    return float("inf") if value is None else value


def _list(value: Any, where: str) -> list[Any]:
    if not isinstance(value, list):
        raise Damage(f"{where} is {shown(value)}, expected a list")
    return value


def _text(value: Any, where: str) -> str:
    if not isinstance(value, str) or not value.isprintable():
        raise Damage(f"{where} is {shown(value)}, expected a text of one line")
    return value
