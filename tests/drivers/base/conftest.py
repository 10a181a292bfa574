"""A base link over a mock that can be waited for."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from link_parts import SETTINGS, FakeClock, Watched

from ceilvo.drivers.base.link import BaseLink


@pytest.fixture
def base() -> Watched:
    return Watched()


@pytest.fixture
def link(base: Watched) -> Iterator[BaseLink]:
    link = BaseLink(SETTINGS, base, clock=FakeClock())
    yield link
    base.gate.set()
    assert link.stop()
