"""`calib report`: one HTML file with every figure, plot and picture of the session, for the commissioning record."""

from __future__ import annotations

import argparse
import base64
import html
import json
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from ceilvo.calib.commands.calibration_file import describe
from ceilvo.calib.session.common import Subcommands, add_step
from ceilvo.calib.session.session import STEPS, Session, reading
from ceilvo.calibration_check import scale_of
from ceilvo.calibration_file import read_calibration
from ceilvo.errors import CalibrationError

STEP = "report"
_SKIPPED = ("cov", "curves", "shots", "radial", "problems", "verdict", "camera", "lens", "vectors")
_STYLE = (
    "body{font:15px/1.5 sans-serif;max-width:60rem;margin:2rem auto;padding:0 1rem;color:#222}"
    "table{border-collapse:collapse;margin:.5rem 0}"
    "td,th{border:1px solid #ccc;padding:.2rem .6rem;text-align:left;vertical-align:top}"
    ".PASS,.FAIL,.none{color:#fff;padding:.1rem .5rem}.PASS{background:#2a7d2a}.FAIL{background:#b3261e}"
    ".none{background:#888}img,svg{max-width:100%;height:auto}pre{background:#f4f4f4;padding:.6rem}"
)


def add(commands: Subcommands) -> None:
    add_step(
        commands,
        STEP,
        run,
        help="7. one HTML file with everything, for the record",
        description="Writes SESSION/report.html.",
        epilog="example: calib report --session commissioning",
        pictures=False,
    )


def run(args: argparse.Namespace) -> int:
    session = Session(args.session, force=args.force)
    text = report(session)
    path = session.folder / "report.html"
    if path.exists():
        if not args.force:
            raise CalibrationError(
                f"{path}: found an earlier report, expected none; pass --force to write it anew (it is kept as .bak)"
            )
        session.write("report.html.bak", path.read_bytes())
    session.write("report.html", text)
    print(f"{path}: written")
    if session.calibration_file.exists():
        with suppress(CalibrationError):
            print(f"  {scale_of(read_calibration(session.calibration_file))[1]}")
    done = {s: (session.result(s) or {}).get("verdict", "not done") for s in STEPS}
    for step, verdict in done.items():
        print(f"  {step:<12}{verdict}")
    bad = [s for s, v in done.items() if v != "PASS"]
    if bad:
        print(f"FAIL  then: calib {bad[0]}")
        return 1
    print(f"PASS  next: put {session.calibration_file} where calibration.file of the daemon's config.yaml says")
    return 0


def report(session: Session) -> str:
    """The whole page; nothing in it is loaded from elsewhere.

    Raises:
        CalibrationError: no step has been done.
    """
    results = {step: session.result(step) for step in STEPS}
    if not any(results.values()):
        raise CalibrationError(
            f"{session.folder}: found no result in it, expected a session; run 'calib intrinsics' first"
        )
    parts = []
    for step, result in results.items():
        with reading(session.folder / f"{step}.json"):
            parts.append(_section(session, step, result))
    return (
        f"<!doctype html><html lang='en'><meta charset='utf-8'><title>Commissioning: {_e(session.folder.name)}</title>"
        f"<style>{_STYLE}</style><h1>Commissioning: {_e(session.folder.name)}</h1>{_summary(results)}{_file(session)}"
        + "".join(parts)
        + "</html>\n"
    )


def _e(value: Any) -> str:
    return html.escape(str(value))


def _verdict(result: Mapping[str, Any] | None) -> str:
    v = "not done" if result is None else str(result.get("verdict", "?"))
    return f"<span class='{v if v in ('PASS', 'FAIL') else 'none'}'>{_e(v)}</span>"


def _summary(results: Mapping[str, Mapping[str, Any] | None]) -> str:
    rows = "".join(f"<tr><td>{_e(s)}</td><td>{_verdict(r)}</td></tr>" for s, r in results.items())
    return f"<table>{rows}</table>"


def _file(session: Session) -> str:
    if not session.calibration_file.exists():
        return "<p>No calibration.yaml yet.</p>"
    try:
        calibration = read_calibration(session.calibration_file)
    except CalibrationError as e:
        return f"<h2>calibration.yaml</h2><pre>{_e(e)}</pre>"
    state, said = scale_of(calibration)
    look = {"confirmed": "PASS", "contradicted": "FAIL"}.get(state, "none")
    return (
        f"<p><span class='{look}'>scale {state}</span> {_e(said)}</p>"
        f"<h2>calibration.yaml</h2><pre>{_e(describe(calibration))}</pre>"
    )


def _section(session: Session, step: str, result: Mapping[str, Any] | None) -> str:
    if result is None:
        return f"<h2>{_e(step)}</h2><p>not done</p>"
    rows = "".join(f"<tr><th>{_e(k)}</th><td>{_value(v)}</td></tr>" for k, v in result.items() if k not in _SKIPPED)
    bad = "".join(f"<li>{_e(p)}</li>" for p in result.get("problems", ()))
    shots = _shots(result.get("shots"))
    pictures = "".join(_picture(p) for p in sorted((session.folder / step).glob("*")) if p.name != "live.png")
    return f"<h2>{_e(step)} {_verdict(result)}</h2><ul>{bad}</ul><table>{rows}</table>{shots}{pictures}"


def _value(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, list) and all(isinstance(v, float) for v in value):
        return ", ".join(f"{v:.6g}" for v in value)
    if isinstance(value, list) and all(isinstance(v, str) for v in value):
        return "<br>".join(_e(v) for v in value)
    return _e(json.dumps(value)) if isinstance(value, list | dict) else _e(value)


def _shots(shots: Any) -> str:
    if not shots:
        return ""
    rows = "".join(f"<tr><td>{_e(s['name'])}</td><td>{s['rms_px']:.3f} px</td></tr>" for s in shots)
    return f"<details><summary>residual of each picture</summary><table>{rows}</table></details>"


def _picture(path: Path) -> str:
    if path.suffix == ".svg":
        drawing = path.read_text(encoding="utf-8", errors="replace")
        return f"<figure>{drawing}<figcaption>{_e(path.stem)}</figcaption></figure>"
    if path.suffix == ".png":
        data = base64.b64encode(path.read_bytes()).decode()
        image = f"<img alt='{_e(path.stem)}' src='data:image/png;base64,{data}'>"
        return f"<figure>{image}<figcaption>{_e(path.stem)}</figcaption></figure>"
    return ""
