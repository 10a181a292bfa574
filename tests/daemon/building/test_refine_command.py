"""`ceilvod map refine` on databases of maps, against the ceilings that they were made from."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from driven_floors import driven, turned
from map_contents import same_content

from ceilvo.bench.refine.building import MapError, error
from ceilvo.calibration_file import read_calibration, write_calibration
from ceilvo.daemon.cli import main
from ceilvo.daemon.editing import sources
from ceilvo.daemon.map.database.content import MapContent
from ceilvo.daemon.map.database.copies import open_map
from ceilvo.daemon.map.database.faults import SupersededError
from ceilvo.types import Array

Capture = pytest.CaptureFixture[str]
FAR = np.array([50.0, -20.0, 0.7])
"""Where the frame of the second floor is."""


def run(*words: str | Path) -> int:
    return main(["map", "refine", *map(str, words)])


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with map.db of one floor, and the calibration that saw it."""
    drive, content = driven(1)
    sources.write(tmp_path / "map.db", content, "begin")
    write_calibration(tmp_path / "calibration.yaml", drive.wrong)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def tape(xy_m: Array, truth_m: Array) -> str:
    """Between two corners of what many views show."""
    a, b = (int(np.argmin(np.hypot(*(truth_m - corner).T))) for corner in ((1.2, 1.2), (10.2, 7.2)))
    ends = ":".join(f"{x:.3f},{y:.3f}" for x, y in xy_m[[a, b]])
    return f"{ends}={np.hypot(*(truth_m[b] - truth_m[a])):.5f}"


def off(content: MapContent, truth_m: Array) -> MapError:
    return error(content.landmarks.xy_map_m, truth_m[content.landmarks.ids])


def test_a_map_is_refined_in_its_database_and_taken_back(here: Path, capsys: Capture) -> None:
    drive, content = driven(1)
    measured = tape(content.landmarks.xy_map_m, drive.xy_m[content.landmarks.ids])
    words = ("map.db", "--calibration", "calibration.yaml", "--tape", measured, "--tape-sigma", "1")
    assert run(*words, "--dry-run", "--png", "change.png", "--write-calibration", "new.yaml") == 0
    assert same_content(sources.read(here / "map.db"), _kept(content))
    assert cv2.imread("change.png") is not None and not Path("new.yaml").exists()
    assert run(*words, "--write-calibration", "new.yaml") == 0
    said = capsys.readouterr().out
    after = sources.read(here / "map.db")
    before, now = off(content, drive.xy_m), off(after, drive.xy_m)
    print(f"before {before}; after {now}")
    assert before.rms_mm > 15.0 and now.rms_mm < 2.0 and now.worst_mm < 10.0 and abs(now.scale_ppm) < 300.0
    assert "would be refined; nothing was written" in said and "in shape, " in said and "not explained: no " in said
    new, old = read_calibration(Path("new.yaml")), drive.wrong
    assert abs(new.ceiling_height_m / drive.calibration.ceiling_height_m - 1.0) < 1e-3
    assert abs(old.ceiling_height_m / drive.calibration.ceiling_height_m - 1.0) > 4e-3
    assert new.meta["refined"]["height_sigma"] > 0.0
    assert read_calibration(Path("calibration.yaml")).camera == old.camera
    assert [len(k) for k in after.key_poses] and after.sessions == content.sessions
    assert main(["map", "undo", "map.db"]) == 0
    assert same_content(sources.read(here / "map.db"), _kept(content))


def _kept(content: MapContent) -> MapContent:
    """As the database keeps it: so many key poses a square metre, and no more."""
    sources.write(Path("other.db"), content, "begin")
    kept = sources.read(Path("other.db"))
    Path("other.db").unlink()
    return kept


def test_two_floors_that_two_robots_saw_are_refined_together(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Capture
) -> None:
    """Each floor in a frame of its own, each robot with a calibration of its own, both off alike."""
    monkeypatch.chdir(tmp_path)
    ground_drive, ground = driven(1)
    upper_drive, upper = driven(2, "other")
    other = turned(upper, FAR, "upper")
    sources.write(Path("map.db"), turned(ground, np.zeros(3), "ground"), "begin")
    with open_map(Path("map.db"), "upper") as db:
        db.edit(other, "begin")
    write_calibration(Path("one.yaml"), ground_drive.wrong)
    tapes = [
        "ground@" + tape(ground.landmarks.xy_map_m, ground_drive.xy_m[ground.landmarks.ids]),
        "upper@" + tape(other.landmarks.xy_map_m, upper_drive.xy_m[upper.landmarks.ids]),
    ]
    words = ["--calibration", "robot/=one.yaml", "--calibration", "other/=one.yaml"]
    assert run("map.db", *words, "--tape", tapes[0], "--tape", tapes[1]) == 0
    said = capsys.readouterr().out
    assert "floor ground: " in said and "floor upper: " in said and said.count("calibration found") == 2
    for name, drive in (("ground", ground_drive), ("upper", upper_drive)):
        content = sources.read(Path("map.db"), name)
        now = off(content, drive.xy_m)
        print(f"{name}: {now}")
        assert now.rms_mm < 2.0 and now.worst_mm < 10.0 and abs(now.scale_ppm) < 400.0
    upper_now = sources.read(Path("map.db"), "upper")
    assert abs(upper_now.axis_rad - FAR[2]) < 5e-3 and np.all(upper_now.landmarks.xy_map_m.min(axis=0) > [35.0, -25.0])
    assert run("map.db", *words, "--tape", tapes[0].removeprefix("ground@")) == 1
    assert "floor '', expected one of ground, upper" in capsys.readouterr().err


