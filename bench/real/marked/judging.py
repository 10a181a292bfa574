"""Found lines against marked ones: what was found of the marked length, and which found lines nobody marked."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from ceilvo.bench.real.marked.reading import JOINT, Marked
from ceilvo.calibration import Calibration
from ceilvo.daemon.replay.drawing.overlay import line_in_raw
from ceilvo.types import Array, LineKind, Lines

OFFSET_PX = 2.0
"""Across a line, in pixels of the picture as it is looked at; chosen: marks and lens err by up to one, and a joint's
side is up to 1.5 from its middle. Edges of a batten are 4 apart, so its one side does not count for the other."""
ANGLE_DEG = 3.0
"""Between a found line and a mark; chosen: 2 px over 40, about the shortest line that the finder reports."""
ALONG_PX = 3.0
"""Along a line; chosen: above the distance of the places at which lines are compared."""
BAR_PX = 10.0
"""Between the two marked edges of a bar, such as a batten, whose middle is a groove to the finder; chosen: what
features.groove_deg pairs, 8.5 px of these cameras, and the error of two marks."""
IN_VIEW_DEG = 50.0
"""Off the vertical, what counts as in view, as in bench-vision; these cameras lean by up to 54 deg."""
TRUE_SHARE = 0.5
"""Of a found line's length, which must lie on marks; chosen: the greater part."""
CONTRAST_LEVELS = 3.0
"""Joints of less contrast are not asked for: the bar is for 3 grey levels."""
_MIDDLE, _SIDE = 0, 1


@dataclass(frozen=True, slots=True)
class Piece:
    """Places (N, 2) along one line, pixels as looked at, their tangents (N, 2) and the length (N,) each stands for."""

    at: Array
    tangent: Array
    length_px: Array


@dataclass(frozen=True, slots=True)
class Judged:
    """One picture's lines.

    Attributes:
        recall_joints: share of the length of joints of CONTRAST_LEVELS and more that was found, within IN_VIEW_DEG.
        recall_far: of those beyond; nan where there are none.
        recall_all: of all that is marked.
        true, spurious, apart: (L,) of the found lines: on marks; on none; mostly outside the ceiling, or where a
            pattern of its own hangs.
        on_marks: share of the found length in the ceiling that lies on marks.
        found: (M,) share of each mark that was found, nan where it is out of view.
    """

    recall_joints: float
    recall_far: float
    recall_all: float
    true: NDArray[np.bool_]
    spurious: NDArray[np.bool_]
    apart: NDArray[np.bool_]
    on_marks: float
    found: Array

    @property
    def spurious_share(self) -> float:
        """Of the lines found in the ceiling."""
        spurious, true = (int(np.count_nonzero(of)) for of in (self.spurious, self.true))
        return spurious / max(spurious + true, 1)


def judge(lines: Lines, marked: Marked, max_view_deg: float) -> Judged:
    """Compare the lines of a picture with its marks.

    Args:
        max_view_deg: marks further off the vertical are not asked for.
    """
    marks = [mark_piece(ends, marked.calibration, max_view_deg) for ends in marked.ends]
    asked = sum(len(m.at) for m in marks)
    middles = [mark_piece(ends, marked.calibration, max_view_deg) for ends in bar_middles(marked)]
    all_marks = _joined(marks + middles)
    covered = np.zeros(len(all_marks.at), bool)
    n = len(lines.axis)
    shares, inside_px = np.zeros((n, 2)), np.zeros(n)
    total_px, sides = np.zeros(n), np.zeros(n)
    for owner, role, piece in _found_pieces(lines, marked.calibration):
        match = _matches(piece, all_marks)
        covered |= match.any(axis=0)
        within = _within(piece.at, marked)
        in_px = float(np.sum(piece.length_px[within]))
        shares[owner, role] += float(np.sum(piece.length_px[within & match.any(axis=1)])) / max(in_px, 1e-9)
        if role == _MIDDLE:
            inside_px[owner], total_px[owner] = in_px, float(np.sum(piece.length_px))
        else:
            sides[owner] += 1.0
    share = np.maximum(shares[:, _MIDDLE], shares[:, _SIDE] / np.maximum(sides, 1.0))
    apart = inside_px < TRUE_SHARE * np.maximum(total_px, 1e-9)
    good = share >= TRUE_SHARE
    found = np.array([_share(m, c) for m, c in _split(marks, covered[:asked])])
    length = np.array([float(np.sum(m.length_px)) for m in marks])
    joints = np.array([k == JOINT for k in marked.kind]) & (marked.contrast >= CONTRAST_LEVELS)
    near = _in_view(marked)
    return Judged(
        recall_joints=_mean(found, length * (joints & near)),
        recall_far=_mean(found, length * (joints & ~near)),
        recall_all=_mean(found, length),
        true=good & ~apart,
        spurious=~good & ~apart,
        apart=apart,
        on_marks=_mean(share, inside_px * ~apart),
        found=found,
    )


