"""What a database of maps does on a small disk; run inside of its namespace."""

from __future__ import annotations

import errno
import logging
import sys
from pathlib import Path

import kept_maps
import map_writer
from map_contents import landmarks, same_landmarks

from ceilvo.daemon.map.database import schema
from ceilvo.daemon.map.database.copies import copy_of, keep_copy, open_map
from ceilvo.daemon.map.kept.store import MAP_NAME, Store
from ceilvo.drivers.host.ownership import owner_of_folder
from ceilvo.errors import FileFormatError


def full(folder: Path) -> None:
    path, filler = folder / "map.db", folder / "filler"
    with open_map(path, create=True) as db:
        db.save(landmarks(300), 0.25)
        keep_copy(db)
        copy = copy_of(path).read_bytes()
        _fill(filler)
        held = 300
        for _ in range(3):
            try:
                while True:
                    db.save(landmarks(held + 1), 0.25)
                    held += 1
            except FileFormatError as e:
                print(e)
        try:
            keep_copy(db)
        except FileFormatError as e:
            print(e)
        assert copy_of(path).read_bytes() == copy
        assert same_landmarks(db.content().landmarks, landmarks(held))
        filler.unlink()
        db.save(landmarks(700), 0.25)
    with open_map(path) as db:
        assert same_landmarks(db.content().landmarks, landmarks(700))
    assert sorted(p.name for p in folder.iterdir()) == ["map.db", "map.db.good"]


def _fill(filler: Path) -> None:
    with filler.open("ab", buffering=0) as f:
        for size in (65536, 1):
            try:
                while f.write(bytes(size)):
                    pass
            except OSError as e:
                assert e.errno == errno.ENOSPC


def read_only(folder: Path) -> None:
    with open_map(folder / "map.db") as db:
        assert same_landmarks(db.content().landmarks, landmarks(700))
        try:
            db.save(landmarks(701), 0.25)
        except FileFormatError as e:
            print(e)
    try:
        open_map(folder / "other.db", create=True)
    except FileFormatError as e:
        print(e)


def count(folder: Path) -> None:
    """Landmarks of a robot's map."""
    print(kept_maps.count(folder / MAP_NAME))


def places(folder: Path) -> None:
    """Where landmarks of a robot's map lie, m, one a line."""
    stored = kept_maps.load_database(folder / MAP_NAME)
    for x, y in [] if stored is None else stored.landmarks.xy_map_m:
        print(x, y)


def start_when_full(folder: Path) -> None:
    """A robot that starts on a disk without a byte to spare, and saves once there is room."""
    logging.basicConfig(format="%(levelname)s %(message)s", stream=sys.stdout)
    schema.BUSY_S = 0.2  # SQLite waits so long for each lock that it has no room for
    before = Store(folder)
    assert before.save(map_writer.landmarks(300), 0.25, map_writer.estimate(1))
    before.close()
    filler = folder / "filler"
    _fill(filler)
    with owner_of_folder(folder):
        store = Store(folder)
        found = store.load()
        assert found is not None and len(found.map.landmarks) == 300 and found.state is not None
        for n in range(3):
            assert not store.save(map_writer.landmarks(301), 0.25, map_writer.estimate(2 + n))
        filler.unlink()
        assert store.save(map_writer.landmarks(301), 0.25, map_writer.estimate(5)), store.error
        store.close()
    count(folder)


if __name__ == "__main__":
    do = {"full": full, "read-only": read_only, "places": places, "start when full": start_when_full}[sys.argv[1]]
    do(Path(sys.argv[2]))
