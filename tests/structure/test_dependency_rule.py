"""The rules of the house (docs/architecture.md), read from the sources without running them.

- A room imports only what lies below it: FLOORS. daemon/map stands on ceilvo beside the stairs; only app, doctor,
  editing, refinement and fleet use it. Of the floors only relocalisation/filters.py, which makes filters, knows the
  rivals in slam/paper.
- The rooms up to pipeline.py are pure: no clock, I/O, logging, threads or randomness but a Generator with a seed.
- drivers import only ceilvo; only app, replay, doctor and fleet join them to the daemon; only app/simulation.py imports
  sim.
- Nobody imports bench or calib but themselves; bench/fuzz/targets reads what all of them read, calib's files too.
- No circles, of modules or of rooms. Small folders, small files, no folder written as a prefix, shallow classes.

`pytest -s` shows the graph of the rooms.
"""

from __future__ import annotations

import ast
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import PurePosixPath

import house
import pytest
from house import FLOORS, FOLDERS, ROOT, House, circles, floor_of, name_of, room_of

MAX_FILES = 12
MAX_LINES = 350
CROWDED = ("daemon/slam/paper",)
"""As many rivals as somebody writes."""

TOPS = {
    "ceilvo": {"ceilvo"},
    "drivers": {"ceilvo", "drivers"},
    "sim": {"ceilvo", "drivers", "daemon", "sim"},
    "daemon": {"ceilvo", "daemon"},
    "calib": {"ceilvo", "drivers", "daemon", "sim", "calib"},
    "bench": {"ceilvo", "drivers", "daemon", "sim", "bench"},
}
FLEET = ("daemon/fleet", "daemon/fleet/service", "daemon/fleet/robot")
JOIN_DRIVERS = ("daemon/app", "daemon/app/readers", "daemon/app/senses", "daemon/replay", "daemon/doctor", *FLEET[1:])
SIMULATION = "daemon/app/simulation.py"
FACTORY = "daemon/relocalisation/filters.py"
MAP = "daemon/map"
MAP_USERS = (
    *("daemon/app", "daemon/app/readers", "daemon/building", "daemon/doctor", "daemon/editing", "daemon/refinement"),
    *("daemon/shelf", *FLEET),
)
FUZZ = "bench/fuzz/targets"

PURE_UP_TO = FLOORS.index("pipeline")
PURE_LIBRARIES = {
    *("__future__", "abc", "collections", "dataclasses", "enum", "functools", "itertools", "math", "types", "typing"),
    *("numpy", "cv2", "ceilvo"),
}
IMPURE_CALLS = ("open", "print", "input", "exec", "eval")
GENERATORS = ("Generator", "default_rng")


# --- the rules: what of a house breaks each, in words that name the file


def imports_upward(h: House) -> Iterator[str]:
    for path, others in h.imports.items():
        yield from (f"{path} imports {other}" for other in sorted(others) if not may_import(path, other))


def may_import(path: str, other: str) -> bool:
    room, target = room_of(path), room_of(other)
    top, below = room.split("/")[0], target.split("/")[0]
    if below not in TOPS[top]:
        joins = (below == "drivers" and room in JOIN_DRIVERS) or (below == "calib" and room == FUZZ)
        return joins or (path == SIMULATION and below in ("drivers", "sim"))
    if top != "daemon" or below != "daemon" or room == target:
        return True
    if is_of_the_map(target):
        return room in MAP_USERS or is_of_the_map(room)
    if target == "daemon/slam/paper":
        return path == FACTORY
    mine, its = floor_of(room), floor_of(target)
    return mine is not None and its is not None and its <= mine


def is_of_the_map(room: str) -> bool:
    return room == MAP or room.startswith(f"{MAP}/")


def names_that_are_not_absolute(h: House) -> Iterator[str]:
    for path, names in h.names.items():
        for name in sorted(names):
            if name.startswith(".") or name.split(".")[0] in FOLDERS[1:]:
                yield f"{path} imports {name}, expected its full name from ceilvo on"


def rooms_without_a_floor(h: House) -> Iterator[str]:
    for path in h.sources:
        room = room_of(path)
        if room == "daemon" and not path.endswith("/__init__.py"):
            yield f"{path} is in no room"
        elif room.split("/")[0] in ("ceilvo", "daemon") and not is_of_the_map(room) and floor_of(room) is None:
            yield f"{path} is in a room that has no floor"


