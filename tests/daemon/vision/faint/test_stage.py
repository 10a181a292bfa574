"""Faint lines in the finder: where they help, where they must not, and both kinds of lines as one set."""

from dataclasses import replace

import numpy as np
import pytest

from ceilvo import se2
from ceilvo.config import Features
from ceilvo.daemon.vision.crossings import cross
from ceilvo.daemon.vision.faint.merging import folded, merged, named_alike, seen_at
from ceilvo.daemon.vision.finder.line_finder import LineFinder
from ceilvo.daemon.vision.rolling_shutter import TwistPrior
from ceilvo.sim.ceiling.spec import CeilingSpec
from ceilvo.sim.motion import LapSpec
from ceilvo.sim.rig import simulated_calibration, simulated_camera
from ceilvo.sim.world import World, WorldSpec
from ceilvo.types import Array, LineKind, Lines

SEED = 6
FOCAL_PX = 410.0
STEP = np.array([0.35 / 30.0, 0.0, 0.0])
FAINT = CeilingSpec(groove_darker=0.035, tile_spread=0.0)
"""Three grey levels deep."""
USUAL_LAP = WorldSpec().lap


def world(ceiling: CeilingSpec, readout_s: float = 0.0, lap: LapSpec = USUAL_LAP) -> World:
    calibration = simulated_calibration(simulated_camera(readout_s=readout_s))
    out = World(WorldSpec(seed=SEED, ceiling=ceiling, lap=lap), calibration)
    out.start(0)
    return out


def joints_found(
    world: World, finder: LineFinder, t_s: float, twist: Array = 30.0 * STEP, within_px: float = 3.0
) -> tuple[int, int]:
    """Crossings of joints well inside a frame, and how many of them are reported within so many pixels."""
    calibration = world.calibration
    lines = finder(world.frame_at(t_s), twist / 30.0, twist=TwistPrior(twist, np.full(3, 0.01)))
    xy, crossing_type = world.ceiling.true_crossings()
    base = se2.transform(se2.inverse(world.truth_at(t_s)), xy[crossing_type == 0])
    uv = np.column_stack([base, np.ones(len(base))]) @ calibration.level_from_ceiling.T
    uv = uv[:, :2] / uv[:, 2:]
    raw = calibration.level_view.to_raw(uv)
    uv = uv[np.all((raw > 20) & (raw < [620, 460]), axis=1)]
    found = np.zeros((0, 2)) if lines is None else cross(lines, calibration, Features()).uv_px
    apart = np.hypot(*(uv[:, None] - found[None]).transpose(2, 0, 1)) if len(found) else np.full((len(uv), 1), 9.0)
    return len(uv), int(np.count_nonzero(apart.min(axis=1) < within_px))


def recall(world: World, features: Features) -> float:
    finder = LineFinder(world.calibration, features)
    counts = np.array([joints_found(world, finder, 1.0 + k / 30.0) for k in range(12)])
    return float(counts[:, 1].sum() / counts[:, 0].sum())


def test_joints_of_three_grey_levels_are_found() -> None:
    room = world(FAINT)
    with_them, without = recall(room, Features()), recall(room, Features(faint_lines=False))
    print(f"seed {SEED}: recall {with_them:.3f} with faint lines, {without:.3f} by edge points alone")
    assert with_them > 0.85
    assert without < with_them - 0.2


@pytest.mark.parametrize(("speed_mps", "at_s"), [(0.35, 2.0), (1.2, 3.0), (1.2, 5.0)])
def test_they_are_found_by_a_rolling_shutter_of_a_robot_that_drives(speed_mps: float, at_s: float) -> None:
    """1.2 m/s move a row by 2.2 px in half of a readout of 20 ms, a bend by as much again."""
    room = world(FAINT, 0.020, LapSpec(speed_mps=speed_mps, corner_radius_m=0.8))
    finder, counts = LineFinder(room.calibration, Features()), []
    for k in range(12):
        t_s = at_s + k / 30.0
        twist = 100.0 * se2.between(room.truth_at(t_s - 0.005), room.truth_at(t_s + 0.005))
        counts.append(joints_found(room, finder, t_s, twist, 1.2))
    seen, found = np.sum(counts, axis=0)
    print(f"seed {SEED}: twist {np.round(twist, 2)}, {found} of {seen} joints within 1.2 px")
    assert finder.state.faint.helps
    assert found > 0.85 * seen


def test_where_edge_points_do_faint_lines_change_nothing() -> None:
    """One look, not at the first frame, for which a robot that starts waits, and then none for ten seconds."""
    room = world(CeilingSpec())
    finder, paper = (LineFinder(room.calibration, Features(faint_lines=f)) for f in (True, False))
    looked = []
    for k in range(60):
        frame = room.frame_at(1.0 + k / 30.0)
        lines, plain = finder(frame, STEP), paper(frame, STEP)
        assert lines is not None and plain is not None
        assert not finder.state.faint.helps
        assert np.array_equal(lines.offset_px, plain.offset_px)
        if finder.state.faint.since_look == 0:
            looked.append(k)
    print(f"seed {SEED}: looked at frame {looked}")
    assert looked == [2]


def test_it_goes_on_frame_after_frame_while_it_helps_and_ends_where_it_does_not() -> None:
    faint, plain = world(FAINT), world(CeilingSpec())
    finder = LineFinder(faint.calibration, Features())
    for k in range(4):
        finder(faint.frame_at(1.0 + k / 30.0), STEP)
        assert finder.state.faint.helps and finder.state.faint.since_look == 0
    for k in range(2):
        finder(plain.frame_at(2.0 + k / 30.0), STEP)
    assert not finder.state.faint.helps


