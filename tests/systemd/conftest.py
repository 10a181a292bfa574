"""A kit as a robot gets it, and a Python whose virtual environment is made once."""

from __future__ import annotations

import shutil
import sys
import zipfile
from pathlib import Path

import pytest
from installer import REPO

PYTHON = """#!/bin/bash
# A Python whose `-I -m venv ... FOLDER` is made once and then copied: pip is unpacked and compiled only once.
# The copies only point to pip, else compiling it anew would be most of an installation.
made={template}
for folder; do :; done
if [ "$2 $3" != "-m venv" ]; then exec {python} "$@"; fi
if [ ! -e "$made" ]; then
  {python} "$@" && mv "$folder" "$made" && echo "$folder" >"$made.path" || exit
  site=$(echo "$made"/lib/python*/site-packages)
  mv "$site/pip" "$made.pip"
  mkdir "$site/pip"
  printf '__path__ = ["%s"]\\nexec(open("%s").read())\\n' "$made.pip" "$made.pip/__init__.py" >"$site/pip/__init__.py"
fi
cp -a "$made" "$folder"
grep -rlIZ --fixed-strings "$(cat "$made.path")" "$folder/bin" "$folder/pyvenv.cfg" |
  xargs -0r sed -i "s|$(cat "$made.path")|$folder|g"
"""


@pytest.fixture
def kit(tmp_path: Path) -> Path:
    """A folder as a robot gets it: the installer, its files and a wheel (a small stand-in for ceilvo's)."""
    kit = tmp_path / "kit"
    shutil.copytree(REPO / "systemd", kit)
    info = "ceilvo-9.9.9.dist-info"
    with zipfile.ZipFile(kit / "ceilvo-9.9.9-py3-none-any.whl", "w") as z:
        z.writestr("ceilvo/__init__.py", "def main():\n    print('stub')\n")
        z.writestr("ceilvo/config/rendering.py", "print('robot: {name: robot1}')\n")
        z.writestr("ceilvo/config/network.py", "import sys\nsys.exit('0.0.0.0' not in open(sys.argv[1]).read())\n")
        z.writestr(f"{info}/METADATA", "Metadata-Version: 2.1\nName: ceilvo\nVersion: 9.9.9\n")
        z.writestr(f"{info}/WHEEL", "Wheel-Version: 1.0\nGenerator: test\nRoot-Is-Purelib: true\nTag: py3-none-any\n")
        z.writestr(f"{info}/entry_points.txt", "[console_scripts]\nceilvod = ceilvo:main\ncalib = ceilvo:main\n")
        z.writestr(f"{info}/RECORD", "")
    return kit


@pytest.fixture(scope="session")
def python(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("python")
    (folder / "python3").write_text(PYTHON.format(template=folder / "venv", python=sys.executable))
    (folder / "python3").chmod(0o755)
    return folder / "python3"
