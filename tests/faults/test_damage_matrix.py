"""Every file that the daemon reads or keeps, damaged in every way, then a run: no map is lost, and one line says so.

Each case is a process of its own, `ceilvod run` on a recording. Tests run some of the cases, `make damage-matrix` all.
"""

from __future__ import annotations

import os
import random
import re
import shutil
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
    EARLIER,
    KEPT,
    LENS,
    MAP,
    MARK,
    OLDEST,
    OWNER,
    POSE,
    RECORDER,
    STATE_FILES,
    TOKEN,
    ZENOH,
    Site,
    make_site,
    own_among,
    own_of,
)

from ceilvo.daemon.map.map_file import load_map, load_state
from ceilvo.daemon.map.store import Store
from ceilvo.errors import EXIT_CONFIG, FileFormatError
from ceilvo.sim.record import record
from ceilvo.sim.rig import simulated_calibration
from ceilvo.sim.world import World, WorldSpec

SHARE = os.environ.get("DAMAGES", "120")
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
    if name not in (MAP, EARLIER, OLDEST, POSE):
        return False
    try:
        (load_state if name == POSE else load_map)(path)
    except FileFormatError:
        return True
    return False


def lines_expected(site: Site, names: set[str]) -> dict[str, int]:
    """Of each damaged file of the state directory: one where the daemon meets it and cannot use it.

    It reads a map of an earlier run where the later ones cannot be used, and else sees whether it is a file, before it
    makes a new one.
    """
    met = {POSE, OWNER, MAP}
    if not site.path(MAP).exists() or unusable(site, MAP):
        met |= {EARLIER} | ({OLDEST} if not site.path(EARLIER).exists() or unusable(site, EARLIER) else set())
    else:
        met |= {n for n in (EARLIER, OLDEST) if not site.path(n).is_file()}
    lines = {n: int(n in met and unusable(site, n)) for n in names & {*KEPT}}
    recorder = site.path(RECORDER)
    shut = os.path.lexists(recorder) and not (recorder.is_dir() and os.access(recorder, os.W_OK | os.X_OK))
    return lines | {n: int(k) for n, k in {RECORDER: shut, MARK: site.path(MARK).is_dir()}.items() if n in names}


def reached_by_a_start(site: Site) -> int:
    """Own landmarks of the map that the next start uses, were it the next one now."""
    for name in (MAP, EARLIER, OLDEST):
        if site.path(name).exists() and not unusable(site, name):
            return own_of(site.path(name))
    return 0


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
