"""What holds for every step of calib: live, from a folder, interrupted, on a full disk, repeated, without a camera."""

from __future__ import annotations

import errno
import json
import os
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from ceilvo.calib.cli import STEPS as COMMANDS
from ceilvo.calib.cli import main
from ceilvo.calib.commands import check as run_check
from ceilvo.calib.commands import intrinsics as run_intrinsics
from ceilvo.calib.commands import mount as run_mount
from ceilvo.calib.commands import projection as run_projection
from ceilvo.calib.commands import report as run_report
from ceilvo.calib.commands import sigma as run_sigma
from ceilvo.calib.practice.virtual_bench import VirtualBench
from ceilvo.calib.session import session as session_module
from ceilvo.calib.session import views
from ceilvo.calib.session.session import Session
from ceilvo.calib.targets import sources
from ceilvo.calib.targets.sources import Picture
from ceilvo.drivers.ports import CameraInfo
from ceilvo.errors import CameraError
from ceilvo.types import Frame

Gray = NDArray[np.uint8]
Run = Callable[..., tuple[int, str, str]]
Stock = dict[str, list[Picture]]

STEPS = {"intrinsics": "board", "projection": "places", "mount": "spin_and_run", "sigma": "stations", "check": "places"}
EVERY = {**STEPS, "survey": "drive"}
ON_PROJECTION = ("mount", "sigma", "check", "survey")
Prepare = Callable[[str], None]


@pytest.fixture
def prepare(known_lens: Session, projected: Path) -> Prepare:
    """Makes the results that a step needs; the lens is there, unless it is what the step is about."""

    def call(step: str) -> None:
        if step == "intrinsics":
            (known_lens.folder / "intrinsics.json").unlink()
        elif step in ON_PROJECTION:
            shutil.copytree(projected, known_lens.folder, dirs_exist_ok=True)

    return call


def options(step: str) -> list[str]:
    """For pictures that are not simulated."""
    return {"intrinsics": ["--model", "pinhole"], "projection": ["--tile-m", "0.6"]}.get(step, [])


def results(folder: Path) -> dict[str, bytes]:
    return {p.name: p.read_bytes() for p in folder.glob("*.json")}


def write(folder: Path, pictures: list[Picture]) -> None:
    """Pictures of a spin and a run go into folders of that name."""
    for i, picture in enumerate(pictures):
        to = folder / (picture.label if picture.label in ("spin", "run") else "")
        to.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(to / f"{i:03d}.png"), picture.gray)