def impurities(h: House) -> Iterator[str]:
    for path, names in h.names.items():
        if not path.startswith("daemon/") or not 0 < (floor_of(room_of(path)) or 0) <= PURE_UP_TO:
            continue
        yield from (f"{path} imports {n}" for n in sorted(names) if _library(n) not in PURE_LIBRARIES)
        yield from (f"{path} imports {p}, which does I/O" for p in sorted(h.imports[path]) if _does_io(h, p))
        calls = (n for n in h.nodes[path] if isinstance(n, ast.Call))
        yield from (f"{path} calls {name_of(c.func)}" for c in calls if _is_impure(c))


def _library(name: str) -> str:
    return name.split(".")[0] or "ceilvo"


def _does_io(h: House, path: str) -> bool:
    return path.startswith("ceilvo/") and any(_library(n) not in PURE_LIBRARIES for n in h.names[path])


def _is_impure(call: ast.Call) -> bool:
    name = name_of(call.func)
    stem, _, last = name.rpartition(".")
    if stem.endswith("random") and last in GENERATORS:
        return not call.args and not call.keywords
    return name in IMPURE_CALLS or stem in ("np.random", "numpy.random")


def circles_of_modules(h: House) -> Iterator[str]:
    yield from (" <-> ".join(c) for c in circles(h.imports))


def circles_of_rooms(h: House) -> Iterator[str]:
    yield from (" <-> ".join(f"{room}/" for room in c) for c in circles(h.rooms))


def crowded_folders(h: House) -> Iterator[str]:
    """Mocks aside, and __init__.py, which holds a folder's sentence."""
    own = (PurePosixPath(p) for p in h.sources if p.endswith(".py"))
    count = Counter(p.parent.as_posix() for p in own if not p.name.startswith(("mock_", "__init__")))
    yield from (f"{f}/ holds {n} files" for f, n in count.items() if n > MAX_FILES and f not in CROWDED)


def folders_as_prefixes(h: House) -> Iterator[str]:
    """A name such as app_x.py outside of app/. `run` is what calib's steps and benches once began with."""
    rooms = {PurePosixPath(path).parent for path in h.sources}
    words = {(room.parts[0], word) for room in rooms for word in (*room.parts, "run")}
    for path in map(PurePosixPath, h.sources):
        prefix, underscore, _ = path.stem.partition("_")
        if underscore and (path.parts[0], prefix) in words and prefix not in path.parent.parts:
            yield f"{path} wears the folder {prefix}/ as a prefix"


def deep_classes(h: House) -> Iterator[str]:
    """Classes that inherit from more than one other class of ours; protocols and exceptions are no behaviour."""
    bases = {}
    for path, nodes in h.nodes.items():
        at = {n.asname or n.name: _full(i, n) for i in nodes if isinstance(i, ast.ImportFrom) for n in i.names}
        for node in nodes:
            if isinstance(node, ast.ClassDef):
                found = (name_of(base) for base in node.bases)
                bases[f"{house.module_of(path)}.{node.name}"] = [_resolve(b, at, house.module_of(path)) for b in found]

    def ours(name: str) -> set[str]:
        known = (b for b in bases.get(name, ()) if b in bases and "typing.Protocol" not in bases[b])
        return {x for b in known for x in (b, *ours(b))}

    for name in bases:
        if len(ours(name)) > 1 and not name.endswith("Error"):
            yield f"{name} inherits from {', '.join(sorted(ours(name)))}"


def _full(statement: ast.ImportFrom, name: ast.alias) -> str:
    return f"{statement.module}.{name.name}"


def _resolve(base: str, at: dict[str, str], module: str) -> str:
    first, dot, rest = base.partition(".")
    return f"{at[first]}{dot}{rest}" if first in at else f"{module}.{base}"


RULES: tuple[Callable[[House], Iterator[str]], ...] = (
    *(imports_upward, names_that_are_not_absolute, rooms_without_a_floor, impurities),
    *(circles_of_modules, circles_of_rooms, crowded_folders, folders_as_prefixes, deep_classes),
)