def test_a_robot_that_has_saved_meanwhile_is_not_written_over(
    here: Path, capsys: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    from ceilvo.daemon.building import refining

    real = refining.refine_all

    def slow(contents: list[MapContent], asked: refining.Refinement) -> object:
        done = real(contents, asked)
        with open_map(here / "map.db") as db:
            some = db.load()
            assert some is not None
            db.save(some.landmarks.of(np.arange(len(some.landmarks) - 1)), some.map_axis_rad, "robot/9")
        return done

    monkeypatch.setattr(refining, "refine_all", slow)
    assert run("map.db", "--calibration", "calibration.yaml") == 1
    said = capsys.readouterr()
    assert "another program has written to it since it was read" in said.err and "run it again" in said.err
    assert "refined; " not in said.out
    assert len(sources.read(here / "map.db").landmarks) == len(driven(1)[1].landmarks) - 1


def test_a_robot_does_not_write_its_old_map_over_a_refined_one(here: Path) -> None:
    with open_map(here / "map.db") as robot:
        held, began = robot.load(), robot.hash
        assert held is not None
        assert run("map.db", "--calibration", "calibration.yaml") == 0
        with pytest.raises(SupersededError, match="another program has written"):
            robot.save(held.landmarks, held.map_axis_rad, "robot/9", found=began)
        refined = robot.content()
        assert robot.hash != began
        assert not np.array_equal(refined.landmarks.xy_map_m, held.landmarks.xy_map_m)
        robot.save(refined.landmarks, refined.axis_rad, "robot/9", found=robot.hash)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("--calibration", "gone.yaml"), "gone.yaml"),
        (("--calibration", "other/=calibration.yaml"), "session 'robot/0': no --calibration is for it"),
        (("--calibration", "calibration.yaml", "--write-calibration", "calibration.yaml"), "is there already"),
        (("--calibration", "calibration.yaml", "--tape", "90,90:0,0=5"), "no landmark that 2 key poses saw within"),
        (("--calibration", "calibration.yaml", "--tape", "0,0:0,0=5"), "both ends are one landmark"),
        (("--calibration", "calibration.yaml", "--mark", "0,0=5,5"), "given once for floor"),
        (("--calibration", "calibration.yaml", "--floor", "roof"), "holds no map of floor 'roof'"),
    ],
)
def test_what_cannot_be_done_is_said_and_nothing_is_changed(
    here: Path, words: tuple[str, ...], said: str, capsys: Capture
) -> None:
    before = sources.read_with_hash(here / "map.db")[1]
    assert run("map.db", *words) in (1, 78)
    assert said in capsys.readouterr().err
    assert sources.read_with_hash(here / "map.db")[1] == before


def test_a_map_without_key_poses_is_not_refined(here: Path, capsys: Capture) -> None:
    content = driven(1)[1]
    sources.write(here / "bare.db", MapContent.of(content.landmarks, 0.0), "begin")
    assert run("bare.db", "--calibration", "calibration.yaml") == 1
    assert "no key poses are kept with the map" in capsys.readouterr().err


def test_two_marks_put_the_map_on_the_plan(here: Path) -> None:
    drive, content = driven(1)
    truth = drive.xy_m[content.landmarks.ids]
    plan = np.array([100.0, 40.0]) + truth @ np.array([[0.0, 1.0], [-1.0, 0.0]])
    xy = content.landmarks.xy_map_m
    ends = int(np.argmin(xy.sum(axis=1))), int(np.argmax(xy.sum(axis=1)))
    marks = [f"{xy[i, 0]:.4f},{xy[i, 1]:.4f}={plan[i, 0]:.5f},{plan[i, 1]:.5f}" for i in ends]
    words = [w for m in marks for w in ("--mark", m)]
    assert run("map.db", "--calibration", "calibration.yaml", *words, "--mark-sigma", "1") == 0
    after = sources.read(here / "map.db")
    place = dict(zip(content.landmarks.ids.tolist(), plan, strict=True))
    left = [
        np.hypot(*(p - place[i])) for i, p in zip(after.landmarks.ids.tolist(), after.landmarks.xy_map_m, strict=True)
    ]
    print(f"off the plan by {1e3 * max(left):.2f} mm at most")
    assert max(left) < 12e-3
