"""The place bench itself: robots stay in their rooms, faults do what they say, figures of histories by hand."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from ceilvo import se2
from ceilvo.bench.place import case as case_module
from ceilvo.bench.place import command, study_tables, tables
from ceilvo.bench.place.case import Case, cases, drive_in, run_case
from ceilvo.bench.place.ceiling.worlds import WorldSpec, make_world
from ceilvo.bench.place.faults import claims
from ceilvo.bench.place.faults.kinds import KINDS
from ceilvo.bench.place.faults.script import Kind, Site, carry
from ceilvo.bench.place.robot.drive import Conditions, Drive
from ceilvo.bench.place.robot.driver import Base, Driver, arc
from ceilvo.bench.place.robot.sights import CrossingSight, Seen
from ceilvo.bench.place.robot.tally import Tally, figures
from ceilvo.daemon.pipeline import Pipeline
from ceilvo.senses.heard import NOTHING, Heard
from ceilvo.sim.rig import simulated_calibration
from ceilvo.types import Crossings, Estimate, Pose, State, WheelMotion

ROOM = (0.0, 0.0, 5.0, 5.0)
SPEC = WorldSpec("5", 0.6, "raster", 1)
RIGHT, OFF, TURNED = (0.0, 0.0), (0.5, 0.0), (0.0, 0.2)
STILL, DRIVES = (0.0, 0.0), (0.05, 0.0)


def drive(wheels: bool = True, seed: int = 1) -> Drive:
    return drive_in(make_world(SPEC), np.random.default_rng(seed), wheels, 10.0, True, 0.5)


# --- robots


@pytest.mark.parametrize("laps", [True, False])
def test_a_robot_drives_about_its_room_and_stays_in_it(laps: bool) -> None:
    driver = Driver(ROOM, laps, 0.6, np.random.default_rng(2))
    pose = driver.start()
    path, twists = [pose], []
    for _ in range(3000):
        v, w = driver.twist(pose, 0.1)
        twists.append((v, w))
        pose = se2.compose(pose, arc(v, w, 0.1))
        path.append(pose)
    xy, v, w = np.array(path)[:, :2], *np.array(twists).T
    assert xy.min() > 0.3 and xy.max() < 4.7
    assert np.ptp(xy, axis=0).min() > 2.0
    assert v.max() == pytest.approx(0.6, rel=0.05) and v.min() > -0.05
    assert np.abs(np.diff(v)).max() < 0.051 and np.abs(np.diff(w)).max() < 0.21
    assert np.sum(v) * 0.1 > 60.0


def test_a_base_says_what_the_wheels_turned() -> None:
    base, rng = Base(np.random.default_rng(3)), np.random.default_rng(4)
    pose, errors = np.zeros(3), []
    for k in range(1, 400):
        moved = arc(0.5, float(rng.uniform(-1.0, 1.0)), 0.1)
        pose = se2.compose(pose, moved)
        base.turned(moved, k * 100_000_000)
        if k > 1:
            said = base.between((k - 1) * 100_000_000, k * 100_000_000)
            assert said is not None
            errors.append((said.prev_from_curr - moved) / np.sqrt(np.diag(said.cov)))
    spread = np.std(errors, axis=0)
    assert np.all(spread > 0.3) and np.all(spread < 1.5)


# --- faults


class TruthTeller(CrossingSight):
    """Instead of the pipeline an estimate that is the truth, and a log of what was given."""

    given: list[tuple[int, Seen, WheelMotion | None]]

    def give(
        self,
        pipeline: Pipeline,
        stamp_ns: int,
        seen: Crossings | None,
        wheels: WheelMotion | None,
        heard: Heard = NOTHING,
    ) -> Estimate:
        estimate = pipeline.step_crossings(stamp_ns, None, wheels, missing="not looked at", heard=heard)
        self.given.append((stamp_ns, seen, wheels))
        return estimate


def teller(d: Drive) -> TruthTeller:
    assert isinstance(d.camera, CrossingSight)
    t = TruthTeller(d.camera.eye, simulated_calibration(), d.rng)
    t.given = []
    d.camera = t
    return t


def walk(d: Drive, script: Iterator[None]) -> list[tuple[np.ndarray, bool]]:
    """Poses in the room, and whether something is the matter, frame after frame."""
    plain = matter(Conditions(d.conditions.wheels))
    seen = []
    for _ in script:
        odd = matter(d.conditions) != plain
        d.tick()
        seen.append((d.room_pose.copy(), odd))
    return seen


def matter(c: Conditions) -> tuple[object, ...]:
    """All but the robot's speed, so that two can be compared."""
    sight = (c.sight.scale, c.sight.yaw_rad, c.sight.shift_m, c.sight.recall, c.sight.blind)
    sights = (*sight, len(c.sight.hidden), len(c.sight.ghosts_m))
    signals = (c.dark, c.silent, c.skipped, c.clock, c.stamp_jump_ns, c.wheels, c.wheels_late_s)
    return (*sights, *signals, c.picture, c.slip, c.carried is None)


