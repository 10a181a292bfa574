"""What a database of maps does on a small disk; run inside of its namespace."""

from __future__ import annotations

import errno
import sys
from pathlib import Path

from map_contents import landmarks, same_landmarks

from ceilvo.daemon.map.database.copies import copy_of, keep_copy, open_map
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


if __name__ == "__main__":
    {"full": full, "read-only": read_only}[sys.argv[1]](Path(sys.argv[2]))
