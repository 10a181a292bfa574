"""Rows that are read one after the other: where they would be at one instant, by hand and from rendered frames."""

from __future__ import annotations

from types import ModuleType

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ceilvo.calibration import Calibration
from ceilvo.config import Features
from ceilvo.daemon.vision import kernel
from ceilvo.daemon.vision.finder.line_finder import LineFinder
from ceilvo.daemon.vision.kernel import reference
from ceilvo.daemon.vision.rolling_shutter import RollingShutter, TwistPrior
from ceilvo.sim.motion import LapSpec
from ceilvo.sim.rig import simulated_calibration, simulated_camera
from ceilvo.sim.world import World, WorldSpec
from ceilvo.types import Lines

READOUT_S = 0.02
SURE = np.full(3, 1e-6)
VAGUE = np.array([0.1, 0.1, 0.3])
BOTH = pytest.mark.parametrize("k", [reference, kernel], ids=["numpy", "compiled"])


def rig(readout_s: float, mount_xy_m: tuple[float, float] = (0.0, 0.0)) -> Calibration:
    return simulated_calibration(simulated_camera(readout_s=readout_s), mount_xy_m=mount_xy_m)


def moved(calibration: Calibration, twist: list[float], row: int, uv_px: list[float]) -> np.ndarray:
    """Where a level pixel of a row is at the middle's instant."""
    readout = RollingShutter(calibration, 70.0).readout(TwistPrior(np.array(twist), SURE))
    assert readout is not None
    c, s, x, y = readout.rows[row].astype(np.float64)
    return np.array([c * uv_px[0] - s * uv_px[1] + x, s * uv_px[0] + c * uv_px[1] + y])


def test_a_straight_drive_by_hand() -> None:
    """1 m/s forward: what the last row saw 10 ms later was then 10 mm nearer, of 2.2 m, f about 410 px."""
    calibration = rig(READOUT_S)
    late_s = READOUT_S * 239.5 / 480
    forward_px = calibration.level_view.focal_px * 1.0 * late_s / 2.2
    assert forward_px == pytest.approx(1.858, abs=2e-3)
    np.testing.assert_allclose(moved(calibration, [1.0, 0.0, 0.0], 479, [50.0, 90.0]), [50 + forward_px, 90], atol=1e-3)
    np.testing.assert_allclose(moved(calibration, [1.0, 0.0, 0.0], 0, [50.0, 90.0]), [50 - forward_px, 90], atol=1e-3)
    upside_down = moved(rig(-READOUT_S), [1.0, 0.0, 0.0], 479, [50.0, 90.0])
    np.testing.assert_allclose(upside_down, [50 - forward_px, 90], atol=1e-3)


def test_a_turn_by_hand() -> None:
    """1.5 rad/s about the base's origin, 10 cm behind the camera: 15 mrad in the last row."""
    calibration = rig(READOUT_S, (0.1, 0.0))
    turn = 1.5 * READOUT_S * 239.5 / 480
    origin_px = np.array([-0.1 * calibration.level_view.focal_px / 2.2, 0.0])
    rotation = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    expected = origin_px + rotation @ (np.array([200.0, 100.0]) - origin_px)
    np.testing.assert_allclose(moved(calibration, [0.0, 0.0, 1.5], 479, [200.0, 100.0]), expected, atol=1e-3)


