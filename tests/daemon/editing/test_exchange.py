"""Exports: what is read back is what was written, GeoJSON has RFC 7946's shape, and damage is one clear line."""

from __future__ import annotations

import json
import random
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from map_contents import content, same_content, same_landmarks
from map_texts import edited

from ceilvo.daemon.editing import sources
from ceilvo.daemon.editing.exchange import to_geojson, to_json
from ceilvo.daemon.map.map_file import save_map
from ceilvo.errors import FileFormatError

SEED = 8


@given(
    st.integers(0, 60), st.integers(0, 10**6), st.text(st.characters(codec="utf-8", categories=["L", "N"]), max_size=9)
)
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None, max_examples=30)
def test_any_map_comes_back_from_json(tmp_path: Path, count: int, seed: int, floor: str) -> None:
    whole = content(count, seed, floor)
    (tmp_path / "map.json").write_text(to_json(whole))
    back = sources.read(tmp_path / "map.json")
    assert same_content(back, whole) and back.floor == floor


def test_landmarks_come_back_from_geojson(tmp_path: Path) -> None:
    whole = content(80, floor="2")
    (tmp_path / "map.geojson").write_text(to_geojson(whole))
    back = sources.read(tmp_path / "map.geojson")
    assert same_content(back, replace(whole, key_poses=(), sessions=())) and back.floor == "2"


def test_a_database_comes_back_from_every_export(tmp_path: Path) -> None:
    whole = content(80)
    sources.write(tmp_path / "map.db", whole, "begin")
    again = sources.read(tmp_path / "map.db")
    assert same_content(again, whole)
    save_map(tmp_path / "robot.json", again.landmarks, again.axis_rad)
    robot = sources.read(tmp_path / "robot.json")
    assert same_landmarks(robot.landmarks, whole.landmarks) and robot.axis_rad == whole.axis_rad


def test_geojson_is_of_the_shape_that_rfc_7946_asks_for() -> None:
    document = json.loads(to_geojson(content(20)))
    assert set(document) == {"type", "features"} and document["type"] == "FeatureCollection"
    unlocated = [f for f in document["features"] if f["geometry"] is None]
    assert len(unlocated) == 1 and "metres" in unlocated[0]["properties"]["note"]
    for feature in document["features"]:
        assert feature["type"] == "Feature" and set(feature) == {"type", "geometry", "properties"}
        assert isinstance(feature["properties"], dict)
        if feature["geometry"] is not None:
            assert set(feature["geometry"]) == {"type", "coordinates"} and feature["geometry"]["type"] == "Point"
            assert len(feature["geometry"]["coordinates"]) == 2
            assert all(type(v) is float for v in feature["geometry"]["coordinates"])
    kinds = [f["properties"]["what"] for f in document["features"]]
    assert (kinds.count("landmark"), kinds.count("key pose")) == (20, 30)


def test_properties_of_other_tools_do_not_matter(tmp_path: Path) -> None:
    document = json.loads(to_geojson(content(20)))
    document["crs"] = {"type": "name"}
    for i, feature in enumerate(document["features"]):
        feature["id"] = i
        feature["properties"]["fid"] = i
    document["features"].append({"type": "Feature", "geometry": None, "properties": {"colour": "red"}})
    (tmp_path / "g.json").write_text(json.dumps(document))
    assert same_landmarks(sources.read(tmp_path / "g.json").landmarks, content(20).landmarks)


def row(key: str, value: Any) -> Callable[[Any], Any]:
    return lambda d: d["content"]["landmarks"][1].__setitem__(key, value)


BAD: dict[str, tuple[Callable[[Any], Any], str]] = {
    "no list": (lambda d: d["content"].update(landmarks=3), "landmarks is 3, expected a list"),
    "a text": (row("x_m", "1"), "landmarks.xy_map_m is not an array of numbers"),
    "too far": (row("y_m", 1e9), "landmarks.xy_map_m has a value that is not finite or beyond"),
    "missing": (lambda d: d["content"]["landmarks"][0].pop("kind"), "landmarks[0]: missing keys ['kind']"),
    "same id": (
        lambda d: d["content"]["landmarks"].append(d["content"]["landmarks"][0]),
        "landmarks.id has duplicates",
    ),
    "no session": (
        lambda d: d["content"].update(sessions=[]),
        "key_poses are of 'hall-3/a', which is none of the sess",
    ),
    "backwards": (lambda d: d["content"]["key_poses"].reverse(), "key_poses.stamp_ns does not ascend"),
    "a floor of two lines": (lambda d: d["content"].update(floor="a\nb"), "floor is 'a\\nb', expected a text of one"),
    "a pose": (lambda d: d["content"]["key_poses"][0].update(pose=[1, 2]), "key_poses.pose is not an array"),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_json_is_one_clear_line(tmp_path: Path, name: str) -> None:
    change, said = BAD[name]
    path = tmp_path / "map.json"
    path.write_text(edited(to_json(content(5)), change))
    with pytest.raises(FileFormatError) as caught:
        sources.read(path)
    assert said in str(caught.value) and str(caught.value).startswith(f"{path}: ") and "\n" not in str(caught.value)


BAD_GEO: dict[str, tuple[Callable[[Any], Any], str]] = {
    "no features": (lambda d: d.pop("features"), "features is None, expected a list"),
    "no map": (lambda d: d["features"].pop(0), "features has 0 with the property what = map, expected 1"),
    "a line": (lambda d: d["features"][1]["geometry"].update(type="LineString"), "features[1].geometry is "),
    "no place": (
        lambda d: d["features"][1]["geometry"].update(coordinates=[1]),
        "coordinates is [1], expected x and y",
    ),
    "no id": (lambda d: d["features"][1]["properties"].pop("id"), "features[1].properties: missing id"),
    "no properties": (lambda d: d["features"][1].update(properties=None), "features[1] has no properties"),
}


@pytest.mark.parametrize("name", BAD_GEO)
def test_bad_geojson_is_one_clear_line(tmp_path: Path, name: str) -> None:
    change, said = BAD_GEO[name]
    document = json.loads(to_geojson(content(5)))
    change(document)
    path = tmp_path / "map.geojson"
    path.write_text(json.dumps(document))
    with pytest.raises(FileFormatError) as caught:
        sources.read(path)
    assert said in str(caught.value) and "\n" not in str(caught.value)


def test_bytes_changed_anywhere_in_an_export_are_noticed(tmp_path: Path) -> None:
    rng, whole, path = random.Random(SEED), content(20), tmp_path / "map.json"
    good = to_json(whole).encode()
    for n in range(150):
        spoilt = bytearray(good)
        spoilt[rng.randrange(len(spoilt))] ^= 1 << rng.randrange(8)
        path.write_bytes(spoilt)
        try:
            assert same_content(sources.read(path), whole), f"damage {n} (seed {SEED})"
        except FileFormatError as e:
            assert "\n" not in str(e)


@pytest.mark.parametrize("text", ["", "[1]", "hello", "{}", '{"type": "Feature"}', '{"format": "ceilvo-map-content"}'])
def test_what_is_no_map_is_one_clear_line(tmp_path: Path, text: str) -> None:
    (tmp_path / "x").write_text(text)
    with pytest.raises(FileFormatError, match=f"^{tmp_path / 'x'}: [^\n]+$"):
        sources.read(tmp_path / "x")
    with pytest.raises(FileFormatError, match="no such file, expected a database of maps"):
        sources.read(tmp_path / "nowhere")
