"""The judge of recorded lamps, on lamps that were drawn where they are known to be."""

import cv2
import numpy as np
import pytest

from ceilvo import se2
from ceilvo.bench.real.command import LAMP_PITCH_M, lamps_calibration
from ceilvo.bench.real.lamp_grid import Lamps, judge, seen
from ceilvo.types import Array

PITCH = np.array(LAMP_PITCH_M)


def drawn(centres_m: Array) -> np.ndarray:
    """Lamps of 0.6 x 0.6 m at places in base, through the recording's fisheye."""
    cal, frame = lamps_calibration(), np.zeros((480, 640), np.uint8)
    edge = np.linspace(-0.3, 0.3, 40)
    side = np.full(40, 0.3)
    outline = np.concatenate([np.column_stack(p) for p in ((edge, -side), (side, edge), (-edge, side), (-side, -edge))])
    level_from_ceiling = np.linalg.inv(cal.ceiling_from_level)
    for c in centres_m:
        s = np.column_stack([outline + c, np.ones(len(outline))]) @ level_from_ceiling.T
        raw = cal.level_view.to_raw(s[:, :2] / s[:, 2:])
        cv2.fillPoly(frame, [np.round(raw).astype(np.int32)], (255,))
    return frame


def test_lamps_are_found_where_they_were_drawn() -> None:
    there = np.array([[0.6, 0.4], [-0.7, -0.5]])
    found = seen([drawn(there)], lamps_calibration())
    assert len(found.xy_m) == 2
    assert np.abs(found.xy_m[np.argsort(-found.xy_m[:, 0])] - there).max() < 0.02
    assert len(seen([np.zeros((480, 640), np.uint8)], lamps_calibration()).xy_m) == 0


@pytest.mark.parametrize("stretch", [0.0, 0.02])
def test_a_path_that_is_too_long_shows(stretch: float) -> None:
    rng = np.random.default_rng(4)
    true = np.column_stack([np.linspace(0.0, 8.0, 90), np.linspace(0.0, 4.0, 90), np.linspace(0.0, 0.3, 90)])
    nodes = PITCH * np.array([(i, j) for i in range(-2, 6) for j in range(-2, 4)])
    frame, xy = [], []
    for k, pose in enumerate(true):
        base = se2.transform(se2.inverse(pose), nodes)
        near = base[np.hypot(*base.T) < 2.5]
        frame += [k] * len(near)
        xy.append(near + rng.normal(0, 0.003, near.shape))
    lamps = Lamps(np.array(frame), np.concatenate(xy))
    told = true * np.array([1.0 + stretch, 1.0, 1.0])
    judged = judge(lamps, told, PITCH)
    assert judged.stretch == pytest.approx(stretch, abs=0.003)
    assert (judged.off_m < 0.006) is (stretch == 0.0)
    assert judged.step_m < 0.01
