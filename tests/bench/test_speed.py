"""The speed bench: its sums and that it runs; no time is asserted."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from ceilvo.bench.speed import filter_load, frame_cost
from ceilvo.bench.speed import filter_step as filter_speed
from ceilvo.calibration_file import write_calibration
from ceilvo.sim.rig import simulated_calibration


def test_the_scene_has_as_many_landmarks_as_asked_and_only_those_in_view_are_near():
    m, near = filter_speed.scene_of(300, 6)
    assert len(m) == 300
    assert len(near) == 6
    assert np.all(np.hypot(*near.T) <= 1.0)
    assert np.sort(np.hypot(*m.xy_map_m.T))[6] > 3.0


def test_the_exponent_of_a_linear_cost_is_one():
    rows = [{"particles": n, "us": {"joint": 2.0 * n}} for n in (3000, 10_000, 30_000)]
    assert filter_speed.exponent(rows) == pytest.approx(1.0)


def test_every_method_steps_and_is_counted_per_step():
    calls = {"a": 0, "b": 0}

    def count(name):
        calls[name] += 1

    found = filter_speed.medians({"a": lambda: count("a"), "b": lambda: count("b")}, 1, {"b": 20})
    assert set(found) == {"a", "b"}
    assert calls["a"] > 1
    m, near = filter_speed.scene_of(16, 6)
    for method in filter_speed.METHODS:
        for known in (True, False):
            filter_speed.stepper(method, 20, m, near, known)()


def test_the_bars_are_read_off_the_figures():
    at = dict.fromkeys(filter_speed.METHODS, 100.0)
    document = {
        "particles": [{"particles": 200, "us": {**at, "joint": 290.0}}],
        "map_ends": {"us": {"100": 100.0, "30000": 116.0}},
        "load": {"mapping": {"in_view": {"60": 1.0, "1000": 3.1}, "map": {"100": 1.0, "100000": 1.2}}},
    }
    assert [b.verdict for b in filter_speed.bars(document)] == ["PASS", "PASS", "MISS", "PASS", "MISS"]


@pytest.mark.parametrize("known", [True, False])
def test_the_daemon_s_step_sees_what_the_table_says_and_keeps_its_pose(
    known: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of the smallest map as well: else its steps would be cheaper because less is in view."""
    seen = {}
    for landmarks in (100, 10_000):
        filters = []
        made = filter_load.make_filter
        monkeypatch.setattr(filter_load, "make_filter", lambda *a: filters.append(made(*a)) or filters[-1])  # noqa: B023
        step = filter_load.stepper(landmarks, 60, known)
        monkeypatch.undo()
        for _ in range(4 * filter_load.TURN):
            step()
        pose, _, health = filters[0].estimate()
        assert np.all(np.abs(pose) < 0.01)
        seen[landmarks] = filters[0].counters()["observations"]
        assert 40 <= health.nis_dof / 2 <= 75
    assert seen[100] == pytest.approx(seen[10_000], rel=0.02)


def test_two_versions_say_the_same_of_every_frame_by_turns(tmp_path: Path) -> None:
    """Here both are this one: what is told apart are processes, and times."""
    rng = np.random.default_rng(5)
    np.save(tmp_path / "frames.npy", rng.integers(90, 110, (3, 480, 640)).astype(np.uint8))
    np.save(tmp_path / "stamps.npy", 1_000_000_000 + 33_000_000 * np.arange(3))
    write_calibration(tmp_path / "calibration.yaml", simulated_calibration())
    said = frame_cost.by_turns(tmp_path, 3, {"before": None, "now": None}, ("features.points=false",))
    assert [len(frames) for frames in said.values()] == [3, 3]
    for before, now in zip(said["before"], said["now"], strict=True):
        assert before["pose"] == now["pose"] and before["state"] == now["state"]
        assert now["s"]["canny"] > 0.0 and now["s"]["lines"] > 0.0 and now["s"].keys() <= {"canny", *frame_cost.STAGES}


def said_of(step_ms: list[float], canny_ms: float) -> list[dict[str, object]]:
    """Frames as a worker tells of them, half of the time spent in one stage, and slow ones before that do not count."""
    warm = [{"s": {"canny": 1.0, "lines": 9.0}}] * frame_cost._WARM
    return [*warm, *({"s": {"canny": 1e-3 * canny_ms, "lines": 5e-4 * t, "filter": 5e-4 * t}} for t in step_ms)]


@pytest.mark.parametrize(
    ("look", "verdicts"), [("edge tracking", {"median": "PASS", "p99": "MISS"}), ("whole look", {"median": "PASS"})]
)
def test_a_frame_is_held_to_its_bars_over_canny_with_the_filter_s_part(look: str, verdicts: dict[str, str]) -> None:
    """3.4 times Canny in the median, 9 at p99; the bar of a whole look is higher, and has no p99."""
    frames = said_of([6.8] * 97 + [18.0] * 3, 2.0)
    bars = frame_cost.barred("tilt", look, frames)
    assert {b.name: b.verdict for b in bars} == {f"tilt, {look}, {which}": v for which, v in verdicts.items()}
    assert bars[0].value == pytest.approx(3.4) and bars[0].wanted == ("<= 3.5" if "p99" in verdicts else "<= 6")
    slower = frame_cost.barred("tilt", look, said_of([12.1] * 100, 2.0))
    assert {b.verdict for b in slower if b.name.endswith("median")} == {"MISS"}


def test_every_scene_of_the_issue_is_looked_at_in_both_ways(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The office where it is recorded; asked for by name it must be there."""
    ran = []

    def by_turns(folder: Path, count: int, sites: object, overrides: tuple[str, ...]) -> dict[str, object]:
        ran.append((folder.name, overrides))
        return {"now": said_of([3.0] * 5, 1.0)}

    monkeypatch.setattr(frame_cost, "by_turns", by_turns)
    monkeypatch.setattr(frame_cost, "_rendered", lambda *a: 25)
    monkeypatch.setattr(frame_cost, "_pictures", lambda *a: 25)
    out = tmp_path / "a.json"
    office = tmp_path / "office"
    assert frame_cost.main(["--look", "both", "--office", str(office), "--json", str(out)]) == 0
    assert ran == [(scene, look) for scene in ("base", "tilt") for look in ((), frame_cost.FULL)]
    office.mkdir()
    assert frame_cost.main(["--look", "both", "--office", str(office), "--json", str(out)]) == 0
    assert ran[4:] == [(scene, look) for scene in ("base", "tilt", "office") for look in ((), frame_cost.FULL)]
    told = json.loads(out.read_text())
    assert [b["verdict"] for b in told] == ["PASS"] * 9
    monkeypatch.undo()
    with pytest.raises(SystemExit, match="none is missing"):
        frame_cost.main(["office", "--office", str(tmp_path / "none"), "--json", str(out)])


def test_frames_are_timed_with_the_settings_of_the_service() -> None:
    """The bench also runs where there is no unit, so it has its own list."""
    unit = Path(__file__).parents[2] / "systemd" / "ceilvod.service"
    lines = [x.removeprefix("Environment=") for x in unit.read_text().splitlines() if x.startswith("Environment=")]
    service = dict(setting.split("=", 1) for line in lines for setting in line.split())
    assert frame_cost.AS_THE_SERVICE.items() <= service.items()