@pytest.mark.parametrize("name", KINDS)
def test_every_fault_can_happen_and_ends(name: str) -> None:
    kind: Kind = KINDS[name]
    d = drive(kind.wheels[0])
    teller(d)
    d.go(3.0)
    d.tally = Tally()
    before, daemon = d.pipeline, d.camera.eye.features  # type: ignore[attr-defined]
    odd = [o for _, o in walk(d, kind.script(d, Site(0.6, make_world(SPEC))))]
    assert d.tally.marked
    changed = d.pipeline is not before or d.camera.eye.features is not daemon  # type: ignore[attr-defined]
    told = kind.script.__module__ == claims.__name__
    assert any(odd) or changed or told
    assert matter(d.conditions) == matter(Conditions(kind.wheels[0]))
    assert np.all(d.room_pose[:2] > -0.2) and np.all(d.room_pose[:2] < 5.2)


@pytest.mark.parametrize(("name", "tiles"), [("carried 1 tile dark", 1), ("carried 2 tiles dark", 2)])
def test_carried_robots_end_whole_tiles_away_in_the_dark_with_their_wheels_standing(name: str, tiles: int) -> None:
    for seed in range(4):
        d = drive(seed=seed)
        camera = teller(d)
        d.go(3.0)
        script = KINDS[name].script(d, Site(0.6))
        poses = np.array([p for p, _ in walk(d, script)])
        carried = np.array([seen is None for _, seen, _ in camera.given[-len(poses) :]])
        way = poses[np.flatnonzero(carried)[-1]] - poses[np.flatnonzero(carried)[0] - 1]
        whole = np.abs(way[:2]) / 0.6
        assert np.allclose(whole, np.round(whole), atol=1e-6) and np.round(whole).max() == tiles
        assert way[2] == pytest.approx(0.0, abs=1e-9)
        wheels = [w.prev_from_curr for (_, s, w) in camera.given[-len(poses) :] if s is None and w is not None]
        assert np.abs(wheels).max() < 2e-4


def test_stamps_that_fall_behind_do_and_wheels_follow_them() -> None:
    d = drive()
    camera = teller(d)
    d.go(4.0)
    walk(d, KINDS["stamps behind"].script(d, Site(0.6)))
    stamps = np.array([s for s, _, _ in camera.given])
    assert np.diff(stamps)[:30] == pytest.approx(1e8) and np.diff(stamps)[-150:] == pytest.approx(0.8e8)


def test_a_carried_robot_is_where_it_was_brought_in_small_steps() -> None:
    d = drive()
    teller(d)
    to = np.array([3.0, 2.0, 1.0])
    poses = np.array([p for p, _ in walk(d, carry(d, to, 2.0))])
    assert np.allclose(poses[-1], to)
    assert np.hypot(*np.diff(poses[:, :2], axis=0).T).max() < 0.4


# --- figures


def told(history: list[tuple[float, State, tuple[float, float], tuple[float, float]]], tally: Tally) -> Tally:
    for seconds, state, off, moved in history:
        for _ in range(round(seconds * 10)):
            tally.add(0.1, state, off, moved, "by hand")
    return tally


