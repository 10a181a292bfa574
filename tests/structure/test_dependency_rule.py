"""Who may import whom, read from the sources without running them.

- ceilvo imports no sibling.
- drivers and the stages in daemon import ceilvo and their own folder; daemon/app*.py alone join stages to drivers,
  and daemon/cli.py calls app.
- Only app_simulation (for --simulate), calib, bench and tests import sim; nobody imports calib.
- Nobody imports bench but daemon/app_experiment.py, which is how `ceilvod experiment` comes to the benches; it loads
  them when they are asked for (import_module in a function), so that a robot's daemon never does.
- The stages, which are daemon/pipeline.py and all that it imports, have no clock, I/O, logging or threads.
"""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
FOLDERS = ("daemon", "drivers", "calib", "sim", "bench")

ALLOWED = {
    "ceilvo": {"ceilvo"},
    "daemon": {"ceilvo", "daemon"},
    "drivers": {"ceilvo", "drivers"},
    "sim": {"ceilvo", "sim", "drivers", "daemon"},
    "calib": {"ceilvo", "calib", "sim", "drivers", "daemon"},
    "bench": {"ceilvo", "bench", "sim", "drivers", "daemon"},
}
EXCEPTIONS = {
    **{f"daemon/{p.name}": {"drivers"} for p in (ROOT / "daemon").glob("app*.py")},
    "daemon/app_simulation.py": {"drivers", "sim"},
    "daemon/app_experiment.py": {"drivers", "bench"},
}

APP_CALLERS = ("daemon/cli.py", "daemon/app", "bench/")

IMPURE = {
    *("time", "datetime", "os", "io", "pathlib", "logging", "threading", "queue", "socket", "subprocess", "random"),
    *("multiprocessing", "asyncio", "signal", "secrets", "serial", "pymodbus", "zenoh", "rich", "yaml", "json", "sys"),
}


def sources() -> list[Path]:
    return sorted(p for folder in ("ceilvo", *FOLDERS) for p in (ROOT / folder).rglob("*.py"))


def imported(source: str, package: str = "ceilvo") -> set[str]:
    """Full names of everything that a source imports, at any depth; `from a import b` counts as a.b."""
    names: set[str] = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            names |= {a.name for a in node.names}
        elif isinstance(node, ast.ImportFrom):
            stem = "." * node.level + (node.module or "")
            names |= {f"{stem}.{a.name}" for a in node.names}
        elif isinstance(node, ast.Call) and node.args and isinstance(node.args[0], ast.Constant):
            called = node.func.attr if isinstance(node.func, ast.Attribute) else getattr(node.func, "id", "")
            if called in ("import_module", "__import__"):
                names.add(str(node.args[0].value))
    return names


def folder_of(name: str) -> str | None:
    """The folder of ceilvo that a module lives in, None for other people's modules."""
    parts = name.split(".")
    if parts[0] != "ceilvo":
        return parts[0] if parts[0] in FOLDERS else None
    return parts[1] if len(parts) > 1 and parts[1] in FOLDERS else "ceilvo"


def stages() -> set[str]:
    """daemon/pipeline.py and every file of daemon that it comes to import, as daemon/x.py."""
    found: set[str] = set()
    todo = ["pipeline"]
    while todo:
        relative = f"daemon/{todo.pop()}.py"
        if relative not in found and (ROOT / relative).exists():
            found.add(relative)
            names = imported((ROOT / relative).read_text())
            todo += [n.split(".")[2] for n in names if n.startswith("ceilvo.daemon.")]
    return found


STAGES = stages()


def violations(relative: str, source: str) -> list[str]:
    """What a source at a path such as daemon/lines.py imports and may not."""
    folder = relative.partition("/")[0]
    allowed = ALLOWED[folder] | EXCEPTIONS.get(relative, set())
    out = []
    for name in sorted(imported(source)):
        target = folder_of(name)
        if name.startswith("."):
            out.append(f"{relative}: imports {name}, expected the absolute name")
        elif name.split(".")[0] in FOLDERS:
            out.append(f"{relative}: imports {name}, expected ceilvo.{name}")
        elif target is not None and target not in allowed:
            out.append(f"{relative}: imports {name}, expected only {', '.join(sorted(allowed))}")
        elif relative in STAGES and name.split(".")[0] in IMPURE:
            out.append(f"{relative}: a stage imports {name}, expected no clock, I/O, logging or threads")
        elif name.startswith("ceilvo.daemon.app.process") and not relative.startswith(
            ("daemon/cli.py", "daemon/app", "bench/")
        ):
            out.append(f"{relative}: imports {name}, expected only daemon/cli.py, daemon/app*.py and bench to")
    return out


