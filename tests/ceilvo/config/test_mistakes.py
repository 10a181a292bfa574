"""config.yaml: every mistake gets its own clear line."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from config_texts import problems

from ceilvo.config.reader import load_config
from ceilvo.errors import ConfigError
from ceilvo.yaml_nodes import MAX_BYTES

MISTAKES: dict[str, tuple[str, str]] = {
    "unknown section": (
        "camra:\n  rate_hz: 3\n",
        "config.yaml:1: camra: found an unknown section, expected one of robot, camera, calibration, features, "
        "odometry, filter, senses, states, base, beacons, zenoh, ros2, vda5050, web, service, recorder, fleet, mapd; "
        "did you mean camera?",
    ),
    "key outside its section": (
        "baud: 9600\n",
        "config.yaml:1: baud: found an unknown section, expected one of robot, camera, calibration, features, "
        "odometry, filter, senses, states, base, beacons, zenoh, ros2, vda5050, web, service, recorder, fleet, mapd; "
        "baud is a key of base and beacons, indent it there",
    ),
    "misspelt key": (
        "camera:\n  rate_hz: 30\n  exposure: 100\n",
        "config.yaml:3: camera.exposure: found an unknown key, expected a key of camera; did you mean exposure_us?",
    ),
    "key in another section": (
        "robot:\n  baud: 9600\n",
        "config.yaml:2: robot.baud: found an unknown key, expected one of name; baud is a key of base and beacons",
    ),
    "unknown key": (
        "robot:\n  colour: red\n",
        "config.yaml:2: robot.colour: found an unknown key, expected one of name; remove it",
    ),
    "quoted number": (
        'camera:\n  rate_hz: "10"\n',
        "config.yaml:2: camera.rate_hz: found the text '10', expected a number from 1 to 240; remove the quotes",
    ),
    "decimal comma": (
        "base:\n  turnaround_ms: 2,5\n",
        "config.yaml:2: base.turnaround_ms: found the text '2,5', expected a number from 0 to 1000; write 2.5",
    ),
    "unit in the value": (
        "camera:\n  rate_hz: 30 Hz\n",
        "config.yaml:2: camera.rate_hz: found the text '30 Hz', expected a number from 1 to 240; "
        "write the number alone, the unit is in the key's name",
    ),
    "fraction for a whole number": (
        "camera:\n  width_px: 640.0\n",
        "config.yaml:2: camera.width_px: found 640.0, expected a whole number from 64 to 7680; write 640",
    ),
    "boolean for a number": (
        "filter:\n  particles: true\n",
        "config.yaml:2: filter.particles: found true, expected a whole number from 10 to 100000; "
        "the default is 100: number of pose hypotheses",
    ),
    "number for a boolean": (
        "base:\n  enabled: 0\n",
        "config.yaml:2: base.enabled: found 0, expected true or false; write false",
    ),
    "old YAML boolean": (
        "base:\n  enabled: on\n",
        "config.yaml:2: base.enabled: found the text 'on', expected true or false; write true",
    ),
    "number for text": (
        "robot:\n  name: 17\n",
        "config.yaml:2: robot.name: found 17, expected text; put it in quotes",
    ),
    "not a number": (
        "camera:\n  rate_hz: .nan\n",
        "config.yaml:2: camera.rate_hz: found .nan, expected a number from 1 to 240; "
        "the default is 30.0: frames per second to ask for",
    ),
    "infinite": (
        "camera:\n  rate_hz: .inf\n",
        "config.yaml:2: camera.rate_hz: found .inf, expected a number from 1 to 240; "
        "the default is 30.0: frames per second to ask for",
    ),
    "overflow": (
        "camera:\n  rate_hz: 1e999\n",
        "config.yaml:2: camera.rate_hz: found 1e999, expected a number from 1 to 240; "
        "the default is 30.0: frames per second to ask for",
    ),
    "above the range": (
        "base:\n  unit_id: 248\n",
        "config.yaml:2: base.unit_id: found 248, expected a whole number from 1 to 247; "
        "the default is 1: Modbus address of the base",
    ),
    "below the range": (
        "camera:\n  gain: -1\n",
        "config.yaml:2: camera.gain: found -1, expected a number from 0 to 1000000 or null; "
        "the default is null: fixed gain in the driver's units; null leaves it alone",
    ),
    "bad choice": (
        "camera:\n  source: folders\n",
        "config.yaml:2: camera.source: found 'folders', expected one of v4l2, folder, video; did you mean folder?",
    ),
    "null": (
        "camera:\n  rate_hz: null\n",
        "config.yaml:2: camera.rate_hz: found null, expected a number from 1 to 240; "
        "the default is 30.0: frames per second to ask for",
    ),
    "nothing": (
        "camera:\n  rate_hz:\n",
        "config.yaml:2: camera.rate_hz: found nothing, expected a number from 1 to 240; "
        "the default is 30.0: frames per second to ask for",
    ),
    "text for a list": (
        "zenoh:\n  connect: tcp/10.0.0.1:7447\n",
        "config.yaml:2: zenoh.connect: found the text 'tcp/10.0.0.1:7447', expected a list of texts; "
        'write ["tcp/10.0.0.1:7447"]',
    ),
    "number in a list": (
        "zenoh:\n  connect: [7447]\n",
        "config.yaml:2: zenoh.connect: found 7447 in the list, expected a list of texts; put each entry in quotes",
    ),
    "list for text": (
        "robot:\n  name: [a]\n",
        "config.yaml:2: robot.name: found a list, expected text; "
        "the default is robot1: one Zenoh key segment; distinguishes robots of a fleet",
    ),
    "section without keys": (
        "camera: 5\n",
        "config.yaml:1: camera: found 5, expected keys, indented below 'camera:'",
    ),
    "duplicate key": (
        "base:\n  baud: 9600\n  baud: 19200\n",
        "config.yaml:3: base.baud: found it twice, expected it once; remove it here or on line 2",
    ),
    "duplicate section": (
        "robot:\n  name: a\nrobot:\n  name: b\n",
        "config.yaml:3: robot: found it twice, expected it once; remove it here or on line 1",
    ),
    "number as a key": ("1: 2\n", "config.yaml:1: found 1 as a key, expected a name"),
    "control character": (
        'service:\n  state_dir: "a\\0b"\n',
        "config.yaml:2: service.state_dir: found 'a\\x00b', expected text without control characters; type it again",
    ),
    "Python object": (
        "robot:\n  name: !!python/object/apply:os.system [id]\n",
        "config.yaml:2: robot.name: found a value with the tag !!python/object/apply:os.system, expected text; "
        "the default is robot1: one Zenoh key segment; distinguishes robots of a fleet",
    ),
    "tagged list": (
        "zenoh:\n  listen: !!python/tuple [tcp/127.0.0.1:0]\n",
        "config.yaml:2: zenoh.listen: found a value with the tag !!python/tuple, expected a list of texts; "
        "write [] for none",
    ),
    "tagged section": (
        "robot: !!set {name}\n",
        "config.yaml:1: robot: found a value with the tag !!set, expected keys, indented below 'robot:'",
    ),
    "tag": (
        "robot:\n  name: !!python/name:os.system x\n",
        "config.yaml:2: robot.name: found a value with the tag !!python/name:os.system, expected text; "
        "put it in quotes",
    ),
    "list at the top": (
        "- camera\n",
        "config.yaml:1: found a list, expected sections such as 'camera:' with keys below them",
    ),
    "text at the top": (
        "hello\n",
        "config.yaml:1: found the text 'hello', expected sections such as 'camera:' with keys below them",
    ),
    "broken YAML": (
        "camera:\n  rate_hz: [1\n",
        "config.yaml:3: found text that is not YAML (expected ',' or ']', but got '<stream end>'), expected YAML; "
        "check indentation, colons and quotes",
    ),
    "tab": (
        "camera:\n\trate_hz: 3\n",
        "config.yaml:2: found text that is not YAML (found character '\\t' that cannot start any token), "
        "expected YAML; indent with spaces",
    ),
    "two documents": (
        "robot: {}\n---\nrobot: {}\n",
        "config.yaml:2: found text that is not YAML (but found another document), expected YAML; "
        "check indentation, colons and quotes",
    ),
    "alias": (
        "robot: &r\n  name: a\ncamera: *r\n",
        "config.yaml:3: found text that is not YAML (an alias *name), expected YAML; "
        "check indentation, colons and quotes",
    ),
    "too deep": (
        "[" * 100_000,
        "config.yaml: found nesting that is too deep to read, expected section and keys",
    ),
    "too large": (
        "#" * (MAX_BYTES + 1),
        "config.yaml: found more than 1048576 bytes, expected at most 1048576; is it the right file?",
    ),
}


@pytest.mark.parametrize("name", MISTAKES)
def test_a_mistake_is_one_clear_line(tmp_path: Path, name: str) -> None:
    text, expected = MISTAKES[name]
    assert problems(tmp_path, text) == (expected,)


def test_different_mistakes_have_different_messages() -> None:
    assert len({message for _, message in MISTAKES.values()}) == len(MISTAKES) >= 12


TWELVE = """\
camra: {}
robot:
  name: a/b
