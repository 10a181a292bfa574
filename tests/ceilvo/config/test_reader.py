"""config.yaml and --set: values are read as meant, overrides win, any text is a configuration or our error."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import get_type_hints

import pytest
from config_texts import loads, problems
from hypothesis import given
from hypothesis import strategies as st

from ceilvo.config import Camera, Config
from ceilvo.config.reader import calibration_path, load_config, replace
from ceilvo.config.schema import SECTIONS
from ceilvo.errors import ConfigError


@pytest.mark.parametrize("text", ["", "# nothing\n", "camera:\nbase:\n", "{}", "\ufeffrobot: {}\n", "---\nrobot: {}\n"])
def test_what_is_left_out_has_its_default(tmp_path: Path, text: str) -> None:
    assert loads(tmp_path, text) == Config()


def test_values_are_read_as_meant(tmp_path: Path) -> None:
    c = loads(
        tmp_path,
        "robot: {name: no}\n"  # text in YAML 1.2, false in 1.1
        "camera: {rate_hz: 15, exposure_us: 1e4, gain: ~}\n"
        "base: {turnaround_ms: .5}\n"
        'zenoh:\n  connect:\n    - tcp/10.0.0.1:7447\n    - "tcp/10.0.0.2:7447"\n  listen: []\n',
    )
    assert c.robot.name == "no"
    assert (c.camera.rate_hz, c.camera.exposure_us, c.camera.gain) == (15.0, 1e4, None)
    assert isinstance(c.camera.rate_hz, float)
    assert c.base.turnaround_ms == 0.5
    assert c.zenoh.connect == ("tcp/10.0.0.1:7447", "tcp/10.0.0.2:7447")
    assert c.zenoh.listen == ()


def test_limits_belong_to_the_range(tmp_path: Path) -> None:
    assert loads(tmp_path, "base: {unit_id: 247}").base.unit_id == 247
    assert loads(tmp_path, "camera: {width_px: 64}").camera.width_px == 64


# overrides


def test_overrides_win_over_the_file_and_are_checked_alike(tmp_path: Path) -> None:
    c = loads(
        tmp_path, "camera: {rate_hz: 15}", "camera.rate_hz=20", "zenoh.listen=[]", "camera.path=", "robot.name=a=b"
    )
    assert (c.camera.rate_hz, c.zenoh.listen, c.camera.path, c.robot.name) == (20.0, (), "", "a=b")


def test_an_override_can_settle_a_conflict(tmp_path: Path) -> None:
    text = "camera:\n  source: folder\n"
    assert "camera.path" in problems(tmp_path, text)[0]
    assert loads(tmp_path, text, "camera.path=/data").camera.path == "/data"


def test_wrong_overrides_are_named_as_typed() -> None:
    typed = [
        "camera.rate_hz=500",
        "rate_hz=5",
        "camera.rate_hz",
        "camra.rate_hz=5",
        "camera.rat_hz=5",
        "base.baud=[",
        "=",
    ]
    with pytest.raises(ConfigError) as e:
        replace(Config(), typed)
    expected = [
        "--set camera.rate_hz=500: camera.rate_hz: found 500, expected a number from 1 to 240; the default is",
        "--set rate_hz=5: expected section.key=value; for example camera.rate_hz=15",
        "--set camera.rate_hz: expected section.key=value",
        "--set camra.rate_hz=5: found an unknown section, expected one of",
        "--set camera.rat_hz=5: camera.rat_hz: found an unknown key, expected a key of camera; did you mean rate_hz?",
        "--set base.baud=[: found text that is not YAML",
        "--set =: expected section.key=value",
    ]
    assert len(e.value.problems) == len(expected)
    for problem, start in zip(e.value.problems, expected, strict=True):
        assert problem.startswith(start)


def test_replace_changes_nothing_else() -> None:
    start = dataclasses.replace(Config(), camera=Camera(rate_hz=12.0))
    changed = replace(start, ["base.baud=9600"])
    assert changed.base.baud == 9600
    assert dataclasses.replace(changed, base=start.base) == start
    assert replace(start, []) == start


@given(st.text(max_size=200) | st.binary(max_size=200))
def test_any_text_is_a_configuration_or_a_config_error(
    tmp_path_factory: pytest.TempPathFactory, raw: str | bytes
) -> None:
    file = tmp_path_factory.mktemp("c") / "config.yaml"
    file.write_bytes(raw if isinstance(raw, bytes) else raw.encode("utf-8", "surrogatepass"))
    try:
        assert load_config(file) == Config()
    except ConfigError as e:
        assert all(p.startswith(str(file)) and "expected" in p for p in e.problems)


def test_the_schema_has_only_types_that_the_reader_knows() -> None:
    for section in SECTIONS:
        for name, kind in get_type_hints(type(getattr(Config(), section))).items():
            assert kind in (bool, int, float, str, tuple[str, ...], float | None), f"{section}.{name}: {kind}"


def test_defaults_are_in_their_own_range() -> None:
    for section in SECTIONS:
        for f in dataclasses.fields(getattr(Config(), section)):
            value = getattr(getattr(Config(), section), f.name)
            low, high = f.metadata["low"], f.metadata["high"]
            assert low is None or value is None or low <= value <= high, f"{section}.{f.name}"
            chosen = value if isinstance(value, tuple) else (value,)
            assert not f.metadata["choices"] or set(chosen) <= set(f.metadata["choices"]), f"{section}.{f.name}"


def test_the_calibration_lies_beside_the_configuration() -> None:
    assert calibration_path(Config(), Path("/etc/ceilvo/config.yaml")) == Path("/etc/ceilvo/calibration.yaml")
    moved = replace(Config(), ["calibration.file=/var/k.yaml"])
    assert calibration_path(moved, Path("/etc/ceilvo/config.yaml")) == Path("/var/k.yaml")


def test_a_choice_is_read_by_its_old_name_with_a_notice(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """filter.method: pfcf was the default's name up to ceilvo 0.1, and is in every written-out configuration of it."""
    assert loads(tmp_path, "filter:\n  method: pfcf\n").filter.method == "joint"
    (notice,) = caplog.messages
    assert "config.yaml:2: filter.method: pfcf is now called joint" in notice
    caplog.clear()
    assert loads(tmp_path, "filter: {method: joint}\n").filter.method == "joint"
    assert loads(tmp_path, "filter: {method: pfcf_paper}\n").filter.method == "pfcf_paper"
    assert not caplog.messages