@pytest.mark.parametrize("path", sources(), ids=lambda p: p.relative_to(ROOT).as_posix())
def test_a_source_keeps_the_rule(path: Path) -> None:
    assert violations(path.relative_to(ROOT).as_posix(), path.read_text()) == []


def test_all_sources_are_read() -> None:
    found = {p.relative_to(ROOT).parts[0] for p in sources()}
    assert found == {"ceilvo", *FOLDERS}
    assert len(sources()) > 20


def test_the_stages_are_found() -> None:
    """In the order in which data flows."""
    assert {f"daemon/{s}.py" for s in ("lines", "crossings", "odometry", "observation", "pfcf", "pipeline")} <= STAGES
    assert "daemon/cli.py" not in STAGES


def test_benches_are_loaded_only_when_asked_for() -> None:
    code = "import sys, ceilvo.daemon.cli; print(*(m for m in sys.modules if m.startswith('ceilvo.bench')))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == []


def test_folders_are_flat() -> None:
    """A sub-package that pyproject.toml does not list would be missing from the wheel without a word."""
    nested = [p for p in sources() if len(p.relative_to(ROOT).parts) != 2]
    assert nested == []


FORBIDDEN = [
    ("ceilvo/x.py", "from ceilvo.daemon import lines"),
    ("ceilvo/x.py", "import ceilvo.drivers.ports"),
    ("drivers/x.py", "from ceilvo.daemon.integrity.states import States"),
    ("drivers/x.py", "from ceilvo.sim import ceiling"),
    ("daemon/lines.py", "from ceilvo.drivers.ports import Camera"),
    ("daemon/cli.py", "from ceilvo.drivers.ports import Camera"),
    ("daemon/lines.py", "import time"),
    ("daemon/lines.py", "from threading import Thread"),
    ("daemon/lines.py", "def f():\n    from ceilvo.drivers import ports"),
    ("daemon/lines.py", "if TYPE_CHECKING:\n    import logging"),
    ("daemon/lines.py", "from . import edges"),
    ("daemon/lines.py", "import daemon.edges"),
    ("daemon/x.py", "import importlib\nimportlib.import_module('ceilvo.sim.ceiling')"),
    ("daemon/x.py", "from ceilvo import sim"),
    ("daemon/x.py", "from ceilvo.daemon.app.process import App"),
    ("daemon/app.py", "from ceilvo.calib import cli"),
    ("daemon/app.py", "from ceilvo.sim import ceiling"),
    ("daemon/app.py", "from ceilvo.bench import x"),
    ("calib/x.py", "import ceilvo.bench.x"),
    ("bench/x.py", "import ceilvo.calib.x"),
    ("sim/x.py", "import ceilvo.calib.x"),
]


@pytest.mark.parametrize(("path", "source"), FORBIDDEN, ids=[f"{p}: {s}".replace("\n", " ") for p, s in FORBIDDEN])
def test_a_forbidden_import_is_caught(path: str, source: str) -> None:
    assert len(violations(path, source)) == 1


PERMITTED = [
    ("daemon/app.py", "from ceilvo.drivers.ports import Camera\nimport threading"),
    ("daemon/app_experiment.py", "def f():\n    importlib.import_module('ceilvo.bench.paper.__main__')"),
    ("daemon/app_simulation.py", "from ceilvo.sim import ceiling\nfrom ceilvo.daemon.app.process import Plan"),
    ("daemon/cli.py", "from ceilvo.daemon.app.process import App\nimport time"),
    ("daemon/lines.py", "import numpy as np\nfrom ceilvo.types import Lines\nfrom ceilvo.daemon.vision.edges import x"),
    ("calib/cli.py", "from ceilvo.sim.rig import simulated_calibration"),
    ("ceilvo/x.py", "import daemonize, simplejson\nfrom ceilvo import se2"),
]


@pytest.mark.parametrize(("path", "source"), PERMITTED, ids=[p for p, _ in PERMITTED])
def test_a_permitted_import_is_not(path: str, source: str) -> None:
    assert violations(path, source) == []
