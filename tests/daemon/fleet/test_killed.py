"""kill -9 of a map service at any moment: what was acknowledged counts, and counts once."""

from __future__ import annotations

import os
import random
from pathlib import Path

import curator_writer
from curator_writer import ROWS, VIEWS
from fleet_parts import mapd, survey, surveyed
from writers import killed

from ceilvo.bench.fleet.robots import key_of
from ceilvo.daemon.fleet.service.curator import Curator

KILLS = int(os.environ.get("KILLS", "6"))
"""`make kill-test` sets 200."""
SEED = 17
LONGEST_S = 0.15
"""From a word of the service to its end; chosen: some offers, a merge and a copy."""


def test_a_service_killed_at_random_moments_has_what_it_acknowledged_once(tmp_path: Path) -> None:
    path, rng, reached, pending = surveyed(tmp_path / "b.db", trusted=(0,)), random.Random(SEED), 0, 0
    before = int(survey().sightings.sum())
    for kill in range(KILLS):
        about = f"kill {kill} (seed {SEED})"
        reached = killed(curator_writer.write, path, rng.uniform(0.0, LONGEST_S), reached, about)
        curator = Curator(path, mapd())
        now = curator._ledger.keys()[key_of(0).public].seq
        stored = curator._floors[""].stored()
        assert now in (reached, reached + 1) and stored is not None, f"kill {kill}: {now} of {reached} (seed {SEED})"
        waiting = int(curator._ledger.claims("")["seen"].sum())
        counted = int(stored.landmarks.sightings.sum()) - before + waiting
        assert counted == now * ROWS * VIEWS, f"kill {kill}: {counted} sightings of {now} offers (seed {SEED})"
        pending += waiting > 0
        reached = now
        curator.close()
        assert not list(tmp_path.glob(".*.tmp")), f"kill {kill}: half a file was not swept away (seed {SEED})"
    print(f"\n{KILLS} kills, {reached} offers, none lost, none twice; {pending} times some waited for their merge")
    assert reached >= KILLS