def test_keys_that_were_pixels_are_read_as_angles_with_a_notice(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Every written-out configuration of ceilvo 0.1 has them: its defaults are today's, and values keep their share."""
    old = "features:\n  hough_bin_px: 2.0\n  min_line_points: 30\n  groove_px: 7.0\n  crossing_reach_px: 24\n"
    read, now = loads(tmp_path, old).features, Config().features
    assert read.hough_bin_deg == pytest.approx(now.hough_bin_deg, rel=1e-3)
    assert read.min_line_deg == pytest.approx(now.min_line_deg, rel=1e-3)
    assert read.groove_deg == pytest.approx(now.groove_deg, rel=1e-3)
    assert read.crossing_reach_deg == pytest.approx(2.0 * now.crossing_reach_deg, rel=1e-3)
    assert len(caplog.messages) == 4
    assert "config.yaml:4: features.groove_px is now features.groove_deg, which is 0.9789" in caplog.text


@pytest.mark.parametrize("value", ["wide", "900", "true", "[7]"])
def test_a_wrong_value_of_such_a_key_is_refused(tmp_path: Path, value: str) -> None:
    (problem,) = problems(tmp_path, f"features:\n  groove_px: {value}\n")
    assert "features.groove_px, now: features.groove_deg: found" in problem