def long_files() -> Iterator[str]:
    """Of all code, tests and scripts as well."""
    files = (p for folder in (*FOLDERS, "systemd", "tests", "docs") for p in sorted((ROOT / folder).rglob("*.*")))
    code = (p for p in files if p.suffix in (".py", ".pyi", ".pyx", ".c", ".cpp", ".sh"))
    long = (p for p in code if p.read_text(encoding="utf-8").count("\n") > MAX_LINES)
    yield from (f"{p.relative_to(ROOT).as_posix()} is too long" for p in long)


# --- held


@pytest.fixture(scope="module")
def whole() -> House:
    return house.read()


def test_all_sources_are_read(whole: House) -> None:
    assert {p.split("/")[0] for p in whole.sources} == set(FOLDERS)
    assert len(whole.sources) > 150
    assert {f"daemon/{f}" for f in FLOORS[1:]} | {MAP} <= set(whole.rooms)
    assert len(whole.imports["daemon/pipeline.py"]) > 5


@pytest.mark.parametrize("rule", RULES, ids=lambda rule: rule.__name__)
def test_the_house_keeps(rule: Callable[[House], Iterator[str]], whole: House) -> None:
    assert list(rule(whole)) == []


def test_files_are_small() -> None:
    assert list(long_files()) == []


def test_the_graph_can_be_seen(whole: House) -> None:
    text = house.picture(whole)
    print("", text, sep="\n")
    order = [line.split()[0] for line in text.splitlines()]
    assert order.index("daemon/cli") < order.index("daemon/pipeline") < order.index("daemon/vision")
    assert order.index("daemon/vision") < order.index("drivers") < order.index("ceilvo")


# --- and each rule catches what it forbids

FORBIDDEN = [
    (imports_upward, "ceilvo/x.py", "from ceilvo.daemon.vision import edges"),
    (imports_upward, "ceilvo/x.py", "import ceilvo.drivers.ports"),
    (imports_upward, "drivers/x.py", "from ceilvo.daemon.integrity.states import States"),
    (imports_upward, "drivers/x.py", "from ceilvo.sim import ceiling"),
    (imports_upward, "daemon/vision/x.py", "from ceilvo.drivers.ports import Camera"),
    (imports_upward, "daemon/vision/x.py", "from ceilvo.daemon.odometry.rigid import rigid_motion"),
    (imports_upward, "daemon/odometry/x.py", "def f():\n    from ceilvo.daemon.slam import joint_rule"),
    (imports_upward, "daemon/slam/x.py", "from ceilvo.daemon.slam.paper.ukf import Ukf"),
    (imports_upward, "daemon/integrity/x.py", "from ceilvo.daemon.slam.paper.ukf import Ukf"),
    (imports_upward, "daemon/relocalisation/x.py", "from ceilvo.daemon.slam.paper.ukf import Ukf"),
    (imports_upward, "daemon/slam/x.py", "from ceilvo.daemon.map.map_file import load_map"),
    (imports_upward, "daemon/slam/x.py", "from ceilvo.daemon.map.database.rows import Rows"),
    (imports_upward, "daemon/map/x.py", "from ceilvo.daemon.slam import joint_rule"),
    (imports_upward, "daemon/map/database/x.py", "from ceilvo.daemon.slam import joint_rule"),
    (imports_upward, "daemon/replay/x.py", "from ceilvo.daemon.app import process"),
    (imports_upward, "daemon/replay/x.py", "from ceilvo.sim import ceiling"),
    (imports_upward, "daemon/cli.py", "from ceilvo.drivers.ports import Camera"),
    (imports_upward, "daemon/cli.py", "import importlib\nimportlib.import_module('ceilvo.bench.paper.run')"),
    (imports_upward, "daemon/cli.py", "from ceilvo import sim"),
    (imports_upward, "daemon/app/x.py", "from ceilvo.calib import cli"),
    (imports_upward, "daemon/app/x.py", "from ceilvo.sim import ceiling"),
    (imports_upward, "daemon/app/x.py", "from ceilvo.bench.paper import run"),
    (imports_upward, "calib/x.py", "import ceilvo.bench.paper.run"),
    (imports_upward, "bench/x.py", "import ceilvo.calib.cli"),
    (imports_upward, "sim/x.py", "import ceilvo.calib.cli"),
    (names_that_are_not_absolute, "daemon/vision/x.py", "from . import edges"),
    (names_that_are_not_absolute, "daemon/vision/x.py", "import daemon.vision.edges"),
    (rooms_without_a_floor, "daemon/x.py", ""),
    (rooms_without_a_floor, "daemon/attic/x.py", ""),
    (impurities, "daemon/vision/x.py", "import time"),
    (impurities, "daemon/vision/kernel/x.py", "from threading import Thread"),
    (impurities, "daemon/slam/paper/x.py", "if TYPE_CHECKING:\n    import logging"),
    (impurities, "daemon/pipeline.py", "from ceilvo.files import write_atomic"),
    (impurities, "daemon/integrity/x.py", "def f():\n    return open('x')"),
    (impurities, "daemon/slam/x.py", "import numpy as np\nx = np.random.normal()"),
    (impurities, "daemon/slam/x.py", "import numpy as np\nx = np.random.default_rng()"),
    (folders_as_prefixes, "daemon/doctor/app_x.py", ""),
    (folders_as_prefixes, "calib/run_x.py", ""),
    (deep_classes, "daemon/app/x.py", "class A: pass\nclass B(A): pass\nclass C(B): pass"),
    (deep_classes, "daemon/app/x.py", "class A: pass\nclass B: pass\nclass C(A, B): pass"),
    (deep_classes, "daemon/app/x.py", "from ceilvo.sim.ceiling import Child\nclass C(Child): pass"),
    (circles_of_modules, "sim/ceiling.py", "def f():\n    from ceilvo.drivers.ports import Camera\n"),
    (circles_of_rooms, "sim/x.py", "from ceilvo.drivers.ports import Camera\n"),
    (crowded_folders, "sim/f0.py", ""),
]
AROUND = {
    **{
        f"daemon/{name}.py": ""
        for name in ("vision/edges", "odometry/rigid", "slam/joint_rule", "slam/paper/ukf", "pipeline")
    },
    **{
        f"daemon/{name}.py": ""
        for name in ("app/process", "map/map_file", "map/database/rows", "integrity/states", "cli")
    },
    **{f"{name}.py": "" for name in ("calib/cli", "bench/paper/run", "sim/__init__", "ceilvo/types")},
    "ceilvo/files.py": "import os",
    "drivers/ports.py": "from ceilvo.sim.ceiling import x",
    "sim/ceiling.py": "class Parent: pass\nclass Child(Parent): pass",
    **{f"sim/f{i}.py": "" for i in range(1, MAX_FILES)},
}


