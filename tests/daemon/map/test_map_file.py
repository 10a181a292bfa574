"""Map and state files: what is written comes back, and whatever else is in the file is one clear error."""

from __future__ import annotations

import os
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from map_texts import MAP_V1, MAP_V2, STATE_V1, STATE_V2, STATE_V4, edited, table

from ceilvo.calibration import LEVEL_CEILING, CeilingShape
from ceilvo.daemon.map import map_file
from ceilvo.daemon.map.map_file import StoredMap, StoredState, load_map, load_state, save_map, save_state
from ceilvo.errors import FileFormatError
from ceilvo.types import Landmarks, State

SEED = 7


def landmarks(n: int, seed: int = SEED) -> Landmarks:
    rng = np.random.default_rng(seed)
    a = rng.normal(size=(n, 2, 2)) * 0.05
    sightings = rng.integers(1, 1000, n)
    return Landmarks(
        ids=rng.permutation(10 * n)[:n].astype(np.int64),
        xy_map_m=rng.normal(size=(n, 2)) * 3.0,
        cov_m2=a @ np.swapaxes(a, 1, 2),
        crossing_type=rng.integers(0, 9, n),
        sightings=sightings,
        expected=sightings + rng.integers(0, 100, n),
    )


def same(a: StoredMap, b: Landmarks, axis: float) -> bool:
    return (
        a.map_axis_rad == axis
        and np.array_equal(a.landmarks.ids, b.ids)
        and np.array_equal(a.landmarks.xy_map_m, b.xy_map_m)
        and np.array_equal(a.landmarks.cov_m2, b.cov_m2)
        and np.array_equal(a.landmarks.crossing_type, b.crossing_type)
        and np.array_equal(a.landmarks.sightings, b.sightings)
        and np.array_equal(a.landmarks.expected, b.expected)
    )


@pytest.mark.parametrize("n", [0, 1, 40])
def test_a_map_comes_back_bit_for_bit(tmp_path: Path, n: int) -> None:
    path, original = tmp_path / "map", landmarks(n)
    save_map(path, original, -0.3)
    stored = load_map(path)
    assert stored is not None
    assert same(stored, original, -0.3)
    assert stored.landmarks.cov_m2.shape == (n, 2, 2)
    assert stored.landmarks.ids.dtype == np.int64


@given(
    st.tuples(*[st.floats(-1e5, 1e5)] * 3),
    st.tuples(*[st.floats(0, 10)] * 3),
    st.sampled_from(State),
    st.integers(0, 2**60),
    st.floats(0.0, 1.0),
    st.lists(st.floats(-10.0, 10.0), max_size=12),
    st.just(()) | st.tuples(*[st.floats(-10.0, 10.0)] * 3),
)
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None, max_examples=50)
def test_a_state_comes_back_bit_for_bit(
    tmp_path: Path,
    pose: tuple[float, ...],
    sigma: tuple[float, ...],
    state: State,
    stamp_ns: int,
    elsewhere: float,
    drops_m: list[float],
    slope: tuple[float, ...],
) -> None:
    cov, ceiling = np.diag(np.square(sigma)), CeilingShape(tuple(drops_m), slope)
    save_state(tmp_path / "state", np.array(pose), cov, state, stamp_ns, elsewhere, ceiling=ceiling)
    stored = load_state(tmp_path / "state")
    assert stored is not None
    assert np.array_equal(stored.pose, pose)
    assert np.array_equal(stored.cov, cov)
    assert (stored.state, stored.stamp_ns, stored.elsewhere) == (state, stamp_ns, elsewhere)
    assert stored.ceiling == ceiling


def test_version_1_files_load(tmp_path: Path) -> None:
    (tmp_path / "map").write_text(MAP_V1)
    (tmp_path / "state").write_text(STATE_V1)
    stored, state = load_map(tmp_path / "map"), load_state(tmp_path / "state")
    assert stored is not None
    assert state is not None
    assert stored.landmarks.ids.tolist() == [3, 8]
    assert stored.landmarks.cov_m2[0].tolist() == [[0.0004, 0.0001], [0.0001, 0.0009]]
    assert (stored.map_axis_rad, stored.landmarks.crossing_type.tolist()) == (0.25, [4, 0])
    assert stored.landmarks.expected.tolist() == stored.landmarks.sightings.tolist() == [12, 3]
    assert state.pose.tolist() == [1.25, -0.5, 3.0]
    assert (state.state, state.stamp_ns, state.elsewhere) == (State.TRACKING, 123456789012345, 0.0)