def mark_piece(ends: Array, calibration: Calibration, max_view_deg: float) -> Piece:
    """A mark (2, 2) as the lens bends it, a place about every pixel as looked at."""
    view = calibration.level_view
    level = view.from_raw(ends)
    count = max(int(np.hypot(*(ends[1] - ends[0])) / view.reduction), 2)
    t = (np.arange(count + 1) / count)[:, None]
    on = level[0] + t * (level[1] - level[0])
    centre = np.array([view.camera.cx_px, view.camera.cy_px])
    seen = np.hypot(*(on - centre).T) < view.focal_px * np.tan(np.radians(max_view_deg))
    return _piece(np.where(seen[:, None], view.reduced_px(view.to_raw(on)), np.nan))


def bar_middles(marked: Marked) -> list[Array]:
    """Between every two marked edges of one kind that lie side by side, at most BAR_PX apart: (2, 2) raw pixels."""
    reach = BAR_PX * marked.calibration.level_view.reduction
    out = []
    for i, ends in enumerate(marked.ends):
        length = float(np.hypot(*(ends[1] - ends[0])))
        along = (ends[1] - ends[0]) / max(length, 1e-9)
        for j, other in enumerate(marked.ends[i + 1 :], i + 1):
            if marked.kind[i] != marked.kind[j]:
                continue
            away = other - ends[0]
            across = away @ np.array([-along[1], along[0]])
            low, high = np.clip(np.sort(away @ along), 0.0, length)
            if np.max(np.abs(across)) > reach or high - low < BAR_PX:
                continue
            on_i = ends[0] + np.array([[low], [high]]) * along
            t = (np.array([low, high]) - away[0] @ along) / float((away[1] - away[0]) @ along)
            out.append(0.5 * (on_i + other[0] + t[:, None] * (other[1] - other[0])))
    return out


def _found_pieces(lines: Lines, calibration: Calibration) -> list[tuple[int, int, Piece]]:
    """Of every line the middle, and of a groove's both sides where edge points show them: line, role, piece."""
    view = calibration.level_view
    out = []
    for k in range(len(lines.axis)):
        out.append((k, _MIDDLE, _piece(view.reduced_px(line_in_raw(lines, k, view)))))
        if lines.kind[k] != LineKind.GROOVE:
            continue
        angle = lines.psi_rad + 0.5 * np.pi * int(lines.axis[k])
        mine = lines.point_line == k
        off = lines.points[mine] @ np.array([np.cos(angle), np.sin(angle)]) - lines.offset_px[k]
        for side in (off < 0.0, off >= 0.0):
            if np.count_nonzero(side) < 2:
                continue
            one = replace(
                lines,
                offset_px=lines.offset_px + np.median(off[side]),
                points=lines.points[mine][side],
                point_line=np.full(np.count_nonzero(side), k),
            )
            out.append((k, _SIDE, _piece(view.reduced_px(line_in_raw(one, k, view)))))
    return out


