"""What an earlier run left in the state directory, which decides where the robot believes that it is."""

from __future__ import annotations

import fcntl
import json
import shutil
from typing import Any

import numpy as np

from ceilvo.bench.fuzz.engine.bounds import LINE_CHARS
from ceilvo.bench.fuzz.engine.mutations import mutated_json
from ceilvo.bench.fuzz.engine.target import PERIOD_NS, Target, crossings, file, folder, json_of, pipeline, wheels
from ceilvo.daemon.app.estimator import Estimator
from ceilvo.daemon.map.document import digest
from ceilvo.daemon.map.kept.store import Store
from ceilvo.daemon.map.map_file import load_map, load_state, save_map, save_state
from ceilvo.daemon.replay.inputs import Sighting, apply
from ceilvo.drivers.host.ownership import LOCK_NAME, owner_of_folder
from ceilvo.errors import CeilvoError
from ceilvo.types import Landmarks, State

_STEPS = 3
"""Views of the ceiling that a pipeline has after it took the stored map."""


def _map(data: bytes) -> None:
    load_map(file("map.json", _signed(data)))


def _state(data: bytes) -> None:
    load_state(file("state.json", _signed(data)))


def _state_dir(data: bytes) -> None:
    """File names with their content, into a daemon that then drives on and saves."""
    shutil.rmtree(folder() / "state", ignore_errors=True)
    for name, content in _files(data).items():
        file(f"state/{name}", _signed(json.dumps(content).encode("utf-8", "surrogatepass")))
    store = Store(folder() / "state", 3)
    kept = store.load()
    if kept is None:
        store.close()
        return
    driven = pipeline()
    estimator = Estimator(driven, lambda: 0)
    estimator.load_map(kept.map, kept.state)
    for k in range(_STEPS):
        estimate = apply(driven, Sighting((k + 1) * PERIOD_NS, crossings(k), wheels()))
    assert estimate is not None
    store.save(*estimator.map(), estimate)
    store.close()


def _files(data: bytes) -> dict[str, Any]:
    found = json_of(data)
    allowed = ("map.json", "map.json.1", "map.json.2", "state.json")
    return {n: found[n] for n in allowed if n in found} if isinstance(found, dict) else {}


def _owner(data: bytes) -> None:
    """A folder that somebody holds, whose file should say who."""
    path = file(f"held/{LOCK_NAME}", data)
    with path.open("rb") as held:
        fcntl.flock(held, fcntl.LOCK_EX)
        try:
            with owner_of_folder(path.parent):
                raise AssertionError("held twice")
        except CeilvoError as e:
            if len(str(e)) > LINE_CHARS or not str(e).isprintable():
                raise AssertionError(f"nobody can read {e!r}") from e


def _signed(data: bytes) -> bytes:
    """With the checksum that belongs to the content, where there is one to be had."""
    try:
        document = json.loads(data)
        document["sha256"] = digest(document["content"])
        return json.dumps(document).encode("utf-8", "surrogatepass")
    except Exception:
        return data


def _maps() -> tuple[bytes, ...]:
    path, driven = folder() / "seed-map.json", pipeline()
    for k in range(6):
        apply(driven, Sighting((k + 1) * PERIOD_NS, crossings(k), wheels()))
    save_map(path, driven.filter.landmarks(), 0.25)
    n = 3
    cov = np.tile(0.01 * np.eye(2), (n, 1, 1))
    small = folder() / "seed-small.json"
    save_map(small, Landmarks(np.arange(n), np.ones((n, 2)), cov, np.full(n, 4), np.full(n, 3)), 0.25)
    older = {
        "map_axis_rad": 0.1,
        "landmarks": {
            **{"id": [4], "xy_map_m": [[1.0, 2.0]], "cov_xx_xy_yy_m2": [[0.01, 0.0, 0.01]]},
            **{"kind": [4], "sightings": [2]},
        },
    }
    v1 = {"format": "ceilvo-map", "version": 1, "sha256": "", "content": older}
    return path.read_bytes(), small.read_bytes(), _signed(json.dumps(v1).encode())


def _states() -> tuple[bytes, ...]:
    path = folder() / "seed-state.json"
    save_state(path, np.array([1.0, 2.0, 0.5]), 0.01 * np.eye(3), State.TRACKING, 1)
    return (path.read_bytes(),)


def _state_dirs() -> tuple[bytes, ...]:
    first, small, older = (json.loads(m) for m in _maps())
    state = json.loads(_states()[0])
    return tuple(
        json.dumps(files).encode()
        for files in (
            {"map.json": first, "state.json": state},
            {"map.json": {}, "map.json.1": small, "state.json": state},
            {"map.json": older},
        )
    )


TARGETS = {
    "map": Target(_map, _maps, mutated_json),
    "state": Target(_state, _states, mutated_json),
    "state_dir": Target(_state_dir, _state_dirs, mutated_json),
    "owner": Target(_owner, lambda: (b"1\n", b"812 ceilvod\n")),
}
