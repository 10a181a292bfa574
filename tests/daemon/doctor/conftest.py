"""A camera's device node and a simulated base for the doctor to look at."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from ceilvo.sim.base import SimBase


@pytest.fixture
def node(tmp_path: Path) -> str:
    """A stable name as udev makes them; /dev/null is a device node that is always there."""
    link = tmp_path / "dev" / "v4l" / "by-id" / "usb-a-camera"
    link.parent.mkdir(parents=True)
    link.symlink_to("/dev/null")
    return str(link)


@pytest.fixture
def simulated() -> Iterator[SimBase]:
    with SimBase(baud=115200) as running:
        yield running