def _piece(at: Array) -> Piece:
    """From places in their order, nan where there is a gap."""
    step = np.diff(at, axis=0)
    good = np.all(np.isfinite(step), axis=1)
    step, middle = step[good], (0.5 * (at[1:] + at[:-1]))[good]
    length = np.hypot(*step.T)
    some = length > 0.0
    return Piece(middle[some], step[some] / length[some, None], length[some])


def _matches(found: Piece, marks: Piece) -> NDArray[np.bool_]:
    """(F, M) whether a place of a found line lies on one of a mark."""
    out = np.zeros((len(found.at), len(marks.at)), bool)
    some = _beside(found, marks)
    away = found.at[:, None] - marks.at[some][None]
    tx, ty = marks.tangent[some].T
    along = away[..., 0] * tx + away[..., 1] * ty
    across = away[..., 0] * ty - away[..., 1] * tx
    turned = found.tangent[:, :1] * ty - found.tangent[:, 1:] * tx
    near = (np.abs(along) <= ALONG_PX) & (np.abs(across) <= OFFSET_PX)
    out[:, some] = near & (np.abs(turned) <= np.sin(np.radians(ANGLE_DEG)))
    return out


def _beside(found: Piece, marks: Piece) -> NDArray[np.int64]:
    """Places of marks that are near the chord of a found line at all; only these are compared, for time."""
    if not len(found.at):
        return np.zeros(0, np.int64)
    chord = found.at[-1] - found.at[0] if len(found.at) > 1 else found.tangent[0]
    normal = np.array([-chord[1], chord[0]]) / max(float(np.hypot(*chord)), 1e-9)
    off = (found.at - found.at[0]) @ normal
    off_marks = (marks.at - found.at[0]) @ normal
    reach = OFFSET_PX + ALONG_PX
    return np.flatnonzero((off_marks >= off.min() - reach) & (off_marks <= off.max() + reach))


def _in_view(marked: Marked) -> NDArray[np.bool_]:
    """(L,) whether the middle of a mark is within IN_VIEW_DEG of the vertical."""
    view = marked.calibration.level_view
    off = view.from_raw(marked.ends.mean(axis=1)) - [view.camera.cx_px, view.camera.cy_px]
    return np.asarray(np.hypot(*off.T) <= view.focal_px * np.tan(np.radians(IN_VIEW_DEG)), bool)


def _within(at: Array, marked: Marked) -> NDArray[np.bool_]:
    """(N,) whether places as looked at are in the ceiling and in nothing apart."""
    raw = marked.calibration.level_view.whole_px(at)
    good = _inside(raw, marked.ceiling)
    for corners in marked.apart:
        good &= ~_inside(raw, corners)
    return good


def _inside(raw: Array, corners: Array) -> NDArray[np.bool_]:
    outline = corners.astype(np.float32)
    return np.array([cv2.pointPolygonTest(outline, p, False) >= 0.0 for p in raw.tolist()], bool)


def _joined(pieces: list[Piece]) -> Piece:
    at, tangent, length = (np.concatenate([getattr(p, f) for p in pieces]) for f in ("at", "tangent", "length_px"))
    return Piece(at, tangent, length)


def _split(pieces: list[Piece], covered: NDArray[np.bool_]) -> list[tuple[Piece, NDArray[np.bool_]]]:
    bounds = np.cumsum([len(p.length_px) for p in pieces])[:-1]
    return list(zip(pieces, np.split(covered, bounds), strict=True))


def _share(piece: Piece, covered: NDArray[np.bool_]) -> float:
    length = float(np.sum(piece.length_px))
    return float(np.sum(piece.length_px[covered])) / length if length > 0.0 else float("nan")


def _mean(value: Array, weight: Array) -> float:
    """nan without weight; what has none need not have a value."""
    some = weight > 0.0
    return float(value[some] @ weight[some] / np.sum(weight[some])) if np.any(some) else float("nan")