def lines_of(psi: float, rows: list[tuple[int, float, LineKind, int]], tilt: Array | None = None) -> Lines:
    """Lines (axis, offset px, kind, length px) with a point a pixel, about the middle."""
    points, owner = [], []
    for k, (axis, offset, _, length) in enumerate(rows):
        angle = psi + axis * np.pi / 2
        n, t = np.array([np.cos(angle), np.sin(angle)]), np.array([-np.sin(angle), np.cos(angle)])
        along = np.arange(length) - 0.5 * (length - 1)
        points.append(offset * n + along[:, None] * t)
        owner += [k] * length
    zero = np.zeros(2)
    return Lines(
        psi_rad=psi,
        psi_sigma_rad=0.001,
        axis=np.array([r[0] for r in rows]),
        offset_px=np.array([r[1] for r in rows]),
        sigma_px=np.full(len(rows), 0.1),
        kind=np.array([int(r[2]) for r in rows]),
        support=np.array([r[3] for r in rows]),
        tilt_rad=zero if tilt is None else tilt,
        tilt_sigma_rad=np.full(2, 0.001),
        free_tilt_rad=zero,
        free_tilt_sigma_rad=np.full(2, 0.001),
        points=np.concatenate(points).astype(np.float32),
        point_line=np.array(owner),
    )


G, R = LineKind.GROOVE, LineKind.RISING


def test_lines_of_both_are_there_once() -> None:
    edge = lines_of(0.1, [(0, 10.0, G, 40), (0, 100.0, R, 60), (1, -50.0, G, 300)])
    faint = lines_of(0.1, [(0, 10.5, G, 300), (0, 101.5, G, 300), (1, -49.5, G, 100), (1, 80.0, G, 200)])
    both = merged(edge, faint, FOCAL_PX, Features().groove_deg)
    assert both.axis.tolist() == [0, 0, 1, 1]
    assert np.allclose(both.offset_px, [10.5, 101.5, -50.0, 80.0], atol=1e-6)  # by the longer; a half-seen groove
    assert (both.kind == G).all()
    assert both.support.tolist() == [340, 360, 400, 200]
    assert np.bincount(both.point_line).tolist() == [340, 360, 400, 200]


def test_a_faint_line_along_an_edge_is_the_edges_own_answer_and_a_joint_beside_a_lamp_is_not() -> None:
    edge = lines_of(0.1, [(0, 10.0, R, 300), (0, 100.0, R, 60), (1, -50.0, R, 60)])
    faint = lines_of(0.1, [(0, 15.0, G, 280), (0, 105.0, G, 280), (1, 20.0, G, 200)])
    both = merged(edge, faint, FOCAL_PX, Features().groove_deg)
    assert np.allclose(both.offset_px, [10.0, 100.0, -50.0, 105.0, 20.0], atol=1e-6)
    assert both.support.tolist() == [300, 60, 60, 280, 200]
    assert np.bincount(both.point_line).tolist() == [300, 60, 60, 280, 200]
    wide = merged(edge, faint, FOCAL_PX, groove_deg=1.6)
    assert 15.0 in np.round(wide.offset_px, 6), "it may be the middle of a groove of which edge points show a side"


@pytest.mark.parametrize("turns", [-2, -1, 0, 1, 2])
def test_axes_named_otherwise_are_the_same_lines(turns: int) -> None:
    edge = lines_of(0.1, [(0, 10.0, R, 40), (1, -50.0, R, 300)])
    other = named_alike(edge, 0.1 + turns * np.pi / 2)
    assert other.psi_rad == pytest.approx(0.1 + turns * np.pi / 2)
    back = named_alike(other, 0.1)
    assert np.allclose(back.offset_px, edge.offset_px) and back.kind.tolist() == edge.kind.tolist()
    assert folded(other).psi_rad == pytest.approx(0.1)
    normal = other.psi_rad + other.axis * np.pi / 2
    at = other.offset_px[:, None] * np.column_stack([np.cos(normal), np.sin(normal)])
    own = edge.psi_rad + edge.axis * np.pi / 2
    expected = edge.offset_px[:, None] * np.column_stack([np.cos(own), np.sin(own)])
    assert np.allclose(at, expected)


def test_lines_by_another_direction_and_tilt_pass_through_their_own_points() -> None:
    edge = lines_of(0.1, [(0, 150.0, G, 200), (1, -120.0, G, 200)])
    other = replace(edge, psi_rad=0.101, tilt_rad=np.array([0.002, -0.001]))
    moved = seen_at(edge, other, FOCAL_PX)
    ray = np.column_stack([edge.points / FOCAL_PX, np.ones(len(edge.points))])
    w = np.array([0.002, -0.001, 0.0])
    turned = ray + np.cross(w, ray)
    expected = FOCAL_PX * turned[:, :2] / turned[:, 2:]
    assert np.abs(moved.points - expected).max() < 1e-3
    normal = 0.101 + edge.axis * np.pi / 2
    across = np.cos(normal)[edge.point_line] * expected[:, 0] + np.sin(normal)[edge.point_line] * expected[:, 1]
    mean = np.bincount(edge.point_line, across) / np.bincount(edge.point_line)
    assert np.abs(moved.offset_px - mean).max() < 1e-3
