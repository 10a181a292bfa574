"""The house read from its sources without running them: modules, rooms (folders), imports, circles and the picture.

`python tests/common/house.py` prints the picture that docs/architecture.md quotes.
"""

from __future__ import annotations

import ast
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
FOLDERS = ("ceilvo", "daemon", "drivers", "calib", "sim", "bench")
FLOORS = (
    *("ceilvo", "vision", "odometry", "slam", "slam/paper", "relocalisation"),
    *("integrity", "pipeline", "replay", "refinement", "editing", "fleet", "shelf"),
    *("app", "doctor", "building", "cli", "start"),
)
"""From the ground up; all but the first are in daemon/. A floor imports itself and what lies below."""
ENTRANCES = ("daemon/pipeline", "daemon/cli", "daemon/start")
"""Files of daemon/ that are a floor of their own."""

Graph = Mapping[str, set[str]]


@dataclass(frozen=True)
class House:
    """Sources by their path, as in daemon/vision/edges.py; compiled modules by the path of their stub."""

    sources: Mapping[str, str]

    @cached_property
    def nodes(self) -> dict[str, list[ast.AST]]:
        """Path to every node of its code."""
        return {path: list(ast.walk(ast.parse(text))) for path, text in self.sources.items()}

    @cached_property
    def names(self) -> dict[str, set[str]]:
        """Path to the full names that it imports, at any depth of its code."""
        return {path: set(imported(nodes)) for path, nodes in self.nodes.items()}

    @cached_property
    def modules(self) -> dict[str, str]:
        """Full name to path."""
        return {module_of(path): path for path in self.sources}

    @cached_property
    def imports(self) -> dict[str, set[str]]:
        """Path to the paths of this house that it imports."""
        found = {path: {self.path_of(name) for name in names} for path, names in self.names.items()}
        return {path: {p for p in others if p is not None and p != path} for path, others in found.items()}

    @cached_property
    def rooms(self) -> dict[str, set[str]]:
        """Room to the rooms that it imports."""
        out: dict[str, set[str]] = {room_of(path): set() for path in self.sources}
        for path, others in self.imports.items():
            out[room_of(path)] |= {room_of(p) for p in others} - {room_of(path)}
        return out

    def path_of(self, name: str) -> str | None:
        """The file that holds what is imported under a full name; None when it is not of this house."""
        while name and name not in self.modules:
            name = name.rpartition(".")[0]
        return self.modules.get(name)


def read() -> House:
    """The house as it stands."""
    files = (p for folder in FOLDERS for p in sorted((ROOT / folder).rglob("*.py*")) if p.suffix in (".py", ".pyi"))
    return House({p.relative_to(ROOT).as_posix(): p.read_text(encoding="utf-8") for p in files})


def module_of(path: str) -> str:
    name = path.rpartition(".")[0].replace("/", ".").removesuffix(".__init__")
    return name if name.split(".")[0] == "ceilvo" else f"ceilvo.{name}"


def room_of(path: str) -> str:
    """The folder of a file; pipeline.py and cli.py are rooms of their own."""
    stem = path.rpartition(".")[0]
    return stem if stem in ENTRANCES else path.rpartition("/")[0]


def floor_of(room: str) -> int | None:
    """Place in FLOORS of a room of ceilvo/ or daemon/; None for one that is not on the stairs (daemon/map)."""
    if room.split("/")[0] == "ceilvo" or room == "daemon":
        return 0
    inside = room.removeprefix("daemon/")
    names = (inside, inside.partition("/")[0])  # kernel/ is a part of vision/, paper/ has a floor of its own
    return next((FLOORS.index(n) for n in names if n in FLOORS), None) if inside != room else None


def imported(nodes: Iterable[ast.AST]) -> Iterator[str]:
    """Full names of all that a source imports, import_module("x") as well; `from a import b` counts as a.b."""
    for node in nodes:
        if isinstance(node, ast.Import):
            yield from (a.name for a in node.names)
        elif isinstance(node, ast.ImportFrom):
            yield from (f"{'.' * node.level}{node.module or ''}.{a.name}" for a in node.names)
        elif isinstance(node, ast.Call) and name_of(node.func).rpartition(".")[2] in ("import_module", "__import__"):
            yield from (str(a.value) for a in node.args[:1] if isinstance(a, ast.Constant))


def name_of(node: ast.expr) -> str:
    """A name with its dots, as in np.random.normal; subscripts are passed over."""
    if isinstance(node, ast.Attribute):
        return f"{name_of(node.value)}.{node.attr}"
    if isinstance(node, ast.Subscript):
        return name_of(node.value)
    return node.id if isinstance(node, ast.Name) else ""


def circles(graph: Graph) -> list[list[str]]:
    """Sets of two or more that all reach one another, each sorted."""
    reach = {node: reached(graph, node) for node in graph}
    found = {tuple(sorted(b for b in reach[a] if a in reach.get(b, ()))) for a in graph if a in reach[a]}
    return [list(circle) for circle in sorted(found)]


def reached(graph: Graph, start: str) -> set[str]:
    seen: set[str] = set()
    todo = [start]
    while todo:
        new = graph.get(todo.pop(), set()) - seen
        seen |= new
        todo += new
    return seen


def picture(house: House) -> str:
    """Rooms from the top floor down, each with the rooms that it imports; all may import ceilvo, which is left out."""
    tops = ("bench", "calib", "daemon", "sim", "drivers", "ceilvo")
    stands_on = {room: len(reached(house.rooms, room)) for room in house.rooms}
    used = {room for others in house.rooms.values() for room in others}

    def height(room: str) -> tuple[int, int, int, str]:
        return tops.index(room.split("/")[0]), -(floor_of(room) or 0), -stands_on[room], room

    drawn = [room for room in sorted(house.rooms, key=height) if house.rooms[room] or room in used]
    width = max(map(len, drawn))
    lines = []
    for room in drawn:
        below = [r for r in sorted(house.rooms[room], key=height) if r.split("/")[0] != "ceilvo"]
        lines.append(f"{room:<{width}}  -> {', '.join(below)}" if below else room)
    return "\n".join(lines)


if __name__ == "__main__":
    print(picture(read()))
