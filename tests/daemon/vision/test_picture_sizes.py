"""One ceiling, seen by cameras of many sizes: the same crossings, whatever a pixel is."""

from dataclasses import replace

import numpy as np
import pytest

from ceilvo.bench.vision.condition import Condition
from ceilvo.bench.vision.conditions import conditions
from ceilvo.bench.vision.run import Options, run
from ceilvo.camera import LevelView
from ceilvo.daemon.vision.edge_tracking import look_ups
from ceilvo.sim.rig import simulated_calibration, simulated_camera

SIZES = [(320, 240), (323, 243), (640, 480), (641, 479), (644, 482), (1280, 960), (1920, 1080)]
SECONDS, RATE_HZ = 0.8, 10.0
RECALL_PCT, PRECISION_PCT = 97.0, 98.0
USUAL = simulated_calibration()


def of_size(condition: Condition, width: int, height: int) -> Condition:
    return replace(condition, true=simulated_calibration(simulated_camera("pinhole", width, height)), fps=RATE_HZ)


@pytest.mark.parametrize(("width", "height"), SIZES)
def test_the_grid_is_found_in_pictures_of_any_size(width: int, height: int) -> None:
    base = conditions()[0]
    figures = run(of_size(base, width, height), Options(seconds=SECONDS, baselines=False))
    print(f"{width}x{height}: recall of the grid {figures['recall_grid_pct']:.1f} %, {figures}")
    assert figures["recall_grid_pct"] >= RECALL_PCT
    assert figures["precision_pct"] >= PRECISION_PCT
    assert figures["worst_mm"] < 2.0


@pytest.mark.parametrize(
    ("width", "height", "reduction"), [(640, 480, 1), (644, 482, 1), (1280, 960, 2), (1923, 1081, 3)]
)
def test_a_large_picture_is_looked_at_as_a_smaller_camera_takes_it(width: int, height: int, reduction: int) -> None:
    view = simulated_calibration(simulated_camera("pinhole", width, height)).level_view
    assert view.reduction == reduction
    assert abs(view.focal_px - USUAL.level_view.focal_px) < 5.0
    assert view.reduced(np.zeros((height, width), np.uint8)).shape == (height // reduction, width // reduction)


def test_a_long_lens_keeps_its_pixels() -> None:
    camera = replace(simulated_camera(), fx_px=1600.0, fy_px=1600.0)
    assert simulated_calibration(camera).level_view.reduction == 1


def test_a_bright_square_stays_where_it_is_in_a_reduced_picture() -> None:
    """Its middle, found in the reduced picture, is its middle in the whole one."""
    view = LevelView(USUAL.camera, np.eye(3), 100.0, reduction=3)
    gray = np.zeros((480, 640), np.uint8)
    gray[120:135, 201:222] = 200
    y, x = np.nonzero(view.reduced(gray))
    middle = view.whole_px(np.array([[x.mean(), y.mean()]]))
    assert np.allclose(middle, [[211.0, 127.0]])
    assert np.allclose(view.reduced_px(middle), [[x.mean(), y.mean()]])


def test_the_look_ups_of_a_reduced_view_undo_each_other() -> None:
    calibration = simulated_calibration(simulated_camera("pinhole", 1280, 960))
    grids = look_ups(calibration, 70.0)
    rows, columns = 40, 60
    level = grids.lookup[rows, columns]
    at = (level - np.array(grids.low_px)) / grids.cell_px
    i, j = np.floor(at).astype(int)
    fx, fy = at - [i, j]
    corners = grids.raw_of_level[j : j + 2, i : i + 2]
    raw = (1 - fy) * ((1 - fx) * corners[0, 0] + fx * corners[0, 1]) + fy * (
        (1 - fx) * corners[1, 0] + fx * corners[1, 1]
    )
    assert np.abs(raw - [2 * columns, 2 * rows]).max() < 0.05
