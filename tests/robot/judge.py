"""Compares what the virtual robot did with the truth and with what was promised; a table and summary.json.

judge.py OUT SHARE SUMMARY; exit status 1 when a promise is broken. Knows the messages, not ceilvo's code.
"""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

POSITION_RMS_M = 0.05
DRIVEN_M = 10.0
FED_HZ = 14.0
RESTART_S = 5.0
STOP_S = 2.0
EXPOSURE = 1.1
_PICTURE = "ffd8ffd9 by 1 IDL"
"""Both ends of a JPEG."""
MIN_SHARE_OF_FRAMES = 0.9
LENGTH_UNIT_M = 1e-4
ANGLE_UNIT_RAD = 1e-5
SLACK_NS = 5e8
"""Between the two clocks: the way of a telegram over the line; lives are further apart."""


@dataclass(frozen=True)
class Check:
    """One promise: what was found, what was promised, whether it was kept (None: a figure without a promise)."""

    name: str
    found: str
    promise: str = ""
    kept: bool | None = None
    value: float | None = None


@dataclass(frozen=True)
class Run:
    """Everything that was written down."""

    facts: dict[str, str]
    samples: list[dict[str, Any]]
    telegrams: list[dict[str, Any]]
    feed: NDArray[np.int64]
    truth: Array
    journal: str

    @property
    def poses(self) -> list[dict[str, Any]]:
        return [s for s in self.samples if s["key"].endswith("/pose")]

    def number(self, name: str) -> float:
        try:
            return float(self.facts[name])
        except (KeyError, ValueError):
            return math.nan


def read(out: Path, share: Path) -> Run:
    facts = dict(line.split("=", 1) for line in _text(out / "facts.txt").splitlines())
    feed = np.loadtxt(out / "feed.csv", np.int64, delimiter=",", ndmin=2) if (out / "feed.csv").exists() else None
    return Run(
        facts,
        _json_lines(out / "samples.jsonl"),
        _json_lines(out / "telegrams-drive.jsonl"),
        np.zeros((0, 3), np.int64) if feed is None else feed,
        np.loadtxt(share / "truth.csv", delimiter=","),
        _text(out / "service.txt"),
    )


def checks(run: Run) -> Iterator[Check]:
    yield from _installation(run)
    yield from _drive(run)
    yield from _base(run)
    yield from _life(run)


def _installation(run: Run) -> Iterator[Check]:
    f = run.facts
    yield phases(f)
    yield Check("installed in", f"{run.number('install_ms') / 1e3:.1f} s")
    yield Check("systemd-analyze verify", repr(f.get("verify")), "''", f.get("verify") == "")
    exposure = run.number("exposure")
    yield Check("exposure", f"{exposure:.1f}", f"<= {EXPOSURE}", exposure <= EXPOSURE)
    yield Check("check-config", f.get("check_config_status", "-"), "0", f.get("check_config_status") == "0")
    yield Check("start without camera", f"status {f.get('start_status')}", "0", f.get("start_status") == "0")
    status = f.get("status_without_camera", "")
    yield Check("STATUS= without camera", status, "names it", "camera" in status.lower())
    yield Check("found by multicast", f.get("found", "no"), "yes", f.get("found") == "yes")
    picture = f"{f.get('picture', 'none')} by {f.get('artists', '-')}"
    yield Check("picture, by a process of its own", picture, _PICTURE, picture == _PICTURE)
    status = f.get("status_tracking", "")
    yield Check("STATUS= at the end", status, "has TRACKING", "TRACKING" in status)


def phases(f: Mapping[str, str]) -> Check:
    """Whether all that should happen did, and the guest came to its end."""
    failed = [f["failed_phase"]] if "failed_phase" in f else []
    failed += [k[6:] + v.removeprefix("failed") for k, v in f.items() if k.startswith("phase_") and v != "ok"]
    bad = [f"failed: {', '.join(failed)}"] if failed else []
    if f.get("in_phase") != "end":
        bad.append(f"the guest stood still in {f.get('in_phase', 'its beginning')}")
    return Check("phases", "; ".join(bad) or "all", "all", not bad)


def errors(run: Run) -> tuple[Array, NDArray[np.int64]]:
    """(N, 3) pose minus truth of every pose whose frame was part of the drive, and (N,) index of that frame.

    The frame is the last one whose write began before the pose's stamp.
    """
    found, index = [], []
    for s in run.poses:
        k = int(np.searchsorted(run.feed[:, 1], s["body"]["stamp_ns"], side="right")) - 1
        if k < 0 or not _driving(run, k):
            continue
        b, i = s["body"], int(run.feed[k, 0])
        d = np.array([b["x_m"], b["y_m"], b["theta_rad"]]) - run.truth[i]
        d[2] = math.remainder(d[2], 2 * math.pi)
        found.append(d)
        index.append(i)
    return np.array(found).reshape(-1, 3), np.array(index, np.int64)