def test_a_state_of_version_2_loads(tmp_path: Path) -> None:
    (tmp_path / "state").write_text(STATE_V2)
    state = load_state(tmp_path / "state")
    assert state is not None
    assert (state.state, state.stamp_ns, state.elsewhere) == (State.RELOCALISING, 123456789012345, 0.2)
    assert (state.frame, state.ceiling) == (None, LEVEL_CEILING)


def test_a_state_of_version_4_loads(tmp_path: Path) -> None:
    (tmp_path / "state").write_text(STATE_V4)
    state = load_state(tmp_path / "state")
    assert state is not None
    assert (state.frame, state.ceiling) == ("a frame", CeilingShape((0.4, -0.15)))


@pytest.mark.parametrize(
    ("named", "ceiling"),
    [
        ("drops_m", CeilingShape((1e9,))),
        ("drops_m", CeilingShape((float("nan"),))),
        ("drops_m", CeilingShape((1.0,) * 101)),
        ("slope", CeilingShape((), (0.1, 0.0))),
        ("slope", CeilingShape((), (0.1, 0.0, 1e9))),
    ],
)
def test_shapes_that_no_ceiling_has_are_not_written(tmp_path: Path, named: str, ceiling: CeilingShape) -> None:
    with pytest.raises(FileFormatError, match=named):
        save_state(tmp_path / "state", np.zeros(3), np.eye(3), State.TRACKING, 0, ceiling=ceiling)
    assert not (tmp_path / "state").exists()


def test_no_file_is_no_map(tmp_path: Path) -> None:
    assert load_map(tmp_path / "map") is None
    assert load_state(tmp_path / "nowhere" / "state") is None


BAD_MAPS: dict[str, tuple[str, str]] = {
    "empty": ("", "damaged or cut short"),
    "cut short": (MAP_V1[:200], "damaged or cut short"),
    "not JSON": ("hello", "damaged or cut short"),
    "a list": ("[1]", "not a ceilvo-map file"),
    "the state file": (STATE_V1, "not a ceilvo-map file"),
    "newer": (MAP_V1.replace('"version": 1', '"version": 3'), "version 3 was written by a newer ceilvo"),
    "older": (MAP_V1.replace('"version": 1', '"version": 0'), "version is 0, expected a whole number from 1 to 2"),
    "version 1 as 2": (MAP_V1.replace('"version": 1', '"version": 2'), "landmarks: missing keys ['expected']"),
    "version as text": (MAP_V1.replace('"version": 1', '"version": "1"'), "version is '1'"),
    "changed by hand": (MAP_V1.replace("1.5", "1.6"), "checksum does not match"),
    "NaN": (MAP_V1.replace("1.5", "NaN"), "NaN is not a number"),
    "nested": ("[" * 100_000, "damaged or cut short"),
    "endless number": (MAP_V1.replace("0.25", "9" * 10_000), "damaged or cut short"),
    "missing key": (edited(MAP_V1, lambda d: d["content"].pop("map_axis_rad")), "missing keys ['map_axis_rad']"),
    "unknown key": (edited(MAP_V1, lambda d: d["content"].update(colour=1)), "unknown keys ['colour']"),
    "short column": (edited(MAP_V1, table("kind", [4])), "landmarks.kind has 1 values, expected 2"),
    "kind 13": (
        edited(MAP_V1, table("kind", [4, 13])),
        "landmarks.kind is not a list of whole numbers from 0 to 12",
    ),
    "bool for number": (edited(MAP_V1, table("sightings", [True, 3])), "landmarks.sightings"),
    "same id": (edited(MAP_V1, table("id", [3, 3])), "landmarks.id has duplicates"),
    "too far": (edited(MAP_V1, table("xy_map_m", [[0, 0], [0, 1e9]])), "landmarks.xy_map_m has a value that"),
    "too large": (edited(MAP_V1, table("xy_map_m", [[0, 0], [0, 10**400]])), "landmarks.xy_map_m has a number"),
    "text": (edited(MAP_V1, table("xy_map_m", [["1", "2"], [0, 0]])), "landmarks.xy_map_m is not an array"),
    "no covariance": (edited(MAP_V1, table("cov_xx_xy_yy_m2", [[1, 2, 1], [1, 0, 1]])), "an eigenvalue is negative"),
}


