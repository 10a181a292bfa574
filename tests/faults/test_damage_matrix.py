"""Every file that the daemon reads or keeps, damaged in every way, then a run: no map is lost, and one line says so.

Each case is a process of its own, `ceilvod run` on a recording. Tests run some of the cases, `make damage-matrix` all.
"""

from __future__ import annotations

import os
import random
import re
import shutil
from collections import Counter
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import pytest
from daemon_forks import Forks
from damages import DAMAGES, SEED, Case, cases
from robot_site import (
    CONFIG,
    CONFIG_FILES,
    DATABASES,
    EARLIER,
    GOOD,
    KEPT,
    LENS,
    MAP,
    MARK,
    OLD,
    OLDEST,
    OWNER,
    POSE,
    RECORDER,
    STATE_FILES,
    TOKEN,
    ZENOH,
    Site,
    is_database,
    load_any,
    make_site,
    own_among,
    own_of,
)

from ceilvo.daemon.map.kept.store import Store
from ceilvo.daemon.map.map_file import load_map, load_state
from ceilvo.errors import EXIT_CONFIG, FileFormatError
from ceilvo.sim.record import record
from ceilvo.sim.rig import simulated_calibration
from ceilvo.sim.world import World, WorldSpec

SHARE = os.environ.get("DAMAGES", "36")
"""How many cases; `make damage-matrix` sets all."""
AT_ONCE = 2
LOCK_BYTES = 20
"""A file that is longer is no lock of a daemon, which has a process id in it."""
WORLD_SEED = 5


@dataclass(frozen=True)
class Outcome:
    """What became of a case.

    Attributes:
        lost: what was the most of the robot's own map in one file is in none any more, or not found by the next start.
        wrong: everything else that should be otherwise.
    """

    case: Case
    lost: bool
    traceback: bool
    wrong: tuple[str, ...]


