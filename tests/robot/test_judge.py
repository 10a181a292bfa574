"""The judge of the virtual robot must notice what it is there to notice."""

from __future__ import annotations

import dataclasses
import importlib.util
import json
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

SECOND_NS = 1_000_000_000
PERIOD_NS = SECOND_NS // 15
FRAMES = 300
STANDING = 15


def load(name: str, known_as: str) -> ModuleType:
    path = Path(__file__).with_name(name)
    spec = importlib.util.spec_from_file_location(known_as, path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[known_as] = module
    spec.loader.exec_module(module)
    return module


judge = sys.modules["judge"] = load("judge.py", "robot_judge")
judge_faults = load("judge_faults.py", "robot_judge_faults")


def pose(k: int, index: int, truth: Any, seq: int) -> dict[str, Any]:
    x, y, theta = truth[index]
    at = k * PERIOD_NS
    body = {"seq": seq, "stamp_ns": at + 10, "stamp_unix_ns": at + 10 + SECOND_NS, "state": "TRACKING", "age_ms": 9.0}
    body |= {"x_m": x, "y_m": y, "theta_rad": theta}
    return {"key": "ceilvo/r/pose", "recv_ns": at, "recv_unix_ns": at + SECOND_NS, "body": body}


def telegram(sample: dict[str, Any]) -> dict[str, Any]:
    b = sample["body"]
    fields = {"recv_unix_ns": sample["recv_unix_ns"] + 9e6, "age_s": 0.009, "state": b["state"], "sequence": b["seq"]}
    return {
        **fields,
        "x_m": round(b["x_m"], 4),
        "y_m": round(b["y_m"], 4),
        "theta_rad": round(b["theta_rad"], 5),
    }


@pytest.fixture
def run() -> Any:
    """A flawless run: a second of standing, a drive along x and back in heading, two more lives of the process."""
    truth = np.column_stack([np.linspace(0, 12, FRAMES), np.zeros(FRAMES), np.linspace(3.1, 3.2, FRAMES)])
    index = [0] * STANDING + list(range(1, FRAMES)) + [FRAMES - 1] * 40
    feed = np.array([(i, k * PERIOD_NS, k * PERIOD_NS + 20) for k, i in enumerate(index)], np.int64)
    life = [0, len(index) - 25, len(index) - 10, len(index)]
    seqs = [k - max(start for start in life[:3] if start <= k) for k in range(len(index))]
    poses = [pose(k, i, truth, seq) for k, (i, seq) in enumerate(zip(index, seqs, strict=True))]
    telegrams = [telegram(p) for p in poses]
    telegrams.append({**telegrams[-1], "state": "STOPPED"})
    facts = {
        "install_ms": "1",
        "verify": "",
        "exposure": "1.1",
        "check_config_status": "0",
        "start_status": "0",
        "found": "yes",
        "picture": "ffd8ffd9",
        "artists": "1 IDL",
    }
    facts |= {"status_without_camera": "no camera", "status_tracking": "TRACKING", "go_ns": "0", "played_ns": "1e9"}
    facts |= {"cpu_before_ns": "0", "cpu_after_ns": "1", "memory_bytes": "1", "kill_ready_ms": "900", "kill_ns": "0"}
    facts |= {"hang_ready_ms": "5000", "hang_ns": "0", "stop_ms": "200", "stop_code": "1", "stop_status": "0"}
    facts |= {"stop_result": "success", "leftovers": "/etc/ceilvo /var/lib/ceilvo ", "user_left": "0"}
    facts |= {"wrong_config": "status 78, restarts 0, failed", "in_phase": "end"}
    return judge.Run(facts, poses, telegrams, feed, truth, "started")


def failed(run: Any) -> set[str]:
    checks = judge.report(list(judge.checks(run)))["checks"]
    return {name for name, c in checks.items() if c["kept"] is False}


def test_flawless_run_passes(run: Any) -> None:
    assert failed(run) == set()
    error, index = judge.errors(run)
    assert np.abs(error).max() < 1e-12
    assert list(index) == list(range(1, FRAMES))
    summary = json.loads(json.dumps(judge.report(list(judge.checks(run)))))
    assert summary["ok"] is True
    assert summary["checks"]["position error RMS"]["value"] == pytest.approx(0, abs=1e-9)
    assert summary["checks"]["position error RMS"]["kept"] is True


def test_shifted_poses_are_noticed(run: Any) -> None:
    for s in run.poses:
        s["body"]["y_m"] += 0.06
    assert failed(run) == {"position error RMS", "of those published alike"}


def test_stamps_of_the_wrong_frame_are_noticed(run: Any) -> None:
    for s in run.poses:
        s["body"]["stamp_ns"] -= 2 * PERIOD_NS
    assert "position error RMS" in failed(run)


def test_lost_poses_are_noticed(run: Any) -> None:
    thin = dataclasses.replace(run, samples=[s for k, s in enumerate(run.samples) if k % 5])
    assert {"poses received", "of those published alike"} <= failed(thin)


def test_pose_that_only_the_base_saw_is_noticed(run: Any) -> None:
    run.telegrams[100]["x_m"] += 0.0002
    assert failed(run) == {"of those published alike"}
    wrong, judged = judge.unpublished(run)
    assert [t["sequence"] for t in wrong] == [100]
    assert judged == len(run.telegrams) - 1


def test_pose_sent_again_long_after_it_was_published_is_no_other_pose(run: Any) -> None:
    late = dict(run.telegrams[100], recv_unix_ns=run.telegrams[100]["recv_unix_ns"] + 4e9, age_s=4.009)
    run.telegrams.insert(101, late)
    assert failed(run) == set()
    late["x_m"] += 0.0002
    assert failed(run) == {"of those published alike"}


@pytest.mark.parametrize(
    ("change", "check"),
    [
        ({"kill_ready_ms": "5100"}, "ready after kill -9"),
        ({"stop_ms": "2100"}, "stopped in"),
        ({"stop_status": "9"}, "how it ended"),
        ({"verify": "Unknown key"}, "systemd-analyze verify"),
        ({"exposure": "1.2"}, "exposure"),
        ({"exposure": ""}, "exposure"),
        ({"found": ""}, "found by multicast"),
        ({"artists": "1 TS"}, "picture, by a process of its own"),
        ({"leftovers": "/etc/ceilvo /opt/ceilvo /var/lib/ceilvo"}, "left by uninstall"),
        ({"failed_phase": "drive"}, "phases"),
        ({"in_phase": "hang"}, "phases"),
        ({"wrong_config": "status 78, restarts 3, activating"}, "wrong configuration"),
    ],
)
def test_broken_promises_are_noticed(run: Any, change: dict[str, str], check: str) -> None:
    run.facts.update(change)
    assert failed(run) == {check}


def test_no_last_word_and_a_traceback_are_noticed(run: Any) -> None:
    run.telegrams.pop()
    crashed = dataclasses.replace(run, journal="Traceback (most recent call last):\n")
    assert failed(crashed) == {"last telegram", "Python tracebacks"}


def test_nothing_written_down_is_not_a_success(run: Any) -> None:
    empty = judge.Run({}, [], [], np.zeros((0, 3), np.int64), run.truth, "")
    assert {"poses of the drive", "of those published alike", "last telegram", "Python tracebacks"} <= failed(empty)


def fault_life(timed: bool, flagged_s: float = 0.2, recovered_s: float = 1.0) -> Any:
    """A robot whose camera stalled from 1 s to 4 s; poses come every 0.1 s."""
    facts = {"phase_stalled": "ok", "status_absent": "INIT: camera", "status_stall": "LOST", "rejected": "0"}
    facts |= {"in_phase": "end"}
    facts |= {"stall_begin_ns": "1000000000", "stall_end_ns": "4000000000"}
    facts |= {"kill1_ns": "5100000000", "life1_ns": "5300000000"}
    facts |= {"memory_same_process": "yes", "memory_end_ns": "8000000000", "calibration_end": "status 78, failed"}
    poses = []
    for k in range(100):
        t = k * SECOND_NS // 10 + 1
        bad = 1 + flagged_s <= 1e-9 * t <= 4 + recovered_s
        poses.append((t, "DEAD_RECKONING" if bad else "TRACKING", ""))
    return judge_faults.Life(facts, poses, "journal", timed)


def faults_failed(life: Any) -> set[str]:
    return {c.name for c in judge_faults.checks(life) if c.kept is False}


def test_a_robot_that_bears_its_faults_passes() -> None:
    assert faults_failed(fault_life(timed=True)) == set()


def test_late_and_slow_is_noticed_where_time_means_something() -> None:
    assert faults_failed(fault_life(True, 0.5, 3.0)) == {"stall: flagged after", "stall: good again after"}
    assert faults_failed(fault_life(False, 0.5, 3.0)) == set()


@pytest.mark.parametrize(("came_s", "kept"), [(9.8, True), (10.3, False), (None, False)])
def test_a_kill_counts_until_a_pose_of_the_next_life_comes(came_s: float | None, kept: bool) -> None:
    life = fault_life(timed=True)
    life.poses[:] = [p for p in life.poses if 1e-9 * p[0] < 5.3]
    if came_s is not None:
        life.poses.append((round(came_s * SECOND_NS), "TRACKING", ""))
    assert ("kill -9: next pose after" not in faults_failed(life)) == kept


def test_a_kill_that_nobody_survived_is_noticed() -> None:
    life = fault_life(timed=True)
    del life.facts["life1_ns"]
    assert "kill -9: next pose after" in faults_failed(life)


def test_a_fault_without_effect_or_end_is_noticed() -> None:
    broken = fault_life(timed=True)
    broken.facts.update(phase_stalled="failed", status_stall="TRACKING x=1", calibration_end="status 0, active")
    assert faults_failed(broken) == {"phases", "stall: STATUS=", "half a calibration"}
    assert judge.phases({"phase_disk": "failed, last waited for said full", "in_phase": "end"}).found == (
        "failed: disk, last waited for said full"
    )


judge_deb = load("judge_deb.py", "robot_judge_deb")
KEPT = "d7b60ee76e06c171 c9c83e54751bf975 "
PACKAGE = {
    **{"installed": "installed 0.1.0-1", "enabled": "enabled disabled disabled ", "active_at_first": "inactive"},
    **{
        "users": "3",
        "verify": "",
        "kernel": "True",
        "check_config_status": "0",
        "page": "yes",
    },
    **{"before_tracking": "yes", "kept_before": KEPT, "kept_after": KEPT, "upgraded": "installed 0.1.0-2"},
    **{"new_defaults": "config.yaml.dpkg-dist", "landmarks_before": "140", "landmarks_after": "144"},
    **{"restarted": "yes", "web_restarted": "active", "after_tracking": "yes", "removed": "config-files 0.1.0-2"},
    **{"active_removed": "inactive", "commands_removed": "", "kept_removed": KEPT, "map_removed": "yes"},
    **{"doctor": "kernel:OK map:OK unit:OK "},
    **{"purged": "none", "left": "", "users_left": "0", "in_phase": "end"},
}
BROKEN = {
    **{"failed_phase": "upgrade", "in_phase": "upgrade"},
    **{"enabled": "enabled enabled disabled", "active_at_first": "active", "kernel": "False", "users_left": "1"},
    **{"kept_after": "d7b60ee76e06c171 0", "kept_before": "", "landmarks_after": "3", "landmarks_before": "0"},
    **{
        "left": "/etc/ceilvo",
        "commands_removed": "/usr/bin/calib",
        "map_removed": "",
        "purged": "config-files 0.1.0-2",
    },
}


def test_a_package_that_keeps_every_promise_is_good_and_a_fact_that_is_missing_is_not() -> None:
    def broken(facts: dict[str, str], journal: str = "started") -> int:
        return sum(c.kept is False for c in judge_deb.checks(facts, journal))

    assert broken(PACKAGE) == 0
    for name, found in BROKEN.items():
        assert broken(PACKAGE | {name: found}) >= 1, name
    for name in PACKAGE:
        assert broken({k: v for k, v in PACKAGE.items() if k != name}) >= 1, name
    assert broken(PACKAGE, "") == broken(PACKAGE, "Traceback (most recent call last)") == 1