@pytest.mark.parametrize("name", BAD_MAPS)
def test_a_bad_map_is_one_clear_line(tmp_path: Path, name: str) -> None:
    text, expected = BAD_MAPS[name]
    path = tmp_path / "map"
    path.write_text(text)
    with pytest.raises(FileFormatError) as caught:
        load_map(path)
    message = str(caught.value)
    assert expected in message
    assert message.startswith(f"{path}: ")
    assert message.endswith("restore a backup, or go on with an earlier map or a new one")
    assert "\n" not in message
    assert len(message) < 500


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (lambda c: c.update(state="HAPPY"), "state is 'HAPPY', expected one of INIT, TRACKING"),
        (lambda c: c.update(cov=[[1, 0, 0], [0, 1, 0]]), "cov is not an array of numbers of shape (3, 3)"),
        (lambda c: c.update(cov=[[1, 0, 0], [1, 1, 0], [0, 0, 1]]), "cov is not symmetric"),
        (lambda c: c.update(stamp_ns=1.5), "stamp_ns is not a list of whole numbers"),
        (lambda c: c["pose_map_from_base"].update(x_m=None), "pose_map_from_base is not an array"),
        (lambda c: c.update(elsewhere=-0.1), "elsewhere is -0.1, expected a probability"),
        (lambda c: c.update(elsewhere=1.5), "elsewhere has a value that is not finite or beyond 1"),
        (lambda c: c.pop("elsewhere"), "content: missing keys ['elsewhere']"),
    ],
    ids=["state", "shape", "asymmetric", "stamp", "null", "negative", "above 1", "missing"],
)
def test_a_bad_state_is_one_clear_line(tmp_path: Path, change: Callable[[Any], Any], expected: str) -> None:
    path = tmp_path / "state"
    path.write_text(edited(STATE_V2, lambda d: change(d["content"])))
    with pytest.raises(FileFormatError, match=re.escape(expected)):
        load_state(path)


def test_a_file_beyond_the_limit_is_not_read(tmp_path: Path) -> None:
    path = tmp_path / "state"
    path.write_bytes(b" " * (map_file.MAX_STATE_BYTES + 1))
    with pytest.raises(FileFormatError, match="longer than the largest allowed 65536 bytes"):
        load_state(path)


@given(st.data(), st.sampled_from([MAP_V1, MAP_V2]))
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None, max_examples=400)
def test_mutated_bytes_give_the_same_map_or_an_error(tmp_path: Path, data: st.DataObject, text: str) -> None:
    """Flipped, cut and inserted bytes: never another map, never another exception."""
    raw = bytearray(text.encode())
    for _ in range(data.draw(st.integers(1, 4))):
        at = data.draw(st.integers(0, len(raw) - 1))
        how = data.draw(st.sampled_from(["flip", "set", "insert", "cut", "drop"]))
        if how == "flip":
            raw[at] ^= 1 << data.draw(st.integers(0, 7))
        elif how == "set":
            raw[at] = data.draw(st.integers(0, 255))
        elif how == "insert":
            raw[at:at] = data.draw(st.binary(min_size=1, max_size=8))
        elif how == "drop":
            del raw[at : at + data.draw(st.integers(1, 30))]
        else:
            del raw[at:]
        raw = raw or bytearray(b"\n")
    path = tmp_path / "map"
    path.write_text(text)
    original = load_map(path)
    assert original is not None
    path.write_bytes(raw)
    try:
        stored = load_map(path)
    except FileFormatError as e:
        assert "\n" not in str(e)
    else:
        assert stored is not None
        assert same(stored, original.landmarks, original.map_axis_rad)


json_values: st.SearchStrategy[Any] = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False, allow_infinity=False) | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=5), inner, max_size=4),
    max_leaves=8,
)