@pytest.fixture(scope="module")
def frames(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("frames") / "drive"
    record(folder, World(WorldSpec(seed=WORLD_SEED), simulated_calibration(LENS)), seconds=1.2, fps=5.0)
    return folder


def chosen() -> list[Case]:
    """All, or so many by a fixed seed, with every file and every damage among them."""
    every = list(cases())
    if SHARE == "all":
        return every
    random.Random(SEED).shuffle(every)
    missing = {*STATE_FILES, *CONFIG_FILES, *DAMAGES}
    first = []
    for case in every:
        words = {word for spoilt in case.spoilt for word in spoilt}
        if words & missing:
            first.append(case)
            missing -= words
    return (first + [case for case in every if case not in first])[: int(SHARE)]


def examine(case: Case, root: Path, frames: Path, forks: Forks) -> Outcome | None:
    """None where it cannot be damaged like that."""
    site = make_site(root, frames, case.generations)
    if not case.spoil(site):
        shutil.rmtree(root)
        return None
    names = case.names
    before, most, reached = site.contents(), site.own_landmarks(), reached_by_a_start(site)
    lines = lines_expected(site, names)
    made_way = {n: raw for n, raw in before.items() if raw and unusable(site, n)}
    if usable(site, MAP):
        made_way.pop(GOOD, None)  # the next copy replaces it
    log = root / "log"
    code = forks.run(arguments(site, frames, names), log)
    text, after = log.read_text(errors="replace"), site.contents()
    complaints = [line for line in text.splitlines() if re.search("WARNING|ERROR|^ceilvod: ", line)]
    if code == EXIT_CONFIG and names & {*CONFIG_FILES}:
        wrong = refused_badly(complaints, before == after)
    else:
        wrong = [] if code == 0 else [f"exit code {code}"]
        wrong += [
            f"{said(n, complaints)} lines of {n}, expected {k}" for n, k in lines.items() if said(n, complaints) != k
        ]
        wrong += [f"what {n} held is gone" for n, raw in made_way.items() if raw not in after.values()]
    loaded = Store(site.state).load()
    found = 0 if loaded is None else own_among(loaded.map.landmarks)
    lost = site.own_landmarks() < most or found < reached
    shutil.rmtree(root)
    return Outcome(case, lost, "Traceback" in text, tuple(wrong))


def arguments(site: Site, frames: Path, names: set[str]) -> list[str]:
    """What must hold however the configuration was damaged."""
    values = {
        "camera.source": "folder",
        "camera.path": frames,
        "base.enabled": "false",
        "zenoh.enabled": "true" if names & {ZENOH, TOKEN} else "false",
        "zenoh.multicast": "false",
        "service.state_dir": site.state,
    }
    values |= {"zenoh.config_file": site.path(ZENOH)} if ZENOH in names else {}
    values |= {"zenoh.command_token_file": site.path(TOKEN)} if TOKEN in names else {}
    words = ["run", "--config", str(site.path(CONFIG)), "--summary", str(site.root / "summary.json")]
    return [*words, *(word for key, value in values.items() for word in ("--set", f"{key}={value}"))]


def refused_badly(complaints: list[str], untouched: bool) -> list[str]:
    """Of a daemon that did not start: a line for each mistake, and nothing else was done."""
    strange = [line for line in complaints if not any(f"/{name}" in line for name in CONFIG_FILES)]
    return (
        [f"lines about something else: {strange}"] * bool(strange)
        + ["no line"] * (not complaints)
        + ["the state directory was touched"] * (not untouched)
    )


def said(name: str, complaints: Iterable[str]) -> int:
    named = re.compile(rf"/{re.escape(name)}(?![\w.]*\w)")
    return sum(bool(named.search(line)) for line in complaints)


def unusable(site: Site, name: str) -> bool:
    """Whether a daemon that reads the file cannot use it."""
    path = site.path(name)
    if name == OWNER:
        small = path.is_file() and not path.is_symlink() and path.stat().st_size <= LOCK_BYTES
        return os.path.lexists(path) and not (small and os.access(path, os.R_OK | os.W_OK))
    if name not in (*DATABASES, OLD, POSE) or not os.path.lexists(path):
        return False
    try:
        if name in DATABASES:
            return not is_database(path) or load_any(path) is None
        (load_state if name == POSE else load_map)(path)
    except FileFormatError:
        return True
    return False


def usable(site: Site, name: str) -> bool:
    return os.path.lexists(site.path(name)) and not unusable(site, name)


def newer(site: Site, name: str) -> bool:
    """A database of a newer ceilvo is whole, but not for this one."""
    if not is_database(site.path(name)):
        return False
    try:
        load_any(site.path(name))
    except FileFormatError as e:
        return "newer ceilvo" in str(e)
    return False


def lines_expected(site: Site, names: set[str]) -> dict[str, int]:
    """Of each damaged file of the state directory: one where the daemon meets it and cannot use it.

    It reads the good copy where the map cannot be used, maps of earlier runs where neither can, and that of an older
    ceilvo last. Before it makes a new copy or a generation it sees whether what lies there is a file.
    """
    lines = Counter({n: int(unusable(site, n)) for n in (POSE, OWNER)})
    chain = [EARLIER, OLDEST, OLD]
    link = site.path(MAP).is_symlink() and site.path(MAP).is_file()
    lines[MAP] += link  # a copy of what it leads to is used
    lines[GOOD] += _is_no_file(site, GOOD) and (usable(site, MAP) or not site.path(GOOD).exists())
    if not usable(site, MAP):
        lines[MAP] += newer(site, MAP)
        gone = newer(site, MAP) or not os.path.lexists(site.path(MAP))
        if usable(site, GOOD):
            lines[MAP] += 2  # what is wrong, and that the copy is used
        elif site.path(GOOD).exists():
            lines.update((MAP, GOOD))
        else:
            lines[MAP] += not gone
    found = next((n for n in (MAP, GOOD, *chain) if usable(site, n)), None)
    if found not in (MAP, GOOD):
        met = chain if found is None else chain[: chain.index(found)]
        lines.update(n for n in met if unusable(site, n))
    if found is not None:
        lines.update(n for n in (EARLIER, OLDEST) if not lines[n] and _is_no_file(site, n))
    recorder = site.path(RECORDER)
    shut = os.path.lexists(recorder) and not (recorder.is_dir() and os.access(recorder, os.W_OK | os.X_OK))
    lines |= Counter({RECORDER: int(shut), MARK: int(site.path(MARK).is_dir())})
    return {n: lines[n] for n in names & {*KEPT, RECORDER, MARK}}


def _is_no_file(site: Site, name: str) -> bool:
    return os.path.lexists(site.path(name)) and not site.path(name).is_file()


def reached_by_a_start(site: Site) -> int:
    """Own landmarks of the map that the next start uses, were it the next one now."""
    return next((own_of(site.path(n)) for n in (*DATABASES, OLD) if usable(site, n)), 0)


def test_no_damage_of_any_file_destroys_a_map(tmp_path: Path, frames: Path) -> None:
    wanted = chosen()

    def share(first: int) -> list[Outcome | None]:
        with Forks() as forks:
            numbers = range(first, len(wanted), AT_ONCE)
            return [examine(wanted[n], tmp_path / str(n), frames, forks) for n in numbers]

    with ThreadPoolExecutor(AT_ONCE) as pool:
        outcomes = [o for part in pool.map(share, range(AT_ONCE)) for o in part if o is not None]
    lost, tracebacks = sum(o.lost for o in outcomes), sum(o.traceback for o in outcomes)
    print(f"\nDamage matrix: {len(outcomes)} cases, {lost} maps lost, {tracebacks} tracebacks (seed {SEED})")
    bad = [o for o in outcomes if o.lost or o.traceback or o.wrong]
    for o in bad:
        print(f"{o.case}:{' LOST' * o.lost}{' TRACEBACK' * o.traceback} {'; '.join(o.wrong)}")
    assert len(outcomes) > 0.6 * len(wanted) and not bad