camera:
  rate: 30
  rate_hz: "15"
  width_px: 640.5
  height_px: true
  exposure_us: 1
  source: webcam
  reopen_min_s: 5
  reopen_max_s: 1
  gain: .inf
base:
  rate_hz: 150
  parity: O
filter:
  particles: null
service:
  seed: 1
  seed: 2
"""


def test_twelve_mistakes_in_one_file_give_twelve_errors_at_once(tmp_path: Path) -> None:
    found = problems(tmp_path, TWELVE)
    assert [p.split(": ")[:2] for p in found] == [
        ["config.yaml:1", "camra"],
        ["config.yaml:5", "camera.rate"],
        ["config.yaml:6", "camera.rate_hz"],
        ["config.yaml:7", "camera.width_px"],
        ["config.yaml:8", "camera.height_px"],
        ["config.yaml:9", "camera.exposure_us"],
        ["config.yaml:10", "camera.source"],
        ["config.yaml:13", "camera.gain"],
        ["config.yaml:18", "filter.particles"],
        ["config.yaml:21", "service.seed"],
        ["config.yaml:3", "robot.name"],
        ["config.yaml:11", "camera.reopen_min_s"],
        ["config.yaml:15", "base.rate_hz"],
    ]
    assert all("found" in p and "expected" in p for p in found)
    assert len(set(found)) == len(found) == 13


def test_a_wrong_key_does_not_also_conflict(tmp_path: Path) -> None:
    """What cannot be read is not judged against other keys with its default."""
    found = problems(tmp_path, "states:\n  degraded_sigma_m: x\n  lost_sigma_m: 0.05\n")
    assert len(found) == 1
    assert "states.degraded_sigma_m" in found[0]


def test_files_that_cannot_be_read_are_named(tmp_path: Path) -> None:
    cases: dict[Path, str] = {
        tmp_path / "none.yaml": "found no such file, expected a readable file",
        tmp_path: "found a folder, expected a regular file",
        Path("/dev/null"): "found a device, expected a regular file",
    }
    for path, message in cases.items():
        with pytest.raises(ConfigError) as e:
            load_config(path)
        assert str(e.value) == f"{path}: {message}"


def test_a_file_without_rights_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Root may read everything, so the refusal is played."""
    file = tmp_path / "config.yaml"
    file.write_text("")

    def refuse(self: Path, *_: Any) -> None:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(Path, "open", refuse)
    with pytest.raises(ConfigError, match=r"found a file that cannot be read \(Permission denied\)"):
        load_config(file)


def test_bytes_that_are_not_text_are_named_with_their_line(tmp_path: Path) -> None:
    assert problems(tmp_path, b"# fine\nrobot: {name: \xe9}\n") == (
        "config.yaml:2: found byte 0xe9, expected UTF-8 text; save it as UTF-8",
    )
    assert "forbids" in problems(tmp_path, b"robot:\n  name: \x01\n")[0]