def _driving(run: Run, k: int) -> bool:
    """Whether write k is the first of its frame: first and last frame are repeated while the robot stands."""
    return k > 0 and bool(run.feed[k, 0] != run.feed[k - 1, 0])


def _drive(run: Run) -> Iterator[Check]:
    error, index = errors(run)
    driven = float(np.hypot(*np.diff(run.truth[:, :2], axis=0).T).sum())
    fed = int(np.count_nonzero(np.diff(run.feed[:, 0]))) if len(run.feed) else 0
    if fed == 0 or len(error) == 0:
        yield Check("poses of the drive", f"{len(error)} of {fed} frames", "some", False)
        return
    covered = float(np.hypot(*np.diff(run.truth[np.unique(index), :2], axis=0).T).sum())
    moving = np.flatnonzero(np.diff(run.feed[:, 0])) + 1
    rate = (len(moving) - 1) / ((run.feed[moving[-1], 1] - run.feed[moving[0], 1]) / 1e9)
    distance = np.hypot(error[:, 0], error[:, 1])
    rms, worst = float(np.sqrt(np.mean(distance**2))), float(distance.max())
    heading = math.degrees(float(np.sqrt(np.mean(error[:, 2] ** 2))))
    share = len(np.unique(index)) / fed
    yield Check(
        "driven", f"{covered:.2f} m of {driven:.2f} m", f">= {DRIVEN_M:.0f} m", bool(covered >= DRIVEN_M), covered
    )
    found = f"{rate:.2f} Hz, {fed} of {len(run.truth) - 1} frames"
    yield Check("fed at", found, f">= {FED_HZ:.0f} Hz, else the host is too busy", bool(rate >= FED_HZ), float(rate))
    yield Check("poses received", f"{100 * share:.1f} % of frames", f">= {100 * MIN_SHARE_OF_FRAMES:.0f} %",
                share >= MIN_SHARE_OF_FRAMES)  # fmt: skip
    yield Check("position error RMS", f"{rms:.4f} m", f"<= {POSITION_RMS_M} m", rms <= POSITION_RMS_M, rms)
    yield Check("position error max", f"{worst:.4f} m", value=worst)
    yield Check("heading error RMS", f"{heading:.3f} deg", value=heading)
    states = [s["body"]["state"] for s in run.poses if s["recv_unix_ns"] > run.number("go_ns")]
    yield Check("states", ", ".join(f"{k} {states.count(k)}" for k in dict.fromkeys(states)))
    ages = [s["body"]["age_ms"] for s in run.poses]
    yield Check("age when sent", f"median {np.median(ages):.1f} ms, p99 {np.percentile(ages, 99):.1f} ms")
    seconds = (run.number("played_ns") - run.number("go_ns")) / 1e9
    cpu = (run.number("cpu_after_ns") - run.number("cpu_before_ns")) / 1e9
    yield Check("processor, memory", f"{100 * cpu / seconds:.0f} % of one, {run.number('memory_bytes') / 1e6:.0f} MB")


def unpublished(run: Run) -> tuple[list[dict[str, Any]], int]:
    """Telegrams that no pose sample explains, and how many could be judged.

    Sequence numbers start again with each life of the process; a telegram belongs to the life in which its frame was
    captured. Not judged: frames from before the subscriber was connected to that life, what a process says before
    its first estimate (INIT) and its last word (STOPPED).
    """
    lives = _lives(run.poses)
    wrong, judged = [], 0
    for t in run.telegrams:
        silent = t["state"] == "INIT" and not (t["x_m"] or t["y_m"] or t["theta_rad"])
        samples = [s for life in lives if _belongs(t, life) for s in life]
        if silent or t["state"] == "STOPPED" or not samples:
            continue
        judged += 1
        if not any(s["body"]["seq"] == t["sequence"] and _same_pose(t, s["body"]) for s in samples):
            wrong.append(t)
    return wrong, judged


def _belongs(telegram: dict[str, Any], life: list[dict[str, Any]]) -> bool:
    first, last = life[0]["body"], life[-1]["body"]
    captured_ns = telegram["recv_unix_ns"] - 1e9 * telegram["age_s"]
    near = first["stamp_unix_ns"] - SLACK_NS <= captured_ns <= last["stamp_unix_ns"] + SLACK_NS
    return bool(near and telegram["sequence"] >= first["seq"])


def _lives(poses: list[dict[str, Any]]) -> list[list[dict[str, Any]]]:
    """The poses of each process."""
    out: list[list[dict[str, Any]]] = []
    for s in poses:
        if not out or s["body"]["seq"] < out[-1][-1]["body"]["seq"]:
            out.append([])
        out[-1].append(s)
    return out


