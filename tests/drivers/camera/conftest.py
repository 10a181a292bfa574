"""A capture loop that runs a script, and the gate that its frames wait at."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import pytest
from capture_rig import FAST, Gate, Rig
from patience import PATIENCE_S

from ceilvo import config
from ceilvo.drivers.camera.mock_camera import MockCamera, Step


@pytest.fixture
def gate() -> Iterator[Gate]:
    made = Gate()
    yield made
    made.opened.set()


@pytest.fixture
def start(gate: Gate) -> Iterator[Callable[..., Rig]]:
    rigs: list[Rig] = []

    def make(script: list[Step], settings: config.Camera = FAST, **kwargs: object) -> Rig:
        clock = kwargs.pop("loop_clock", lambda: 0)
        rig = Rig(MockCamera(script, wait=gate, **kwargs), settings, clock)  # type: ignore[arg-type]
        rigs.append(rig)
        rig.loop.start()
        return rig

    yield make
    gate.opened.set()
    for rig in rigs:
        assert rig.loop.stop(PATIENCE_S)
