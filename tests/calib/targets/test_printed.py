"""`calib board`: what comes out of a printer, measured in the page and found by OpenCV itself."""

from __future__ import annotations

import itertools
from pathlib import Path

import cv2
import numpy as np
import pypdfium2
import pytest
from numpy.typing import NDArray

from ceilvo.calib.cli import main
from ceilvo.calib.targets.board import MARKER, TAGS, Board, Kind
from ceilvo.calib.targets.printed import BAR_MM, MARGIN_MM, PAPERS_MM

Array = NDArray[np.float64]
Gray = NDArray[np.uint8]

DPI = 300.0
PX_A_MM = DPI / 25.4
SIZES: dict[Kind, tuple[int, int]] = {
    "chessboard": (9, 6),
    "charuco": (9, 6),
    "aprilgrid": (6, 4),
    "circles": (9, 6),
    "acircles": (4, 11),
}


def page(path: Path) -> tuple[Gray, str, tuple[float, float]]:
    """The page as a rasteriser of its own draws it, its text and its size in mm."""
    document = pypdfium2.PdfDocument(path)
    try:
        sheet = document[0]
        text = sheet.get_textpage().get_text_range()
        image = sheet.render(scale=DPI / 72.0, grayscale=True).to_numpy()
        width, height = sheet.get_size()
        return (
            np.asarray(image, np.uint8).reshape(image.shape[:2]).copy(),
            text,
            (width / 72 * 25.4, height / 72 * 25.4),
        )
    finally:
        document.close()


def make(path: Path, *options: str) -> tuple[Gray, str, tuple[float, float]]:
    assert main(["board", str(path), *options]) == 0
    return page(path)


def refined(gray: Gray, corners: Array) -> Array:
    until = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 50, 1e-4)
    return np.asarray(
        cv2.cornerSubPix(gray, corners.astype(np.float32).reshape(-1, 1, 2), (9, 9), (-1, -1), until), np.float64
    ).reshape(-1, 2)


def seen_mm(gray: Gray, kind: Kind, legacy: bool = False) -> Array:
    """Corners in order by OpenCV's own finders, mm on the page."""
    c, r = SIZES[kind]
    if kind == "chessboard":
        found, corners = cv2.findChessboardCorners(gray, (c, r))
        assert found
        return refined(gray, np.asarray(corners, np.float64)) / PX_A_MM
    if kind == "charuco":
        words = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_100)
        board = cv2.aruco.CharucoBoard((c, r), 1.0, MARKER["charuco"], words)
        board.setLegacyPattern(legacy)
        corners, ids, _, _ = cv2.aruco.CharucoDetector(board).detectBoard(gray)
        assert ids is not None and len(ids) == (c - 1) * (r - 1)
        return refined(gray, np.asarray(corners, np.float64)) / PX_A_MM
    if kind == "aprilgrid":
        p = cv2.aruco.DetectorParameters()
        p.markerBorderBits = 2
        words = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
        quads, ids, _ = cv2.aruco.ArucoDetector(words, p).detectMarkers(gray)
        assert ids is not None and sorted(np.ravel(ids)) == list(range(c * r))
        return refined(gray, np.concatenate([quads[i][0] for i in np.argsort(np.ravel(ids))])) / PX_A_MM
    flags = cv2.CALIB_CB_SYMMETRIC_GRID if kind == "circles" else cv2.CALIB_CB_ASYMMETRIC_GRID
    blobs = cv2.SimpleBlobDetector_Params()
    blobs.maxArea = 1e6
    found, centres = cv2.findCirclesGrid(gray, (c, r), flags=flags, blobDetector=cv2.SimpleBlobDetector_create(blobs))
    assert found
    return np.asarray(centres, np.float64).reshape(-1, 2) / PX_A_MM


@pytest.mark.parametrize("paper", PAPERS_MM)
@pytest.mark.parametrize("kind", SIZES)
def test_a_printed_board_is_found_and_has_its_sizes(tmp_path: Path, kind: Kind, paper: str) -> None:
    gray, text, size = make(tmp_path / "b.pdf", "--board", kind, "--paper", paper)
    assert sorted(size) == pytest.approx(sorted(PAPERS_MM[paper]), abs=0.01)
    words = text.split()
    told = dict(itertools.pairwise(words))
    square_mm = float(told["--square-mm"])
    marker_mm = float(told.get("--marker-mm", MARKER[kind] * square_mm))
    board = Board(kind, *SIZES[kind], square_mm / 1e3, marker_mm / 1e3, TAGS if kind == "aprilgrid" else "5X5_100")
    at, true = seen_mm(gray, kind), 1e3 * board.corners_m[:, :2]
    if kind in ("chessboard", "circles", "acircles") and np.dot(at[-1] - at[0], true[-1] - true[0]) < 0:
        at = at[::-1]
    off = at - true
    assert np.ptp(off, axis=0).max() < 0.1, "the same shift for all, and no scale"
    ink = np.argwhere(gray < 128) / PX_A_MM
    assert ink.min() > MARGIN_MM - 0.1 and (ink.max(axis=0) < np.array(size)[::-1] - MARGIN_MM + 0.1).all()
    assert f"--board {kind} --columns {SIZES[kind][0]} --rows {SIZES[kind][1]}" in " ".join(text.split())


def test_the_bar_is_as_long_as_it_says(tmp_path: Path) -> None:
    gray, text, (_, height) = make(tmp_path / "b.pdf")
    row = gray[round((height - MARGIN_MM - 11.0) * PX_A_MM)]
    ticks = np.flatnonzero(row < 128) / PX_A_MM
    assert f"The bar is {BAR_MM:g} mm" in text
    assert np.ptp(ticks) == pytest.approx(BAR_MM, abs=0.3)  # ticks are 0.2 mm wide
    groups = np.split(ticks, np.flatnonzero(np.diff(ticks) > 1.0) + 1)
    assert [g.mean() - groups[0].mean() for g in groups] == pytest.approx(np.arange(11) * 10.0, abs=0.1)


def test_legacy_boards_are_printed_as_they_were(tmp_path: Path) -> None:
    gray, text, _ = make(tmp_path / "b.pdf", "--board", "charuco", "--legacy")
    assert "--legacy" in text
    at = seen_mm(gray, "charuco", legacy=True)
    assert len(at) == 40


def test_a_board_that_does_not_fit_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "b.pdf"
    assert main(["board", str(file), "--square-mm", "40"]) == 78
    assert "expected at most 24.3 on A4" in capsys.readouterr().err and not file.exists()
    assert main(["board", str(file), "--square-mm", "24"]) == 0
    assert main(["board", str(file)]) == 78
    assert "pass --force" in capsys.readouterr().err
    assert main(["board", str(file), "--force"]) == 0


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        (["--board", "charuco", "--columns", "40", "--rows", "40"], "800 markers, expected at most the 100 of 5X5_100"),
        (["--legacy"], "--legacy: found a board of kind chessboard, expected charuco"),
        (["--square-mm", "0.025"], "looks like metres; expected 25"),
        (["--board", "circles", "--square-mm", "10", "--marker-mm", "12"], "expected less than the square's"),
        (["--board", "charuco", "--dictionary", "7X7_12"], "found dictionary '7X7_12'"),
        (["--columns", "2"], "expected 3 to 40 each way"),
    ],
)
def test_a_board_that_cannot_be_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], options: list[str], reason: str
) -> None:
    assert main(["board", str(tmp_path / "b.pdf"), *options]) == 78
    assert reason in capsys.readouterr().err