def _same_pose(telegram: dict[str, Any], body: dict[str, Any]) -> bool:
    dx, dy = (abs(telegram[k] - body[k]) for k in ("x_m", "y_m"))
    dth = abs(math.remainder(telegram["theta_rad"] - body["theta_rad"], 2 * math.pi))
    return bool(max(dx, dy) <= 0.51 * LENGTH_UNIT_M and dth <= 0.51 * ANGLE_UNIT_RAD)


def _base(run: Run) -> Iterator[Check]:
    wrong, judged = unpublished(run)
    found = f"{judged - len(wrong)} of {judged}" + (f", first other: {wrong[0]['sequence']}" if wrong else "")
    yield Check("telegrams at the base", str(len(run.telegrams)))
    yield Check("of those published alike", found, "all", judged > 0 and not wrong)
    last = run.telegrams[-1]["state"] if run.telegrams else "-"
    yield Check("last telegram", last, "STOPPED", last == "STOPPED")


def _life(run: Run) -> Iterator[Check]:
    f = run.facts
    ready = run.number("kill_ready_ms") / 1e3
    yield Check("ready after kill -9", f"{ready:.2f} s", f"<= {RESTART_S:.0f} s", ready <= RESTART_S, ready)
    lives = _lives(run.poses)
    for k, name in enumerate(("kill", "hang"), 1):
        if name == "hang":
            found = f"{run.number('hang_ready_ms') / 1e3:.2f} s"
            yield Check("ready after hanging", found, "by the watchdog", "hang_ready_ms" in f)
        again = (lives[k][0]["recv_unix_ns"] - run.number(f"{name}_ns")) / 1e9 if len(lives) > k else math.nan
        yield Check(f"publishing after {name}", f"{again:.2f} s", "again", len(lives) == 3)
    yield Check("pose after restarts", _restarted_error(run, lives))
    stop = run.number("stop_ms") / 1e3
    yield Check("stopped in", f"{stop:.2f} s", f"<= {STOP_S:.0f} s", stop <= STOP_S, stop)
    how = f"code {f.get('stop_code')} status {f.get('stop_status')} {f.get('stop_result')}"
    yield Check("how it ended", how, "exited, 0", how == "code 1 status 0 success")
    wrong = f.get("wrong_config", "-")
    yield Check("wrong configuration", wrong, "78, stays down", wrong == "status 78, restarts 0, failed")
    tracebacks = run.journal.count("Traceback (most recent call last)")
    yield Check("Python tracebacks", str(tracebacks), "0", tracebacks == 0 and bool(run.journal))
    left = f.get("leftovers", "-").split()
    kept = ["/etc/ceilvo", "/var/lib/ceilvo"]
    yield Check("left by uninstall", " ".join(left), "config, state", left == kept and f.get("user_left") == "0")


def _restarted_error(run: Run, lives: list[list[dict[str, Any]]]) -> str:
    """Distance of the last pose of every later life from where the robot stands, and the state it is in."""
    x, y, _ = run.truth[-1]
    last = [life[-1]["body"] for life in lives[1:]]
    return ", ".join(f"{math.hypot(b['x_m'] - x, b['y_m'] - y):.4f} m {b['state']}" for b in last)


def _text(path: Path) -> str:
    return path.read_text(errors="replace") if path.exists() else ""


def _json_lines(path: Path) -> list[dict[str, Any]]:
    """Whole lines only: the writer may have been killed in the middle of the last."""
    return [json.loads(line) for line in _text(path).splitlines(keepends=True) if line.endswith("\n")]


def main() -> int:
    out, share, summary = (Path(a) for a in sys.argv[1:])
    return told(list(checks(read(out, share))), summary)


def told(found: list[Check], summary: Path) -> int:
    """Prints the table and writes summary.json; the exit status."""
    width = max(len(c.name) for c in found)
    for c in found:
        verdict = "" if c.kept is None else "ok" if c.kept else "FAILED"
        print(f"  {c.name:<{width}}  {verdict:6}  {c.found}" + (f"   (promised: {c.promise})" if c.promise else ""))
    content = report(found)
    summary.write_text(json.dumps(content, indent=2) + "\n")
    return 0 if content["ok"] else 1


def report(found: list[Check]) -> dict[str, Any]:
    """What summary.json holds."""
    checks = {
        c.name: {
            "found": c.found,
            "promise": c.promise,
            "kept": None if c.kept is None else bool(c.kept),
            "value": None if c.value is None or not math.isfinite(c.value) else float(c.value),
        }
        for c in found
    }
    return {"ok": all(c["kept"] is not False for c in checks.values()), "checks": checks}


if __name__ == "__main__":
    sys.exit(main())