@given(
    st.sampled_from(["id", "xy_map_m", "cov_xx_xy_yy_m2", "kind", "sightings", "expected", ""]),
    json_values,
    st.sampled_from([MAP_V1, MAP_V2]),
)
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None, max_examples=200)
def test_any_signed_content_is_a_map_or_an_error(tmp_path: Path, key: str, value: Any, text: str) -> None:
    """A right checksum over wrong content gets past the first check, not past the second."""
    path = tmp_path / "map"
    path.write_text(edited(text, table(key, value) if key else lambda d: d.__setitem__("content", value)))
    try:
        stored = load_map(path)
    except FileFormatError as e:
        assert "\n" not in str(e)
    else:
        assert isinstance(stored, StoredMap)
        assert stored.landmarks.xy_map_m.shape == (len(stored.landmarks), 2)


@pytest.mark.parametrize(
    ("pose", "cov"),
    [([0.0, np.nan, 0.0], np.eye(3)), ([0.0, 0.0, 0.0], np.full((3, 3), np.inf)), ([0.0, 0.0, 0.0], -np.eye(3))],
    ids=["nan pose", "infinite covariance", "negative covariance"],
)
def test_nonsense_is_not_saved_and_the_old_file_stays(tmp_path: Path, pose: list[float], cov: Any) -> None:
    path = tmp_path / "state"
    save_state(path, np.zeros(3), np.eye(3), State.TRACKING, 1)
    before = path.read_bytes()
    with pytest.raises(FileFormatError, match="not written, the old file stays"):
        save_state(path, np.array(pose), cov, State.TRACKING, 2)
    assert path.read_bytes() == before


def test_a_missing_folder_is_a_clear_error(tmp_path: Path) -> None:
    with pytest.raises(FileFormatError, match=r"cannot be written: No such file.*service\.state_dir"):
        save_state(tmp_path / "nowhere" / "state", np.zeros(3), np.eye(3), State.TRACKING, 1)


def test_a_failed_write_leaves_the_old_map(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As on a read-only or full disk; root may write anywhere, so the system call is made to fail."""
    path = tmp_path / "map"
    save_map(path, landmarks(3), 0.0)
    before = path.read_bytes()

    def full(_fd: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("ceilvo.files.os.fsync", full)
    with pytest.raises(FileFormatError, match="No space left on device"):
        save_map(path, landmarks(4), 0.0)
    assert path.read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == ["map"]


def test_a_folder_in_place_of_the_file_is_a_clear_error(tmp_path: Path) -> None:
    (tmp_path / "map").mkdir()
    with pytest.raises(FileFormatError, match="a folder, a pipe or a device, expected a file"):
        load_map(tmp_path / "map")


def test_a_link_to_nothing_and_a_pipe_are_clear_errors(tmp_path: Path) -> None:
    """The one was no map, silently; the other was waited for, for ever."""
    (tmp_path / "map").symlink_to(tmp_path / "nothing")
    with pytest.raises(FileFormatError, match=r"map: a link to .*nothing, which is not there; restore"):
        load_map(tmp_path / "map")
    (tmp_path / "map").unlink()
    os.mkfifo(tmp_path / "map")
    with pytest.raises(FileFormatError, match="map: a folder, a pipe or a device, expected a file"):
        load_map(tmp_path / "map")


def test_a_large_map_stays_within_the_limit(tmp_path: Path) -> None:
    path = tmp_path / "map"
    save_map(path, landmarks(2000), 0.0)
    assert path.stat().st_size * 1000 < map_file.MAX_MAP_BYTES  # the configuration allows 2000000 landmarks
    stored = load_map(path)
    assert stored is not None
    assert len(stored.landmarks) == 2000


def test_a_stored_state_is_plain_data(tmp_path: Path) -> None:
    """Arrays are read-only, so that a hypothesis cannot be edited into a truth by accident."""
    save_state(tmp_path / "state", np.zeros(3), np.eye(3), State.LOST, 5)
    stored = load_state(tmp_path / "state")
    assert isinstance(stored, StoredState)
    with pytest.raises(ValueError, match="read-only"):
        stored.pose[0] = 1.0
