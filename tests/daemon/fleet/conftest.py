"""A service on a survey, and robots that ask it."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from fleet_parts import DirectLink, Site, mapd, surveyed

from ceilvo.daemon.fleet.service.curator import Curator


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return surveyed(tmp_path / "b.db", trusted=(3,))


@pytest.fixture
def curator(path: Path) -> Iterator[Curator]:
    out = Curator(path, mapd())
    out.tick()
    yield out
    out.close()


@pytest.fixture
def site(tmp_path: Path) -> Iterator[Site]:
    curator = Curator(surveyed(tmp_path / "hall.db", robots=8), mapd())
    curator.tick()
    out = Site(tmp_path, curator, DirectLink(curator))
    yield out
    for r in out.robots:
        r.store.close()
    curator.close()
