"""`calib report`: the commissioning record for a customer, as one HTML file and as a PDF."""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator, Mapping
from contextlib import suppress
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

from ceilvo import __version__
from ceilvo.calib.commands.calibration_file import rows_of
from ceilvo.calib.record import legend, pdf
from ceilvo.calib.record.document import Block, Document, Figure, Heading, Table, Text, Verdict, html_of, pdf_of
from ceilvo.calib.session.common import FIGURES, Subcommands, add_step
from ceilvo.calib.session.session import STEPS, Session, reading
from ceilvo.calibration_check import scale_of
from ceilvo.calibration_file import read_calibration
from ceilvo.errors import CalibrationError

STEP = "report"
ABOUT = "about.json"
"""In the session: site, robot, operator, remarks, as they were said last."""
WORDS = ("site", "robot", "operator", "remark")
FILES = ("report.html", "report.pdf")
_LOOKS: dict[str, Verdict] = {"PASS": "good", "FAIL": "bad", "confirmed": "good", "contradicted": "bad"}
_MOST_PHOTO_BYTES = 40_000_000
"""Of a file; chosen: above what telephones and cameras write."""


def add(commands: Subcommands) -> None:
    p = add_step(
        commands,
        STEP,
        run,
        help="7. the record for a customer: one HTML file and a PDF",
        description="Writes SESSION/report.html and SESSION/report.pdf.",
        epilog="example: calib report --session commissioning --site 'Hall 3' --robot AGV-12 --operator 'M. Chen'",
        pictures=False,
    )
    for word, text in (
        ("site", "where the robot drives"),
        ("robot", "its name or number"),
        ("operator", "who measured"),
    ):
        p.add_argument(f"--{word}", metavar="NAME", help=f"{text}; kept for the next report")
    p.add_argument("--remark", metavar="TEXT", help="a sentence or two for the first sheet; kept")
    p.add_argument(
        "--photo",
        type=Path,
        action="append",
        default=[],
        metavar="FILE",
        help="a photograph (JPEG, PNG); may be repeated",
    )


def run(args: argparse.Namespace) -> int:
    session = Session(args.session, force=args.force)
    about = told(session) | {word: text for word in WORDS if (text := getattr(args, word))}
    photos = [(path.stem, _photo(path)) for path in args.photo]
    document = report(session, about, photos)
    for path in (session.folder / name for name in FILES):
        if path.exists() and not args.force:
            raise CalibrationError(
                f"{path}: found an earlier report, expected none; pass --force to write it anew (it is kept as .bak)"
            )
    if about:
        session.write(ABOUT, json.dumps(about, indent=1) + "\n")
    for path in save(session, document):
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


def save(session: Session, document: Document) -> list[Path]:
    """Write both files; those that were there are kept as .bak."""
    for name, data in zip(FILES, (html_of(document).encode(), pdf_of(document)), strict=True):
        before = session.folder / name
        if before.exists():
            session.write(f"{name}.bak", before.read_bytes())
        session.write(name, data)
    return [session.folder / name for name in FILES]


def report(
    session: Session, about: Mapping[str, str] | None = None, photos: list[tuple[str, bytes]] | None = None
) -> Document:
    """The whole record.

    Args:
        about: site, robot, operator and remark, those that are known.
        photos: name and file content of each photograph.

    Raises:
        CalibrationError: no step has been done, or a file of the session is damaged.
    """
    results = {step: session.result(step) for step in STEPS}
    if not any(results.values()):
        raise CalibrationError(
            f"{session.folder}: found no result in it, expected a session; run 'calib intrinsics' first"
        )
    blocks: list[Block] = [*_first_sheet(session, results, about or {}), *(Figure(d, n) for n, d in photos or [])]
    for step, result in results.items():
        with reading(session.folder / f"{step}.json"):
            blocks += _part(session, step, result)
    blocks += [Heading("How to read the figures"), Table(_READING)]
    now = datetime.now(timezone.utc).strftime("%Y-%m-%d %H:%M UTC")
    of = (about or {}).get("robot") or session.folder.resolve().name
    return Document(f"Commissioning of {of}", f"Written {now} by ceilvo {__version__}", blocks)


