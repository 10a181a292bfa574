"""The file of anchors, marks and lamps: read back as written, and every mistake told in one line."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import pytest

from ceilvo.errors import ConfigError
from ceilvo.senses.beacon_file import read_beacons, write_beacons
from ceilvo.senses.beacons import Anchor, Beacons, Lamp, Mark

TEXT = """\
version: 1
anchors:
  - {name: "0c14", x_m: 0.0, y_m: 1, z_m: 2.1}
  - {name: "0CA8", x_m: 12.5, y_m: 0.2, z_m: 2.0, sigma_m: 0.1, offset_m: -0.05, offset_sigma_m: 0.02}
marks:
  - {id: 7, size_m: 0.2, x_m: 4.0, y_m: -2.0, theta_deg: 90}
lamps:
  - {name: "door", x_m: 3, y_m: 0.5}
  - {name: "L2", x_m: 5.0, y_m: 0.5, below_m: 0.4, sigma_m: 0.03}
"""


def test_what_people_write(tmp_path: Path) -> None:
    file = tmp_path / "beacons.yaml"
    file.write_text(TEXT)
    found = read_beacons(file)
    assert found.anchors[0] == Anchor("0C14", 0.0, 1, 2.1)
    assert found.anchors[1].sigma_m == 0.1 and found.anchors[1].offset_m == -0.05
    assert found.marks == (Mark(7, 0.2, 4.0, -2.0, math.pi / 2.0),)
    assert found.lamps == (Lamp("DOOR", 3.0, 0.5), Lamp("L2", 5.0, 0.5, 0.4, 0.03))


def test_what_is_written_is_read_back(tmp_path: Path) -> None:
    file = tmp_path / "beacons.yaml"
    beacons = Beacons((Anchor("A1", 1.25, -2.5, 2.0, 0.03, 0.1, 0.05, 0.001, 0.002),), (Mark(3, 0.16, 1.0, 2.0, 0.5),))
    beacons = replace(beacons, lamps=(Lamp("L1", 1.5, -2.25, 0.3, 0.015),))
    write_beacons(file, beacons)
    found = read_beacons(file)
    assert found.anchors == beacons.anchors and found.lamps == beacons.lamps
    assert found.marks[0].theta_rad == pytest.approx(0.5, abs=1e-6) and found.marks[0].number == 3


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ("version: 1", "version: 2", "version: found 2, expected 1"),
        ("version: 1", "version: true", "version: found True, expected 1"),
        ("anchors:", "ankers:", "expected the keys version, anchors, marks and lamps"),
        ('"0c14"', "0014", "anchors[0].name: found 14"),
        ('"0c14"', '"0CA8"', "anchors: found 0CA8 twice"),
        ("z_m: 2.1", "z_m: 2100", "anchors[0].z_m: found 2100, expected a number from -10 to 100"),
        ("z_m: 2.1", "z_m: high", "anchors[0].z_m: found 'high'"),
        (", z_m: 2.1", "", "anchors[0]: found {"),
        ("size_m: 0.2", "size_m: 20", "marks[0].size_m: found 20, expected a number from 0.01 to 5"),
        ("size_m: 0.2", "size: 0.2", "marks[0]: found {"),
        ("y_m: -2.0", "y_m: .nan", "marks[0].y_m: found nan"),
        ('"L2"', '"DOOR"', "lamps: found DOOR twice"),
        ("below_m: 0.4", "below_m: -1", "lamps[1].below_m: found -1, expected a number from 0 to 20"),
        ("marks:\n", "marks: [[\n", "not YAML"),
    ],
)
def test_a_mistake_is_told_in_one_line_with_file_and_entry(tmp_path: Path, old: str, new: str, says: str) -> None:
    file = tmp_path / "beacons.yaml"
    assert old in TEXT
    file.write_text(TEXT.replace(old, new))
    with pytest.raises(ConfigError) as e:
        read_beacons(file)
    (line,) = e.value.problems
    assert says in line and line.startswith(str(file)) and "\n" not in line


def test_a_file_that_is_not_there(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="no such file"):
        read_beacons(tmp_path / "nothing.yaml")