def test_wrong_seconds_and_the_time_to_say_so() -> None:
    t = Tally()
    t.effect()
    told([(2.0, State.TRACKING, OFF, STILL), (3.0, State.TRACKING, OFF, DRIVES)], t)
    assert figures(t)["wrong_now"]
    told([(1.0, State.RELOCALISING, OFF, DRIVES), (2.0, State.DEGRADED, TURNED, DRIVES)], t)
    told([(4.0, State.LOST, OFF, DRIVES)], t)
    f = figures(t)
    assert f["wrong_s"] == {"TRACKING": pytest.approx(5.0), "DEGRADED": pytest.approx(2.0)}
    assert f["say_s"] == pytest.approx(6.0, abs=0.15)  # from the first motion to the last wrong claim
    assert not f["wrong_now"] and f["alarms"] == 2
    assert f["worst_m"] == {"TRACKING": 0.5, "DEGRADED": 0.0} and f["worst_rad"]["DEGRADED"] == pytest.approx(0.2)


def test_a_pose_within_the_limits_is_not_wrong() -> None:
    t = told([(5.0, State.TRACKING, (0.29, 0.08), DRIVES), (5.0, State.DEAD_RECKONING, (9.0, 3.0), DRIVES)], Tally())
    assert figures(t)["wrong_s"] == {}


def test_recovery_counts_from_the_faults_end_to_a_right_pose_that_stays() -> None:
    t = told([(3.0, State.TRACKING, RIGHT, DRIVES)], Tally())
    t.over()
    told([(2.0, State.LOST, OFF, DRIVES), (0.5, State.TRACKING, RIGHT, DRIVES), (2.0, State.TRACKING, OFF, DRIVES)], t)
    assert t.recovered_s is None
    told([(3.0, State.TRACKING, RIGHT, DRIVES)], t)
    assert t.recovered_s == pytest.approx(4.6, abs=0.15)
    assert t.recovered_m == pytest.approx(2.3, abs=0.1)


def case_result(
    kind: str, wrong: float, say: float, recovered: float | None, metres: float | None, told_m: float | None = 1.0
) -> dict[str, object]:
    tally = told([(10.0, State.TRACKING, RIGHT, DRIVES)], Tally())
    f = figures(tally) | {"wrong_s": {"TRACKING": wrong} if wrong else {}, "say_s": say}
    f |= {"recovered_s": recovered, "recovered_m": metres, "told_s": told_m and 20.0, "told_m": told_m}
    about = {
        "kind": kind,
        "settled": True,
        "failed": None,
        "before": figures(Tally()),
        "fault": f,
        "number": 0,
        "seed": 0,
    }
    about |= {"size": "5", "tile_m": 0.6, "lamps": "raster", "wheels": True, "map": "known", "eye": "", "rate_hz": 10.0}
    return about | {"step_ms": {"median": 1.0, "p99": 2.0}}


def test_bars_are_the_issues() -> None:
    good = [case_result("snatched", 0.0, 0.5, 20.0, 9.0) for _ in range(19)]
    bars = tables.fault_bars([*good, case_result("snatched", 0.0, 0.9, 16.0, 11.0)])
    assert [b.verdict for b in bars] == ["PASS"] * 8
    bars = tables.fault_bars([*good, case_result("snatched", 0.1, 1.2, None, None), case_result("ramp", 0.0, 0, 1, 1)])
    assert [b.verdict for b in bars] == ["MISS", "PASS", "PASS", "PASS", "MISS", "PASS", "PASS", "MISS"]
    lost = [case_result("snatched", 0.0, 0.5, None, None, told_m) for told_m in (None, 11.0, 9.0)]
    assert [b.text for b in tables.carried_bars([*good, *lost])][1:3] == ["19 of 22", "19 of 20"]
    assert any("snatched" in line for line in tables.worst_cases([case_result("snatched", 2.0, 1.2, None, None)], 3))


