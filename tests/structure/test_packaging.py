"""The wheel, installed outside the repository, is the whole program."""

from __future__ import annotations

import email
import os
import re
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

from ceilvo.daemon.vision import kernel

ROOT = Path(__file__).resolve().parents[2]
FOLDERS = ("daemon", "drivers", "calib", "sim", "bench")
EXTRAS = {"aiohttp", "cryptography", "filterpy", "matplotlib", "msgpack", "particles", "stonesoup"}
"""Libraries of the extras, for benches, plots and fleets."""


def run(*command: str | Path, cwd: Path, **env: str) -> str:
    """Standard output of a command that must succeed."""
    clean = {k: v for k, v in os.environ.items() if not k.startswith("PYTHON")}
    done = subprocess.run([str(c) for c in command], cwd=cwd, capture_output=True, text=True, env=clean | env)
    assert done.returncode == 0, f"{command}: exit {done.returncode}\n{done.stdout}\n{done.stderr}"
    return done.stdout


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Built from a copy, so that nothing left in build/ gets in and nothing is left behind."""
    source = tmp_path_factory.mktemp("source")
    for folder in ("ceilvo", *FOLDERS):
        shutil.copytree(ROOT / folder, source / folder, ignore=shutil.ignore_patterns("__pycache__", "*.so"))
    for name in ("pyproject.toml", "setup.py", "README.md", "LICENSE"):
        if (ROOT / name).exists():
            shutil.copy(ROOT / name, source)
    out = tmp_path_factory.mktemp("wheel")
    hasty = out / "cc"  # optimising takes most of the time, and what is in the wheel does not depend on it
    hasty.write_text('#!/bin/bash\nexec cc "${@/#-O[23]/-O0}"\n')
    hasty.chmod(0o755)
    run(*_pip("wheel"), "--no-build-isolation", "--no-deps", "--wheel-dir", out, source, cwd=out, CC=str(hasty))
    (built,) = out.glob("ceilvo-*.whl")
    return built


def _pip(command: str) -> list[str]:
    return [sys.executable, "-m", "pip", "--disable-pip-version-check", "--no-input", command, "--quiet"]


@pytest.fixture(scope="module")
def installed(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    target = tmp_path_factory.mktemp("installed")
    run(*_pip("install"), "--no-deps", "--no-index", "--target", target, wheel, cwd=target)
    return target


def python(installed: Path, code: str, cwd: Path) -> str:
    """Run code where only the installed copy can be found: its folder first, the editable install's hook taken out."""
    head = (
        "import sys\n"
        f"sys.path.insert(0, {str(installed)!r})\n"
        "sys.meta_path[:] = [f for f in sys.meta_path if '__editable__' not in getattr(f, '__module__', '')]\n"
    )
    return run(sys.executable, "-I", "-W", "error", "-c", head + code, cwd=cwd)


def module_of(path: Path) -> str:
    parts = path.relative_to(ROOT).with_suffix("").parts
    name = ".".join(parts if parts[0] == "ceilvo" else ("ceilvo", *parts))
    return name.removesuffix(".__init__")


def sources() -> list[Path]:
    return sorted(p for folder in ("ceilvo", *FOLDERS) for p in (ROOT / folder).rglob("*.py"))


def test_every_folder_of_code_is_a_package_that_is_installed() -> None:
    """pyproject.toml lists them; one that it leaves out would be missing from the wheel without a word."""
    (listed,) = re.findall(r"^packages = \[(.*?)^\]", (ROOT / "pyproject.toml").read_text(), re.M | re.S)
    packages = {module_of(p) for p in sources() if p.name == "__init__.py"}
    assert re.findall(r'"(.+?)"', listed) == sorted(packages)
    assert {module_of(p / "__init__.py") for p in {s.parent for s in sources()}} == packages


