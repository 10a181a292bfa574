"""What the wizard asks for, step by step, and the words of the command line that the answers become."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from ceilvo.calib.cli import parser_of
from ceilvo.calib.session.session import Session
from ceilvo.calib.solve.tile_grid import USUAL_TILE_M
from ceilvo.calib.targets.board import KINDS
from ceilvo.errors import CalibrationError, one_line

_LONGEST = 2000
"""Characters of an answer: a table of marks."""
MARKS = "wizard/marks.csv"
_TABLE = "x_m,y_m,"
"""How a table of marks begins, with whatever columns follow."""


@dataclass(frozen=True)
class Field:
    """One thing to answer: `word` is the option of calib; kind number, choice, check or text."""

    word: str
    label: str
    kind: str
    value: Any = ""
    unit: str = ""
    choices: tuple[str, ...] = ()
    why: str = ""


@dataclass(frozen=True)
class Page:
    """A step: what to do, what to answer, and in which lists its accepted views are kept."""

    step: str
    title: str
    todo: str
    fields: tuple[Field, ...]
    parts: tuple[str, ...]
    optional: bool = False


PAGES = (
    Page(
        "intrinsics",
        "Lens",
        "Hold the board everywhere in the picture, leaning every way, near and far. Marked corners are still empty.",
        (
            Field("board", "board", "choice", "chessboard", choices=KINDS, why="'calib board' prints one"),
            Field("columns", "columns", "number", 9, why="inner corners; squares of ChArUco, tags, circles"),
            Field("rows", "rows", "number", 6),
            Field("square-mm", "square", "number", 25.0, "mm", why="measured with a ruler, over ten of them"),
            Field("legacy", "ChArUco printed before OpenCV 4.6", "check", False),
        ),
        ("intrinsics",),
    ),
    Page(
        "projection",
        "Ceiling",
        "Put the robot under the ceiling in 20 places, turned differently. The tape's height confirms that a metre is a"
        " metre.",
        (
            Field("tile-m", "tile, joint to joint", "number", USUAL_TILE_M, "m", why="measure ten in a row"),
            Field("height-m", "ceiling above the lens, by tape", "number", "", "m", why="to a centimetre"),
            Field("marks", "or marks on the ceiling", "text", "", "CSV",
                  why="first line x_m,y_m or x_m,y_m,id (ArUco); two and a tile confirm the scale, four without tiles"),
        ),
        ("projection",),
    ),
    Page(
        "mount",
        "Mounting",
        "First turn the robot four times round on the spot, slowly, and a little more; then drive it 2 m straight.",
        (),
        ("mount-spin", "mount-run"),
    ),
    Page(
        "sigma",
        "Noise",
        "Let the robot stand for a second in 18 places, turned differently.",
        (),
        ("sigma",),
    ),
    Page(
        "survey",
        "Survey",
        "Drive once through all of the room; 'Enough' ends the drive.",
        (Field("seconds", "longest drive", "number", 300.0, "s"),),
        (),
        optional=True,
    ),
    Page("check", "Check", "Push the robot about under the ceiling: a dozen pictures are compared with the file.", (),
         ("check",)),
)  # fmt: skip
BY_STEP = {page.step: page for page in PAGES}


def described(page: Page, answers: Mapping[str, Any]) -> dict[str, Any]:
    """For the browser, with the answers that were given before."""
    fields = [asdict(f) | {"value": answers.get(f.word, f.value)} for f in page.fields]
    return {
        "step": page.step, "title": page.title, "todo": page.todo, "fields": fields, "parts": page.parts,
        "optional": page.optional,
    }  # fmt: skip


def checked_answers(page: Page, answers: Mapping[str, Any]) -> dict[str, Any]:
    """Those of the page's fields, by their kind.

    Raises:
        CalibrationError: an unknown field, or an answer of another kind.
    """
    known = {f.word: f for f in page.fields}
    out = {}
    for word, value in answers.items():
        if word not in known:
            raise CalibrationError(f"{one_line(word)}: found no such field, expected {', '.join(known) or 'none'}")
        out[word] = _checked(known[word], value)
    return out


def _checked(field: Field, value: Any) -> Any:
    wrong = CalibrationError(f"{field.label}: found {one_line(value)!r}, expected {_expected(field)}")
    if field.kind == "check":
        if not isinstance(value, bool):
            raise wrong
        return value
    if field.kind == "number" and isinstance(value, int | float) and not isinstance(value, bool):
        return value
    if not isinstance(value, str) or len(value) > _LONGEST:
        raise wrong
    text = value.strip()
    if field.kind == "choice" and text not in field.choices:
        raise wrong
    if field.kind != "number" or not text:
        return text
    if "," in text:
        raise CalibrationError(f"{field.label}: found {text!r}, expected a decimal point: {text.replace(',', '.')}")
    try:
        return float(text)
    except ValueError:
        raise wrong from None


def _expected(field: Field) -> str:
    what = {"check": "yes or no", "text": "text"}.get(field.kind, "a number")
    return ", ".join(field.choices) or what


def arguments(
    page: Page, answers: Mapping[str, Any], session: Session, source: list[str], *, calibration: Path | None = None
) -> argparse.Namespace:
    """What the command line's own parser makes of it.

    Args:
        source: the options that say where pictures come from.
        calibration: the file that a check is of, where it is not the session's.

    Raises:
        CalibrationError: an answer that the command line would refuse.
    """
    words = [page.step, "--session", str(session.folder), *source]
    if page.step == "check" and calibration is not None:
        words += ["--calibration", str(calibration)]
    marks = str(answers.get("marks", "")).strip()
    if marks:
        session.write(MARKS, marks + "\n")
        words += ["--marks", str(session.folder / MARKS)]
    for field in page.fields:
        value = answers.get(field.word, field.value)
        if field.word == "marks" or value in ("", False):
            continue
        whole = isinstance(value, float) and value.is_integer() and field.word in ("columns", "rows")
        words += [f"--{field.word}"] if value is True else [f"--{field.word}={int(value) if whole else value}"]
    try:
        return parser_of(words).parse_args(words)
    except SystemExit:
        raise CalibrationError(f"{page.title}: an answer cannot be used: {' '.join(words[3:])}") from None
