"""Maps of version 2, whose columns are packed: what is wrong with one is one clear line."""

from __future__ import annotations

import base64
import struct
from pathlib import Path

import numpy as np
import pytest
from map_texts import MAP_V2, edited, table

from ceilvo.daemon.map.map_file import load_map
from ceilvo.errors import FileFormatError


def test_version_2_files_load(tmp_path: Path) -> None:
    (tmp_path / "map").write_text(MAP_V2)
    stored = load_map(tmp_path / "map")
    assert stored is not None
    m = stored.landmarks
    assert (m.ids.tolist(), m.crossing_type.tolist()) == ([3, 8], [4, 0])
    assert (m.sightings.tolist(), m.expected.tolist()) == ([12, 3], [20, 3])
    assert m.xy_map_m.tolist() == [[1.5, -2.0], [0.1, 4.0]]
    assert m.cov_m2.tolist() == [[[0.0004, 0.0001], [0.0001, 0.0009]], [[0.01, 0.0], [0.0, 0.02]]]
    np.testing.assert_allclose(stored.landmarks.visibility, [13 / 22, 4 / 5])


def in_base64(kind: str, *numbers: float) -> str:
    return base64.b64encode(b"".join(struct.pack(kind, v) for v in numbers)).decode()


BAD: dict[str, tuple[str, str]] = {
    "version 2 as 1": (
        MAP_V2.replace('"version": 2', '"version": 1'),
        "landmarks: missing keys none, unknown keys ['exp",
    ),
    "fewer expected than seen": (
        edited(MAP_V2, table("expected", in_base64("<q", 20, 2))),
        "landmarks.expected[1] is 2, expected at least its sightings, 3",
    ),
    "list in version 2": (edited(MAP_V2, table("kind", [4, 0])), "landmarks.kind is [4, 0], expected numbers of 8 byt"),
    "no base64": (edited(MAP_V2, table("kind", "4, 0")), "landmarks.kind is not base64"),
    "half a number": (edited(MAP_V2, table("kind", "QUJD")), "landmarks.kind has 3 bytes, expected a multiple of 8"),
    "half a point": (
        edited(MAP_V2, table("xy_map_m", in_base64("<d", 0, 0, 1))),
        "24 bytes, expected a multiple of 16",
    ),
    "short column of 2": (edited(MAP_V2, table("kind", in_base64("<q", 4))), "landmarks.kind has 1 values, expected 2"),
    "short points of 2": (
        edited(MAP_V2, table("xy_map_m", in_base64("<d", 4, 0))),
        "landmarks.xy_map_m is not an array of numbers of shape (2, 2)",
    ),
    "kind 13 of 2": (
        edited(MAP_V2, table("kind", in_base64("<q", 4, 13))),
        "landmarks.kind is not a list of whole numbers from 0 to 12",
    ),
    "NaN of 2": (
        edited(MAP_V2, table("xy_map_m", in_base64("<d", 0, 0, 0, float("nan")))),
        "landmarks.xy_map_m has a value that is not finite",
    ),
    "same id of 2": (edited(MAP_V2, table("id", in_base64("<q", 3, 3))), "landmarks.id has duplicates"),
}


@pytest.mark.parametrize("name", BAD)
def test_a_bad_column_is_one_clear_line(tmp_path: Path, name: str) -> None:
    text, expected = BAD[name]
    path = tmp_path / "map"
    path.write_text(text)
    with pytest.raises(FileFormatError) as caught:
        load_map(path)
    message = str(caught.value)
    assert expected in message
    assert message.startswith(f"{path}: ")
    assert message.endswith("restore a backup, or go on with an earlier map or a new one")
    assert len(message) < 500
