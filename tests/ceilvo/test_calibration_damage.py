"""Any value of a calibration file replaced by any other kind of value: refused in one line each, or a good value."""

from __future__ import annotations

import copy
import datetime
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml

from ceilvo.calibration_file import sign_calibration, write_calibration
from ceilvo.errors import CalibrationError
from ceilvo.sim.rig import simulated_calibration

STRANGE: tuple[Any, ...] = (
    {"a": 1}, [1], {}, [], None, "x", True, 10**400, float("nan"), float("inf"), -1, "1e999", {"a": {"b": [{}]}}, "\0",
    datetime.date(2020, 1, 1), "n" * 100_000,
)  # fmt: skip


def places(content: Any, above: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Keys and indices of every value, however deep."""
    for key, value in content.items() if isinstance(content, dict) else enumerate(content):
        yield (*above, key)
        if isinstance(value, dict | list):
            yield from places(value, (*above, key))


@pytest.mark.parametrize("strange", STRANGE, ids=lambda s: repr(s)[:20])
def test_nothing_but_a_clear_line_comes_of_it(tmp_path: Path, strange: Any) -> None:
    file = tmp_path / "calibration.yaml"
    write_calibration(file, simulated_calibration())
    good = yaml.safe_load(file.read_text())
    refused = 0
    for place in places(good):
        spoilt = copy.deepcopy(good)
        inner = spoilt
        for key in place[:-1]:
            inner = inner[key]
        inner[place[-1]] = strange
        file.write_text(yaml.safe_dump(spoilt))
        try:
            sign_calibration(file)
        except CalibrationError as e:
            refused += 1
            for line in e.problems:
                assert "\n" not in line and len(line) < 1000 and str(file) in line, place
    assert refused > 20
