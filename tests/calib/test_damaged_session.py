"""Results and samples of a session that are not as calib wrote them: one line that names the file."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from ceilvo.bench.fuzz.targets.commissioning import TARGETS
from ceilvo.calib.commands import circles, intrinsics
from ceilvo.calib.commands.report import report
from ceilvo.calib.record.document import html_of
from ceilvo.calib.session import views
from ceilvo.calib.session.assemble import assemble, lens_so_far
from ceilvo.calib.session.session import Session
from ceilvo.calib.targets.board import Board
from ceilvo.errors import CalibrationError

WHOLE: dict[str, Any] = json.loads(TARGETS["calib_session"].seeds()[0])
SUBJECT = {"source": "a", "size": [640, 480]}


def written(folder: Path, **changed: Any) -> Session:
    """A session with results; changed: by the name of a step, what is other in its result."""
    for name, content in WHOLE.items():
        lines = content if name.endswith("l") else [content | changed.get(name.partition(".")[0], {})]
        (folder / name).write_text("\n".join(json.dumps(line) for line in lines) + "\n")
    return Session(folder)


def test_a_whole_session_is_read(tmp_path: Path) -> None:
    session = written(tmp_path)
    assert assemble(session) is not None and ">PASS</span>" in html_of(report(session))
    assert len(intrinsics.kept(session, Board(), SUBJECT)[0]) == 1
    assert len(views.kept(session, "projection", SUBJECT)) == 1
    assert len(circles.kept(session, SUBJECT)) == 3


@pytest.mark.parametrize(
    "changed",
    [
        {"projection": {"height_m": None}},
        {"projection": {"roll_rad": "x"}},
        {"projection": {"sigma": 1, "tile_m": []}},
        {"projection": {"lens": "x"}},
        {"mount": {"xy_m": 1.0}},
        {"sigma": {"sigma_x_m": 5}},
        {"intrinsics": {"camera": []}},
        {"survey": {"nis": "x", "of": 1}, "sigma": {"r_min_m": {}}},
    ],
)
def test_results_that_do_not_fit_are_one_line(tmp_path: Path, changed: dict[str, Any]) -> None:
    with pytest.raises(CalibrationError, match="damaged") as e:
        assemble(written(tmp_path, **changed))
    assert str(e.value).isprintable()


@pytest.mark.parametrize("changed", [{"shots": [1]}, {"shots": [{"name": "a", "rms_px": "x"}]}, {"problems": 4}])
def test_the_report_names_the_file_that_is_damaged(tmp_path: Path, changed: dict[str, Any]) -> None:
    with pytest.raises(CalibrationError, match=r"intrinsics\.json: damaged .* --force"):
        report(written(tmp_path, intrinsics=changed))


def test_a_lens_that_is_none_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(CalibrationError, match="damaged"):
        lens_so_far(written(tmp_path, intrinsics={"cov": [[1.0]]}), "a test")


@pytest.mark.parametrize("text", ["[" * 100_000, "\xff", '{"a": ' + "1" * 5000 + "}", "[]"])
def test_a_result_that_is_no_json_object_is_one_line(tmp_path: Path, text: str) -> None:
    (tmp_path / "mount.json").write_text(text, encoding="latin-1")
    with pytest.raises(CalibrationError, match=r"mount\.json: .* run 'calib mount' again with --force"):
        Session(tmp_path).result("mount")


@pytest.mark.parametrize(
    ("step", "changed"),
    [
        ("intrinsics", {"ids": [0, 1]}),
        ("intrinsics", {"ids": [-1] * 54}),
        ("intrinsics", {"ids": [10**9] * 54}),
        ("intrinsics", {"uv_px": "x"}),
        ("projection", {"xy": [[0.0, 0.1]]}),
        ("projection", {"uv_px": [[1.0, float("nan")]] * 7}),
        ("projection", {"wheels": [1.0]}),
        ("projection", {"stamp_ns": "x"}),
        (circles.SAMPLES, {"x_m": "x"}),
        (circles.SAMPLES, {"psi_rad": float("inf")}),
    ],
)
def test_samples_that_do_not_fit_are_one_line(tmp_path: Path, step: str, changed: dict[str, Any]) -> None:
    session = written(tmp_path)
    subject, sample = WHOLE[f"{step}.samples.jsonl"][:2]
    lines = (json.dumps(subject), json.dumps(sample | changed))
    (tmp_path / f"{step}.samples.jsonl").write_text("\n".join(lines) + "\n")
    with pytest.raises(CalibrationError, match=rf"{step}\.samples\.jsonl: damaged"):
        if step == "intrinsics":
            intrinsics.kept(session, Board(), SUBJECT)
        elif step == "projection":
            views.kept(session, step, SUBJECT)
        else:
            circles.kept(session, SUBJECT)


def test_samples_that_are_no_text_are_one_line(tmp_path: Path) -> None:
    (tmp_path / "projection.samples.jsonl").write_bytes(b"\xff\xfe\n")
    with pytest.raises(CalibrationError, match="cannot be read"):
        Session(tmp_path).samples("projection", SUBJECT)