@pytest.mark.parametrize("command", [*(c.STEP for c in COMMANDS), "show", "sign", "simulate"])
def test_every_help_has_an_example(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main([command, "--help"])
    assert f"example: calib {command}" in " ".join(capsys.readouterr().out.split())


# -- sources


@pytest.mark.usefixtures("short")
@pytest.mark.parametrize("step", EVERY)
def test_a_step_works_from_a_folder(
    run: Run, prepare: Prepare, tmp_path: Path, known_lens: Session, step: str, stock: Stock
) -> None:
    prepare(step)
    write(tmp_path / "i", stock[EVERY[step]])
    code, out, err = run(step, "--images", str(tmp_path / "i"), *options(step))
    assert code == 0 and "PASS  next: calib" in out, out + err
    assert known_lens.result(step) is not None


class Reel:
    """A live camera that has as many pictures as it is given, for one opening after the other."""

    def __init__(self, openings: list[list[Gray]]) -> None:
        self._openings = openings
        self._left: Iterator[Gray] = iter(())
        self._seq = 0

    def open(self) -> CameraInfo:
        if not self._openings:
            raise CameraError("reel: opened too often")
        pictures = self._openings.pop(0)
        h, w = pictures[0].shape
        self._left = iter(pictures)
        return CameraInfo("reel", "ceilvo-sim", w, h, 10.0, True)

    def read(self) -> Frame | None:
        gray = next(self._left, None)
        if gray is None:
            raise CameraError("reel: asked for more pictures than there are")
        self._seq += 1
        return Frame(self._seq, 100_000_000 * self._seq, gray)

    def close(self) -> None:
        self._left = iter(())


@pytest.mark.usefixtures("short")
@pytest.mark.parametrize("step", EVERY)
def test_a_step_works_live(
    run: Run, prepare: Prepare, known_lens: Session, step: str, stock: Stock, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each picture twice: a live step waits for the robot or the board to move, except where it is to stand still."""
    prepare(step)
    pictures = stock[EVERY[step]]
    for module, name, value in (
        (run_intrinsics, "_LIVE_MOST", 6),
        (run_projection, "_PICTURES", 8),
        (run_mount, "_TURN_RAD", 6.3),
        (run_sigma, "_STATIONS", 7),
        (run_check, "_PICTURES", 8),
    ):
        monkeypatch.setattr(module, name, value)
    if step == "mount":
        openings = [[p.gray for p in pictures if p.label == part] for part in ("spin", "run")]
    else:
        openings = [[p.gray for p in pictures for _ in range(1 if step in ("sigma", "survey") else 2)]]
    monkeypatch.setattr(sources, "make_camera", lambda _: Reel(openings))
    more = ["--seconds", "3.5"] if step == "survey" else options(step)
    code, out, err = run(step, "--device", "/dev/video0", *more)
    assert ("PASS  next: calib" in out) == (code == 0), out + err
    assert code == 0 or step == "intrinsics", out + err
    assert known_lens.result(step) is not None
    kept = known_lens.folder / f"{step}.samples.jsonl"
    if step == "projection":
        assert len(kept.read_text().splitlines()) == 1 + 8, "a picture of the same place was taken again"
    if step == "intrinsics":
        assert (known_lens.folder / "intrinsics" / "live.png").exists() and "live.png shows" in err


@pytest.mark.usefixtures("short")
@pytest.mark.parametrize("step", EVERY)
def test_no_camera_is_one_line_and_leaves_nothing(run: Run, prepare: Prepare, known_lens: Session, step: str) -> None:
    prepare(step)
    before = results(known_lens.folder)
    code, _, err = run(step, "--device", "/dev/video-none", *options(step))
    lines = [line for line in err.splitlines() if "now " not in line]  # mount says what to drive first
    assert code == 1 and len(lines) == 1 and "/dev/video-none: no such device" in lines[0]
    assert results(known_lens.folder) == before


@pytest.mark.usefixtures("short")
@pytest.mark.parametrize("step", [s for s in EVERY if s not in ("intrinsics", "survey")])
def test_pictures_that_are_no_use_are_rejected_with_their_reason(
    run: Run, prepare: Prepare, tmp_path: Path, known_lens: Session, step: str, stock: Stock
) -> None:
    prepare(step)
    good = stock["places"][0].gray
    bad = {
        "saturated": np.asarray(cv2.convertScaleAbs(good, alpha=6.0), np.uint8),
        "blurred": np.asarray(cv2.GaussianBlur(good, (0, 0), 9), np.uint8),
        "too dark": np.asarray(good // 32, np.uint8),
        "is 320 x 240 px, the lens has 480 x 360": np.asarray(cv2.resize(good, (320, 240)), np.uint8),
        "no two straight joints seen": np.random.default_rng(1).integers(90, 110, good.shape, np.uint8),
    }
    for part in ("spin", "run") if step == "mount" else ("",):
        write(tmp_path / "i", [Picture("", 0, gray, label=part) for gray in bad.values()])
        (tmp_path / "i" / part / "zero.png").write_bytes(b"no picture")
    code, _, err = run(step, "--images", str(tmp_path / "i"), *options(step))
    assert code == 78 and "found no usable picture among 6" in err, err
    for reason in (*bad, "no image that OpenCV can read"):
        assert any("rejected" in line and reason in line for line in err.splitlines()), (reason, err)


@pytest.mark.usefixtures("short")
@pytest.mark.parametrize(
    ("step", "reason"),
    [
        ("projection", "3 pictures, at least 5 needed"),
        ("mount", "found 3 usable pictures of the spin, 12 needed"),
        ("sigma", "stations, at least 6 needed"),
        ("survey", "found 3 usable frames, at least 10 needed"),
        ("check", "stations, at least 6 needed"),
    ],
)
def test_too_few_pictures_are_said_so(
    run: Run, prepare: Prepare, tmp_path: Path, known_lens: Session, step: str, reason: str, stock: Stock
) -> None:
    prepare(step)
    write(tmp_path / "i", stock[EVERY[step]][:3])
    if step == "mount":
        write(tmp_path / "i", [p for p in stock["spin_and_run"] if p.label == "run"][:3])
    code, out, err = run(step, "--images", str(tmp_path / "i"), *options(step))
    assert code in (1, 78) and reason in out + err, out + err


# -- interruption, full disk, repetition


def interrupted(pictures: Iterator[Picture], after: int) -> Iterator[Picture]:
    for i, picture in enumerate(pictures):
        if i == after:
            raise KeyboardInterrupt
        yield picture


@pytest.mark.usefixtures("short")
@pytest.mark.parametrize("step", STEPS)
def test_ctrl_c_keeps_what_was_taken_and_the_next_run_goes_on(
    run: Run, prepare: Prepare, known_lens: Session, step: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    prepare(step)
    whole = getattr(VirtualBench, STEPS[step])
    with monkeypatch.context() as m:
        if step == "mount":  # its pictures are drawn before the first is used
            real = views.CeilingReader.__call__
            calls = iter(range(1000))

            def reader(self: views.CeilingReader, gray: Gray) -> object:
                if next(calls) == 5:
                    raise KeyboardInterrupt
                return real(self, gray)

            m.setattr(views.CeilingReader, "__call__", reader)
        else:
            m.setattr(VirtualBench, STEPS[step], lambda *a, **k: interrupted(whole(*a, **k), 5))
        code, _, err = run(step, "--simulate")
    assert code == 130 and "stopped; what was taken so far is kept in" in err
    name = "mount-spin" if step == "mount" else step
    kept = (known_lens.folder / f"{name}.samples.jsonl").read_text().splitlines()
    assert len(kept) >= 4
    assert not (known_lens.folder / f"{step}.json").exists()
    code, out, err = run(step, "--simulate")
    assert f"going on with {len(kept) - 1} pictures" in err
    assert code == 0, out + err


@pytest.mark.usefixtures("short")
def test_an_interrupted_check_goes_on_for_minutes_only(run: Run, prepare: Prepare, known_lens: Session) -> None:
    prepare("check")
    assert run("check", "--simulate")[0] == 0
    samples = known_lens.folder / "check.samples.jsonl"
    (known_lens.folder / "check.samples.jsonl.bak").rename(samples)
    os.utime(samples, (1e9, 1e9))
    code, _, err = run("check", "--simulate")
    assert code == 0 and "going on" not in err
    assert len((known_lens.folder / "checks.jsonl").read_text().splitlines()) == 2


@pytest.mark.usefixtures("known_lens", "short")
def test_ctrl_c_ends_a_survey_with_its_verdict(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    assert run("projection", "--simulate")[0] == 0
    whole = VirtualBench.drive
    monkeypatch.setattr(VirtualBench, "drive", lambda *a, **k: interrupted(whole(*a, **k), 30))
    code, out, _ = run("survey", "--simulate")
    assert code == 0 and "30 frames" in out and "ended early" in out


def test_ctrl_c_in_a_report_leaves_the_earlier_one(
    run: Run, known_lens: Session, monkeypatch: pytest.MonkeyPatch
) -> None:
    run("report")
    before = (known_lens.folder / "report.html").read_bytes()

    def stopped(*_: object) -> str:
        raise KeyboardInterrupt

    monkeypatch.setattr(run_report, "report", stopped)
    code, _, err = run("report", "--force")
    assert code == 130 and "stopped" in err
    assert (known_lens.folder / "report.html").read_bytes() == before


@pytest.mark.usefixtures("short")
@pytest.mark.parametrize("step", [*EVERY, "report"])
def test_a_full_disk_loses_nothing(
    run: Run, prepare: Prepare, known_lens: Session, step: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    prepare(step)
    before = results(known_lens.folder)

    def full(*_: object, **__: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(session_module, "write_atomic", full)
    monkeypatch.setattr(session_module.os, "fsync", full)
    code, _, err = run(step, *([] if step == "report" else ["--simulate"]))
    assert code == 78 and "No space left on device" in err and "make room" in err
    assert results(known_lens.folder) == before


@pytest.mark.usefixtures("short")
@pytest.mark.parametrize("step", [s for s in EVERY if s != "check"])
def test_a_result_is_replaced_by_force_only_and_kept(
    run: Run, prepare: Prepare, known_lens: Session, step: str
) -> None:
    prepare(step)
    more = ["--model", "pinhole"] if step == "intrinsics" else []
    if step == "sigma":  # it reads what it measured before
        run(step, "--simulate")
    file = known_lens.folder / f"{step}.json"
    file.write_text(json.dumps({"mine": 1} | (known_lens.result(step) or {})))
    before = results(known_lens.folder)
    code, _, err = run(step, "--simulate", *more)
    assert code == 78 and f"{step}.json: found the result of an earlier run" in err and "pass --force" in err
    assert results(known_lens.folder) == before
    run(step, "--simulate", "--force", *more)
    assert file.with_name(f"{step}.json.bak").read_bytes() == before[file.name]
    assert "mine" not in json.loads(file.read_text())


def test_a_report_is_replaced_by_force_only_and_kept(run: Run, known_lens: Session) -> None:
    page = known_lens.folder / "report.html"
    run("report")
    page.write_text("mine")
    code, _, err = run("report")
    assert code == 78 and "pass --force" in err and page.read_text() == "mine"
    run("report", "--force")
    assert page.with_name("report.html.bak").read_text() == "mine" and "<!doctype html>" in page.read_text()
    assert page.with_name("report.pdf.bak").exists() and page.with_suffix(".pdf").read_bytes().startswith(b"%PDF-")


def test_a_mistyped_folder_does_not_block_the_session(run: Run, tmp_path: Path, stock: Stock) -> None:
    write(tmp_path / "wrong", [Picture("", 0, np.full((360, 480), 100, np.uint8))])
    write(tmp_path / "right", stock["board"])
    assert run("intrinsics", "--images", str(tmp_path / "wrong"))[0] == 78
    code, out, err = run("intrinsics", "--images", str(tmp_path / "right"), "--model", "pinhole")
    assert code == 0 and "8 used" in out, err