def edge_arguments(seed: int, h: int, w: int) -> tuple[np.ndarray, ...]:
    rng = np.random.default_rng(seed)
    dx, dy = rng.integers(-900, 900, (2, h, w)).astype(np.int16)
    lookup = (np.stack(np.meshgrid(np.arange(w // 2 + 1), np.arange(h // 2 + 1)), -1) * 2.0).astype(np.float32)
    mask = (rng.random((h, w)) < 0.2).astype(np.uint8)
    angle = np.cumsum(rng.uniform(0, 1e-3, h + 1))
    rows = np.column_stack([np.cos(angle), np.sin(angle), *np.cumsum(rng.normal(0, 0.05, (2, h + 1)), axis=1)])
    return mask, dx, dy, lookup, np.zeros((h, w), np.uint16), rows.astype(np.float32)


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=30, deadline=None)
def test_both_kernels_move_points_alike(seed: int) -> None:
    *args, rows = edge_arguments(seed, 40, 60)
    uv, phi = reference.level_points(*args, 65535, rows)
    uv_c, phi_c = kernel.level_points(*args, 65535, rows)
    np.testing.assert_allclose(uv_c, uv, atol=1e-3)
    assert np.abs((phi_c - phi + 180) % 360 - 180).max(initial=0.0) < 0.05


@BOTH
def test_rows_at_rest_are_no_rows(k: ModuleType) -> None:
    *args, rows = edge_arguments(1, 40, 60)
    rest = np.tile(np.array([1, 0, 0, 0], np.float32), (41, 1))
    for a, b, c in zip(
        k.level_points(*args, 65535),
        k.level_points(*args, 65535, rest),
        k.level_points(*args, 65535, rows),
        strict=True,
    ):
        np.testing.assert_array_equal(a, b)
        assert not np.array_equal(a, c)


@BOTH
def test_a_table_of_another_picture_is_refused(k: ModuleType) -> None:
    *args, rows = edge_arguments(1, 40, 60)
    with pytest.raises(ValueError, match="rows of 40 x 4 numbers, expected 41 x 4"):
        k.level_points(*args, 65535, rows[:-1])


LAP = LapSpec(speed_mps=1.0, corner_radius_m=1.0 / 1.5)
TURNING_S = 3.1


def lines_of(readout_s: float, twist: TwistPrior | None) -> tuple[World, Lines]:
    """Of a frame in the bend, looked at whole, with what is believed of the readout being true."""
    world = World(WorldSpec(lap=LAP), rig(readout_s, (0.05, -0.03)))
    assert abs(world.twist_at(TURNING_S)[2]) > 1.4
    found = LineFinder(world.calibration, Features())(world.frame_at(TURNING_S), None, twist=twist)
    assert found is not None
    return world, found


def test_with_a_global_shutter_the_twist_changes_nothing() -> None:
    _, without = lines_of(0.0, None)
    _, with_twist = lines_of(0.0, TwistPrior(np.array([1.0, 0.0, 1.5]), SURE))
    for name in ("offset_px", "points", "psi_rad", "tilt_rad"):
        np.testing.assert_array_equal(getattr(without, name), getattr(with_twist, name))


@pytest.mark.parametrize("readout_s", [READOUT_S, -READOUT_S])
@pytest.mark.parametrize(("off", "sigma"), [([0.0, 0.0, 0.0], SURE), ([0.05, 0.0, -0.15], VAGUE)])
def test_lines_of_a_turn_are_those_of_a_global_shutter(readout_s: float, off: list[float], sigma: np.ndarray) -> None:
    """With the true twist, and with one that is off as it may be: the lines themselves then tell by how much."""
    world, still = lines_of(0.0, None)
    twist = world.twist_at(TURNING_S) + off
    rolling, found = lines_of(readout_s, TwistPrior(twist, sigma))
    turn_deg, tilt_deg = np.degrees(found.psi_rad - still.psi_rad), np.degrees(found.tilt_rad - still.tilt_rad)
    print(f"direction off by {turn_deg:.4f} deg, tilt by {tilt_deg.round(4)} deg")
    assert abs(turn_deg) < 0.01
    assert np.abs(tilt_deg).max() < 0.02
    global_rig = rig(0.0, (0.05, -0.03))
    uncorrected = LineFinder(global_rig, Features())(rolling.frame_at(TURNING_S), None)
    print("without:", None if uncorrected is None else (len(uncorrected.points), len(found.points)))
    assert uncorrected is None or len(uncorrected.points) < 0.9 * len(found.points), "or the test shows nothing"
