"""config.yaml as rendered: every key explained, and it reads back the same."""

from __future__ import annotations

import dataclasses
import math
import re
import subprocess
import sys
from pathlib import Path
from typing import Any, get_args, get_type_hints

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from ceilvo.config import Config
from ceilvo.config.reader import load_config
from ceilvo.config.rendering import render_config
from ceilvo.config.schema import SECTIONS
from ceilvo.errors import ConfigError

ROOT = Path(__file__).resolve().parents[3]


def test_the_config_yaml_of_the_repository_is_the_rendered_default() -> None:
    assert (ROOT / "config.yaml").read_text() == render_config(Config()), "out of date: run `make config`"
    assert load_config(ROOT / "config.yaml") == Config()


def test_the_module_prints_the_default_file(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-W", "error", "-m", "ceilvo.config.rendering"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout == render_config(Config())


def test_every_key_is_explained_with_its_unit_and_range() -> None:
    text = render_config(Config())
    for section in SECTIONS:
        for f in dataclasses.fields(getattr(Config(), section)):
            assert f"  # {f.metadata['why']}" in text
            assert f"\n  {f.name}: " in text
    assert "# frames per second to ask for [Hz, 1 to 240]\n  rate_hz: 30.0\n" in text


def section_values(cls: type) -> st.SearchStrategy[Any]:
    kinds = get_type_hints(cls)
    return st.builds(cls, **{f.name: key_values(kinds[f.name], f) for f in dataclasses.fields(cls)})


def key_values(kind: Any, f: dataclasses.Field[Any]) -> st.SearchStrategy[Any]:
    low, high = f.metadata["low"], f.metadata["high"]
    text = st.text(st.characters(exclude_categories=["C", "Z"]) | st.just(" "), max_size=12)
    if f.metadata["choices"]:
        one = st.sampled_from(f.metadata["choices"])
        return st.lists(one, max_size=3).map(tuple) if kind == tuple[str, ...] else one
    if kind is bool:
        return st.booleans()
    if kind is int:
        return st.integers(math.ceil(low), math.floor(high))
    if kind is str:
        return text
    if kind is float:
        return st.floats(low, high)
    if float in get_args(kind):
        return st.none() | st.floats(low, high)
    assert kind == tuple[str, ...]
    return st.lists(text, max_size=3).map(tuple)


def plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {k: plain(v) for k, v in value.items()}
    return list(value) if isinstance(value, tuple) else value


configs = st.builds(Config, **{s: section_values(type(getattr(Config(), s))) for s in SECTIONS})


@given(config=configs)
def test_what_is_rendered_reads_back_the_same(tmp_path_factory: pytest.TempPathFactory, config: Config) -> None:
    file = tmp_path_factory.mktemp("c") / "config.yaml"
    file.write_text(render_config(config))
    try:
        assert load_config(file) == config
    except ConfigError as e:  # random values may conflict, but each is read
        assert all(any(key in p for key in CONFLICT_KEYS) for p in e.problems), e.problems
    assert yaml.safe_load(file.read_text()) == plain(dataclasses.asdict(config))


CONFLICT_KEYS = (
    ": recorder.kept_bytes: ",
    ": senses.",
    ": base.predict: ",
    ": beacons.",
    ": fleet.service: ",
    ": mapd.building: ",
    ": robot.name: ",
    ": zenoh.prefix: ",
    ": zenoh.wire: ",
    ": ros2.",
    ": vda5050.",
    ": web.",
    ": zenoh.listen: ",
    ": zenoh.connect: ",
    ": camera.path: ",
    ": camera.device: ",
    ": camera.exposure_us: ",
    ": camera.read_timeout_s: ",
    ": camera.reopen_min_s: ",
    ": calibration.file: ",
    ": states.lost_sigma_m: ",
    ": states.nis_lost: ",
    ": base.port: ",
    ": base.timeout_s: ",
    ": base.rate_hz: ",
)


def test_the_installer_prints_the_default_configuration_by_a_module_that_does() -> None:
    """In the tests of the installer a stub stands for ceilvo: it would print whatever module the installer named."""
    (module,) = re.findall(r"-m (ceilvo[\w.]+) >\"\$1/config.yaml\"", (ROOT / "systemd" / "install.sh").read_text())
    printed = subprocess.run([sys.executable, "-I", "-m", module], capture_output=True, text=True, check=True).stdout
    assert printed == (ROOT / "config.yaml").read_text()
