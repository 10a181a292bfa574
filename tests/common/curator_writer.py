"""A map service without a bus that takes offers as fast as it can, to be killed."""

from __future__ import annotations

from multiprocessing.connection import Connection
from pathlib import Path

from fleet_parts import mapd, offer, rows_of, survey, told

from ceilvo.bench.fleet.robots import key_of
from ceilvo.daemon.fleet.replies import Reply
from ceilvo.daemon.fleet.service.curator import Curator

ROWS, VIEWS = 40, 10
"""Of an offer, the same landmarks each time."""


def write(path: Path, to: Connection) -> None:
    """Tells the number of each offer that was acknowledged; the first word is where the ledger was."""
    curator = Curator(path, mapd())
    seq = curator._ledger.keys()[key_of(0).public].seq
    to.send(seq)
    rows = rows_of(survey().of(range(ROWS)), views=VIEWS)
    while True:
        seq += 1
        assert isinstance(told(curator, offer(rows, seq=seq)), Reply)
        to.send(seq)
        if seq % 2:
            curator.tick()
        if seq % 7 == 0:
            curator._copy()