def test_a_start_that_was_wrong_counts_as_no_start() -> None:
    step = {"median": 10.0, "p99": 20.0}
    right = {"right": True, "failed": None, "found_m": 2.0, "wheels": True, "run": figures(Tally()), "step_ms": step}
    wrong = right | {"run": figures(Tally()) | {"wrong_s": {"TRACKING": 1.0}}}
    assert [b.verdict for b in study_tables.start_bars([right, right])] == ["PASS"] * 3
    assert [b.verdict for b in study_tables.start_bars([wrong, wrong])] == ["MISS", "MISS", "PASS"]
    told = right | {"run": figures(Tally()) | {"told_m": 1.5}}
    assert study_tables.start_bars([told, told])[1].text == "2.0, 1.5 at best"


# --- all of it


def test_cases_are_of_every_kind_in_turn() -> None:
    todo = cases(("ramp", "faint"), 5, 7, ("5",))
    assert [c.kind for c in todo] == ["ramp", "faint", "ramp", "faint", "ramp"]
    assert len({c.number for c in todo}) == 5


def test_a_daemon_that_runs_out_of_memory_is_a_failed_case(monkeypatch: pytest.MonkeyPatch) -> None:
    def tick(self: Drive) -> None:
        raise MemoryError("5 GiB")

    monkeypatch.setattr(case_module, "_LEARN_S", 0.0)
    monkeypatch.setattr(Drive, "tick", tick)
    result = run_case(Case("faint", 3, 4, ("5",)))
    assert not result["settled"] and "5 GiB" in result["failed"]
    assert "MISS" in [b.verdict for b in tables.fault_bars([result])]


def test_a_case_runs_through_the_daemon_and_is_the_same_every_time(monkeypatch: pytest.MonkeyPatch) -> None:
    for name, seconds in (("_LEARN_S", 20.0), ("_AFTER_S", 3.0), ("_AFTER_MOST_S", 5.0)):
        monkeypatch.setattr(case_module, name, seconds)
    case = Case("faint", 3, 4, ("5",))
    first, again = run_case(case), run_case(case)
    for result in (first, again):
        result.pop("step_ms")
    assert first == again
    assert first["settled"] and first["fault"]["seconds"] > 12.0
    assert sum(first["fault"]["state_s"].values()) == pytest.approx(first["fault"]["seconds"])


def test_the_command_writes_what_it_found_and_goes_on_where_it_was(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    ran = []

    def run(case: Case) -> dict[str, object]:
        ran.append(case)
        return case_result(case.kind, 0.0, 0.0, 1.0, 1.0)

    monkeypatch.setattr(command, "run_case", run)
    out = tmp_path / "f.json"
    arguments = ["faults", "--kinds", "ramp,faint", "--seed", "5", "--out", str(out)]
    assert command.main([*arguments, "--count", "2"]) == 0
    assert command.main([*arguments, "--count", "4", "--resume"]) == 0
    assert [c.number for c in ran] == [0, 1, 2, 3]
    summary = json.loads(out.read_text())
    assert len(summary["runs"]) == 4 and summary["bars"][0]["verdict"] == "PASS"
    assert "(tuning)" in capsys.readouterr().out
    assert command.main(["faults", "--kinds", "flood", "--out", str(out)]) != 0
    assert "flood" in capsys.readouterr().err


def test_poses_are_of_the_map_not_of_the_room() -> None:
    d = drive()
    d.map_from_room = np.array([1.0, 2.0, 0.5])
    assert np.allclose(se2.between(d.map_from_room, d.pose), d.room_pose)
    assert isinstance(Pose(d.pose), np.ndarray)


@pytest.mark.parametrize(
    "name", ["faults", "carried", "restart", "laps", "start", "renovated", "heights", "case", "eye-check"]
)
def test_every_command_has_help_that_keeps_seeds_apart(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as end:
        command.main([name, "--help"])
    assert end.value.code == 0
    text = " ".join(capsys.readouterr().out.split())
    assert "--seed" in text and (name == "eye-check" or "1000 and more for figures" in text)