_READING = (
    ("a +- b", "the figure and its standard uncertainty (1 sigma)", ""),
    ("px", "a pixel of the camera's picture", ""),
    ("mm, m, deg", "on the ceiling or the robot; angles in degrees, to the left positive", ""),
    ("PASS, FAIL", "every limit was kept, or at least one was not: it is named below the verdict", ""),
)


def _first_sheet(session: Session, results: Mapping[str, Any], about: Mapping[str, str]) -> Iterator[Block]:
    named = [
        (word.capitalize(), about[word], "") for word in ("site", "robot", "operator", "remark") if about.get(word)
    ]
    if named:
        yield Table(named)
    verdicts = {step: "not done" if r is None else str(r.get("verdict", "?")) for step, r in results.items()}
    bad = [legend.STEPS[s][0] for s, v in verdicts.items() if v != "PASS"]
    yield Heading("Result", "FAIL" if bad else "PASS", "bad" if bad else "good")
    said = (
        f"Not as it should be, or not done: {', '.join(bad)}."
        if bad
        else "All steps passed; the robot may drive by it."
    )
    yield Text(said, "bad" if bad else "good")
    yield Table([(legend.STEPS[s][0], v, legend.STEPS[s][1]) for s, v in verdicts.items()])
    if not session.calibration_file.exists():
        yield Text("There is no calibration yet.")
        return
    try:
        calibration = read_calibration(session.calibration_file)
    except CalibrationError as e:
        yield Text(str(e), "bad")
        return
    state, told = scale_of(calibration)
    yield Heading("The calibration", f"scale {state}", _LOOKS.get(state, "none"))
    yield Text(told)
    yield Table([(name, value, legend.FIGURES.get(name, "")) for name, value in rows_of(calibration)])


def _part(session: Session, step: str, result: Mapping[str, Any] | None) -> Iterator[Block]:
    title, purpose = legend.STEPS[step]
    if result is None:
        yield Heading(title, "not done")
        yield Text(purpose)
        return
    verdict = str(result.get("verdict", "?"))
    yield Heading(title, verdict, _LOOKS.get(verdict, "none"))
    yield Text(purpose)
    for problem in result.get("problems", ()):
        yield Text(str(problem), "bad")
    figures = session.folder / step / FIGURES
    if figures.exists():
        with reading(figures):
            rows = json.loads(figures.read_text(encoding="utf-8"))
            yield Table([(str(name), str(value), legend.FIGURES.get(str(name), "")) for name, value in rows])
    else:
        yield Text(f"Measured by an earlier version; 'calib {step} --force' writes down its figures.")
    shots = result.get("shots")
    if shots:
        worst = sorted(shots, key=lambda s: -float(s["rms_px"]))[:5]
        yield Table(
            [("worst views", ", ".join(f"{s['name']}: {float(s['rms_px']):.3f} px" for s in worst), "rms of each")]
        )
    for name, caption in legend.PICTURES.items():
        yield from _picture(session.folder / step / name, caption)


def _picture(path: Path, caption: str) -> Iterator[Figure]:
    if not path.exists():
        return
    if path.suffix == ".png":
        yield Figure(path.read_bytes(), caption)
        return
    drawing = path.read_text(encoding="utf-8", errors="replace")
    if drawing.startswith('<svg xmlns="http://www.w3.org/2000/svg" width="'):  # an earlier version drew by matplotlib
        yield Figure(drawing, caption)


def told(session: Session) -> dict[str, str]:
    """Site, robot, operator and remark as they were said for the report before; {} at first."""
    path = session.folder / ABOUT
    if not path.exists():
        return {}
    with reading(path):
        return {str(k): str(v) for k, v in json.loads(path.read_text(encoding="utf-8")).items()}


def _photo(path: Path) -> bytes:
    """The file's content.

    Raises:
        CalibrationError: it cannot be read, or is no picture.
    """
    try:
        data = path.read_bytes() if path.stat().st_size <= _MOST_PHOTO_BYTES else b""
    except OSError as e:
        raise CalibrationError(f"--photo {path}: cannot be read ({e.strerror})") from None
    if pdf.jpeg_of(data, 64) is None:
        raise CalibrationError(
            f"--photo {path}: found no picture in it, expected JPEG or PNG of at most {_MOST_PHOTO_BYTES // 10**6} MB"
        )
    return data
