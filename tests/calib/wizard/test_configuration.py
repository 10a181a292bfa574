"""Keys of a configuration changed in its own text: the rest stays to the byte, the old file as well."""

from __future__ import annotations

import difflib
from pathlib import Path

import pytest

from ceilvo.calib.wizard.configuration import change_config, with_values
from ceilvo.config import Config
from ceilvo.config.reader import parse_config
from ceilvo.config.rendering import render_config
from ceilvo.errors import ConfigError

VALUES = {"camera.exposure_us": 10000.0, "camera.gain": 3.0}


@pytest.mark.parametrize(
    "text",
    [
        render_config(Config()),
        "",
        "# nothing but words\n",
        "camera:\n",
        "camera: # later\n",
        "camera:\n  rate_hz: 15 # slow\n\nweb:\n  port: 1",
        "camera: {rate_hz: 15}\n",
        "camera:\n    gain: null   # c\n    exposure_us: 5000.0 # x\n",
        "camera:\n  exposure_us:\n  gain: 2\n",
        "web:\n  port: 8000\n",
    ],
)
def test_the_values_are_in_and_nothing_else_has_changed(text: str) -> None:
    new = with_values(text, "x", VALUES)
    camera = parse_config(new, "x").camera
    assert (camera.exposure_us, camera.gain) == (10000.0, 3.0)
    before, after = text.splitlines(), new.splitlines()
    lost = [d[2:] for d in difflib.ndiff(before, after) if d.startswith("- ")]
    assert all("exposure_us" in line or "gain" in line or line.startswith("camera:") for line in lost)
    comments = [line.partition("#")[2] for line in before if "#" in line]
    assert all(c in new for c in comments)
    assert with_values(new, "x", VALUES) == new


@pytest.mark.parametrize("values", [{"camera.gain": -1.0}, {"camera.cheese": 1.0}, {"cheese.gain": 1.0}])
def test_what_would_be_wrong_is_refused_and_the_file_stays(values: dict[str, float], tmp_path: Path) -> None:
    file = tmp_path / "config.yaml"
    file.write_text("camera:\n  gain: 2\n")
    with pytest.raises(ConfigError, match=r"gain|cheese"):
        change_config(file, values)
    assert file.read_text() == "camera:\n  gain: 2\n" and list(tmp_path.iterdir()) == [file]


def test_the_file_as_it_was_is_kept_with_its_mode(tmp_path: Path) -> None:
    file = tmp_path / "config.yaml"
    file.write_text("camera:\n  gain: 2\n")
    file.chmod(0o640)
    assert change_config(file, VALUES).read_text() == "camera:\n  gain: 2\n"
    assert parse_config(file.read_text(), "x").camera.gain == 3.0
    assert [oct(p.stat().st_mode & 0o777) for p in sorted(tmp_path.iterdir())] == ["0o640", "0o640"]


def test_a_file_that_is_not_there_is_named(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"no-config\.yaml: found no such file"):
        change_config(tmp_path / "no-config.yaml", VALUES)
