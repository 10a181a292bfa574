"""Point lists that people write: CSV with a header, in metres or, asked for, in millimetres."""

from __future__ import annotations

import csv
import io
import re
import reprlib
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ceilvo.errors import CalibrationError, one_line

Array = NDArray[np.float64]

_MILLIMETRES_BEYOND = 40.0
"""No point on a ceiling is seen from so far, and no tape is so long."""
_PIXELS_FROM = 20.0
"""Points over a whole picture have larger coordinates."""
_ABOVE_M = 0.05
"""Beyond what a tape gives: z is up, the ceiling is 0."""
_MOST = 1e9
"""Of any number: a thousand kilometres in millimetres; beyond it sums overflow, and nobody measured it."""
_MOST_ROWS, _MOST_POINTS = 100_000, 1_000
"""Of a table, an hour of pictures; of points that people measure, each of which is compared with each."""
Ask = Callable[[str], bool]


def ask_on_terminal(question: str) -> bool:
    """False without a terminal: nobody is there to answer."""
    if not (sys.stdin.isatty() and sys.stderr.isatty()):
        return False
    print(f"{question} [y/N] ", end="", file=sys.stderr, flush=True)
    return sys.stdin.readline().strip().lower() in ("y", "yes")


def read_table(path: Path, columns: tuple[str, ...], optional: tuple[str, ...] = ()) -> dict[str, Array]:
    """Named columns of numbers, at least one row.

    Raises:
        CalibrationError: unreadable, a column is missing or has something other than a number in it.
    """
    try:
        text = path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as e:
        raise CalibrationError(f"{path}: cannot be read ({e})") from None
    reader = csv.DictReader(io.StringIO(text, newline=""), skipinitialspace=True)
    try:
        values = _columns(path, reader, columns, optional)
    except csv.Error as e:
        raise CalibrationError(
            f"{path} line {reader.line_num + 1}: {e}; expected numbers with commas between"
        ) from None
    if not next(iter(values.values())):
        raise CalibrationError(f"{path}: found no row under the header, expected numbers")
    return {c: np.array(v) for c, v in values.items()}


def _columns(
    path: Path, reader: csv.DictReader[str], columns: tuple[str, ...], optional: tuple[str, ...]
) -> dict[str, list[float]]:
    names = [n.strip() for n in reader.fieldnames or ()]
    missing = [c for c in columns if c not in names]
    if missing:
        semicolons = any(";" in n or "\t" in n for n in names)
        hint = ", with commas between (found semicolons or tabs) and points in numbers" if semicolons else ""
        raise CalibrationError(
            f"{path}: column {missing[0]!r} is missing, found {one_line(', '.join(names)) or 'nothing'}; "
            f"the first line must be {','.join((*columns, *optional))}{hint}"
        )
    reader.fieldnames = names
    values: dict[str, list[float]] = {c: [] for c in (*columns, *(c for c in optional if c in names))}
    for row in reader:
        if None in row:  # more fields than names
            raise CalibrationError(
                f"{path} line {reader.line_num}: found {len(names) + len(row[None])} fields, expected {len(names)}; "
                "are there decimal commas? write 0.5, not 0,5"
            )
        for c, column in values.items():
            column.append(_number(path, reader.line_num, c, row.get(c)))
        if len(values[columns[0]]) > _MOST_ROWS:
            raise CalibrationError(f"{path}: found more than {_MOST_ROWS} rows, expected fewer; is it the right file?")
    return values


def _number(path: Path, line: int, column: str, text: str | None) -> float:
    try:
        value = float(text or "")
    except ValueError:
        value = float("nan")
    if not abs(value) <= _MOST:
        comma = "; write 0.5, not 0,5" if text is not None and re.fullmatch(r"\s*[-+]?\d+,\d+\s*", text) else ""
        raise CalibrationError(f"{path} line {line}: {column}: found {reprlib.repr(text)}, expected a number{comma}")
    return value


def in_metres(
    path: Path, table: dict[str, Array], columns: tuple[str, ...], units: str | None, ask: Ask
) -> dict[str, Array]:
    """The table with lengths in metres; what looks like millimetres is asked about, never guessed.

    Args:
        units: "m" or "mm" when the person has said so, None = to be found out.

    Raises:
        CalibrationError: looks like millimetres and nobody has confirmed either.
    """
    most = max(float(np.abs(table[c]).max()) for c in columns)
    if units is None and most > _MILLIMETRES_BEYOND:
        where = f"{path}: coordinates reach {most:g} m, which looks like millimetres"
        if not ask(f"{where}. Take them as millimetres?"):
            raise CalibrationError(f"{where}; pass --units mm if they are, --units m if they are not")
        units = "mm"
    if units != "mm":
        return table
    return {c: v / 1e3 if c in columns else v for c, v in table.items()}


def read_points(path: Path, units: str | None, ask: Ask = ask_on_terminal) -> tuple[Array, Array]:
    """xyz_m (N, 3) in base and uv_px (N, 2) of a CSV x_m,y_m,z_m,u_px,v_px; z_m may be left out (0: on the ceiling)."""
    table = read_table(path, ("x_m", "y_m", "u_px", "v_px"), ("z_m",))
    table.setdefault("z_m", np.zeros(len(table["x_m"])))
    if len(table["x_m"]) > _MOST_POINTS:
        raise CalibrationError(f"{path}: found {len(table['x_m'])} points, expected at most {_MOST_POINTS}; a dozen do")
    table = in_metres(path, table, ("x_m", "y_m", "z_m"), units, ask)
    _swapped(path, table)
    xyz = np.column_stack([table["x_m"], table["y_m"], table["z_m"]])
    return xyz, np.column_stack([table["u_px"], table["v_px"]])


def _swapped(path: Path, table: dict[str, Array]) -> None:
    """Pixels where metres should be: the columns' names do not go with what is in them."""
    metres = max(float(np.abs(table[c]).max()) for c in ("x_m", "y_m"))
    pixels = max(float(np.abs(table[c]).max()) for c in ("u_px", "v_px"))
    if pixels < _PIXELS_FROM and metres < _PIXELS_FROM:
        raise CalibrationError(
            f"{path}: u_px and v_px reach only {pixels:g}, expected pixels; are they in metres, or columns swapped?"
        )
    if pixels < metres and pixels < _PIXELS_FROM:
        raise CalibrationError(f"{path}: x_m, y_m look like pixels and u_px, v_px like metres: columns are swapped")
    if (table["z_m"] > _ABOVE_M).any():
        raise CalibrationError(
            f"{path}: z_m reaches {table['z_m'].max():g}, expected 0 on the ceiling and negative below it; "
            "heights above the floor must have the ceiling's height taken off"
        )
