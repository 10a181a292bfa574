"""Pictures that a program of ours draws are as it draws them now."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import pytest

IMAGES = Path(__file__).resolve().parents[2] / "docs" / "images"


@pytest.mark.parametrize("name", ["mounting", "axes", "wiring", "steps"])
def test_a_picture_is_as_its_program_draws_it(name: str) -> None:
    spec = importlib.util.spec_from_file_location("setup_pictures", IMAGES / "setup.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    assert sorted(module.DRAWN) == sorted(["mounting", "axes", "wiring", "steps"])
    assert (IMAGES / f"{name}.svg").read_text() == module.DRAWN[name]().svg()
