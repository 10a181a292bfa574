"""A configuration read from a text, or its problems."""

from __future__ import annotations

from pathlib import Path

import pytest

from ceilvo.config import Config
from ceilvo.config.reader import load_config
from ceilvo.errors import EXIT_CONFIG, ConfigError


def problems(tmp_path: Path, text: str | bytes, *overrides: str) -> tuple[str, ...]:
    file = tmp_path / "config.yaml"
    file.write_bytes(text if isinstance(text, bytes) else text.encode())
    with pytest.raises(ConfigError) as e:
        load_config(file, overrides)
    assert e.value.exit_code == EXIT_CONFIG == 78
    assert str(e.value) == "\n".join(e.value.problems)
    return tuple(p.replace(f"{tmp_path}/", "") for p in e.value.problems)


def loads(tmp_path: Path, text: str, *overrides: str) -> Config:
    file = tmp_path / "config.yaml"
    file.write_text(text)
    return load_config(file, overrides)
