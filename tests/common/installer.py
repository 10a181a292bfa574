"""The unit and the installer as tests use them."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

REPO = Path(__file__).resolve().parents[2]
Done = subprocess.CompletedProcess[str]
UNIT = REPO / "systemd" / "ceilvod.service"
MAPD_UNIT = UNIT.with_name("ceilvo-mapd.service")
WEB_UNIT = UNIT.with_name("ceilvo-web.service")
INSTALL = REPO / "systemd" / "install.sh"

as_root = pytest.mark.skipif(
    os.geteuid() != 0 or shutil.which("systemd-sysusers") is None,
    reason="the installer needs root and systemd-sysusers",
)


def run_installer(kit: Path, root: Path, *args: str, python: Path | str = sys.executable) -> Done:
    command = ["bash", str(kit / "install.sh"), "--root", str(root), "--python", str(python), *args]
    return subprocess.run(command, capture_output=True, text=True)


def unit_settings(unit: Path = UNIT) -> dict[str, list[str]]:
    """Key to values, in order; the keys of this unit are unique across its sections."""
    out: dict[str, list[str]] = {}
    for line in unit.read_text().splitlines():
        if "=" in line and not line.startswith("#"):
            key, _, value = line.partition("=")
            out.setdefault(key, []).append(value)
    return out
