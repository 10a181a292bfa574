"""The bench of faults: what an interrupted run goes on with."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from ceilvo.bench.faults import command
from ceilvo.bench.faults.drive import Tally
from ceilvo.errors import CeilvoError

OF = {"method": "joint", "seed": 100, "carried": True}


def test_a_run_goes_on_only_with_the_same_faults(tmp_path: Path) -> None:
    file = tmp_path / "faults.json"
    assert command._so_far(file, OF)[1] == 0
    file.write_text(json.dumps(command.summary(Tally(seconds=36.0), "joint", 3, 1.5) | OF))
    tally, rooms, cpu_s = command._so_far(file, OF)
    assert (tally.seconds, rooms, cpu_s) == (36.0, 3, 1.5)
    for other in ({"carried": False}, {"seed": 101}, {"method": "ukf"}):
        with pytest.raises(CeilvoError, match="name another"):
            command._so_far(file, OF | other)
    without = {k: v for k, v in json.loads(file.read_text()).items() if k != "carried"}  # of a version before
    file.write_text(json.dumps(without))
    with pytest.raises(CeilvoError, match="name another"):
        command._so_far(file, OF)