@pytest.mark.parametrize(("rule", "path", "source"), FORBIDDEN)
def test_what_is_forbidden_is_caught(rule: Callable[[House], Iterator[str]], path: str, source: str) -> None:
    before, after = set(rule(House(AROUND))), set(rule(House({**AROUND, path: source})))
    assert len(after - before) == 1, after


PERMITTED = {
    "daemon/app/x.py": "from ceilvo.drivers import ports\nimport threading\nfrom ceilvo.daemon.map import map_file",
    "daemon/app/simulation.py": "from ceilvo.sim import ceiling\nfrom ceilvo.daemon.app.process import Plan",
    "daemon/cli.py": "from ceilvo.daemon.app.process import App\nimport time",
    "daemon/pipeline.py": "import numpy as np\nfrom ceilvo.daemon.slam import schedule\nrng = np.random.default_rng(7)",
    "daemon/relocalisation/filters.py": "from ceilvo.daemon.slam.paper.ukf import Ukf",
    "daemon/slam/paper/x.py": "from ceilvo.daemon.slam.joint_rule import JointRule\nclass A(JointRule): ...",
    "daemon/editing/x.py": "from ceilvo.daemon.map.database.rows import Rows",
    "daemon/map/database/rows.py": "from ceilvo.daemon.map import map_file",
    "daemon/map/map_file.py": "import os\nfrom ceilvo.types import Landmarks",
    "bench/fuzz/targets/x.py": "from ceilvo.calib import cli",
    "calib/cli.py": "from ceilvo.sim.f1 import x\nfrom ceilvo.daemon.pipeline import Pipeline",
    "ceilvo/x.py": "import daemonize, simplejson\nfrom ceilvo import files",
    "ceilvo/errors.py": "class A(Exception): ...\nclass BError(A): ...\nclass CError(BError): ...",
}


@pytest.mark.parametrize("path", PERMITTED)
def test_what_is_permitted_is_not(path: str) -> None:
    around = House(AROUND)
    found = House({**AROUND, path: PERMITTED[path]})
    assert [v for rule in RULES for v in rule(found) if v not in set(rule(around))] == []