def test_the_wheel_holds_every_source_and_nothing_else(wheel: Path) -> None:
    expected = {"ceilvo/py.typed"}
    for path in sources():
        relative = path.relative_to(ROOT).as_posix()
        expected.add(relative if relative.startswith("ceilvo/") else f"ceilvo/{relative}")
    with zipfile.ZipFile(wheel) as z:
        names = {n for n in z.namelist() if ".dist-info/" not in n}
        for path in sources():
            relative = path.relative_to(ROOT).as_posix()
            inside = relative if relative.startswith("ceilvo/") else f"ceilvo/{relative}"
            assert z.read(inside) == path.read_bytes(), f"{inside} differs; changed while the wheel was built?"
    assert expected <= names
    others = {n for n in names - expected if not n.endswith((".yaml", ".json", ".html", ".css", ".js", ".svg"))}
    compiled = {
        "vision": ("following", "joins", "lines", "pixels", "points", "spreads", "votes"),
        "odometry": ("followed_lines", "homographies", "views"),
        "relocalisation": ("evidence", "neighbours"),
    }
    loops = {f"ceilvo/daemon/{room}/kernel/{name}" for room, names in compiled.items() for name in names}
    shared = {f"ceilvo/daemon/vision/kernel/{name}" for name in ("groups", "picture", "solve")}  # included by several
    assert {n.partition(".")[0] for n in others} == loops | shared  # their sources and, with a compiler, themselves
    assert {n.partition(".")[0] for n in others if n.endswith(".so")} == (loops if kernel.COMPILED else set())


def test_the_wheel_claims_no_name_but_its_own(wheel: Path) -> None:
    """`daemon` is a well-known package's import name."""
    with zipfile.ZipFile(wheel) as z:
        tops = {n.split("/")[0] for n in z.namelist()}
    assert {t for t in tops if not t.endswith(".dist-info")} == {"ceilvo"}


def test_every_module_imports_from_the_installed_copy(installed: Path, tmp_path: Path) -> None:
    names = [m for m in map(module_of, sources()) if not m.endswith("__main__")]
    code = (
        f"import importlib\nfor name in {names!r}:\n    try:\n        print(importlib.import_module(name).__file__)\n"
        "    except ModuleNotFoundError as e:\n        print('extra', e.name)\n"
    )
    found = python(installed, code, tmp_path).splitlines()
    missing = {f.split()[1].partition(".")[0] for f in found if f.startswith("extra ")}
    assert missing <= EXTRAS
    files = [f for f in found if not f.startswith("extra ")]
    assert len(found) == len(names) and len(files) > 20
    assert [f for f in files if not f.startswith(str(installed))] == []


def test_the_default_configuration_comes_with_the_code(installed: Path, tmp_path: Path) -> None:
    code = "from ceilvo.config import Config, rendering\nprint(rendering.render_config(Config()), end='')\n"
    assert python(installed, code, tmp_path) == (ROOT / "config.yaml").read_text()


@pytest.mark.parametrize(("command", "target"), [("ceilvod", "ceilvo.daemon.start"), ("calib", "ceilvo.calib.cli")])
def test_the_commands_exist_and_explain_themselves(installed: Path, tmp_path: Path, command: str, target: str) -> None:
    script = (installed / "bin" / command).read_text()
    assert f"from {target} import" in script
    code = (
        "import contextlib, io\n"
        f"from {target.replace('start', 'cli')} import main\n"
        "out = io.StringIO()\n"
        "with contextlib.redirect_stdout(out):\n"
        "    try:\n"
        "        main(['--help'])\n"
        "    except SystemExit as e:\n"
        "        assert e.code == 0, e.code\n"
        "print(out.getvalue())\n"
    )
    assert "usage:" in python(installed, code, tmp_path)


def test_the_metadata_says_what_is_needed(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as z:
        (name,) = (n for n in z.namelist() if n.endswith(".dist-info/METADATA"))
        meta = email.message_from_bytes(z.read(name))
    assert meta["Requires-Python"] == ">=3.10"
    needed = [r for r in meta.get_all("Requires-Dist", []) if "extra ==" not in r]
    assert len(needed) >= 7
    assert all(re.search(r">=[\d.]+", r) and re.search(r"<\d+", r) for r in needed), needed


def test_every_dependency_is_pinned_once() -> None:
    lines = [line for line in (ROOT / "constraints.txt").read_text().splitlines() if not line.startswith("#")]
    shape = re.compile(r'([A-Za-z0-9._-]+)==[0-9][0-9A-Za-z.]*( ?; python_version (>=|<) "3\.\d+")?')
    matches = [shape.fullmatch(line) for line in lines]
    assert all(matches), [line for line, m in zip(lines, matches, strict=True) if not m]
    names = [re.sub(r"[-_.]+", "-", m[1]).lower() for m in matches if m]
    assert len(set(names)) == len(names)
    project = (ROOT / "pyproject.toml").read_text()
    wanted = re.findall(r'^  "([A-Za-z0-9-]+)[>=]', project, re.M)
    assert len(wanted) >= 14
    assert [w for w in wanted if w.lower() not in names] == []
