"""Ranges and marks in the whole pipeline: they find the place, and leave alone what vision knows."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from ceilvo import se2
from ceilvo.bench.place import radio
from ceilvo.bench.place.case import drive_in, load_known
from ceilvo.bench.place.ceiling.worlds import World, WorldSpec, make_world
from ceilvo.bench.place.robot.drive import Drive
from ceilvo.calibration import Calibration
from ceilvo.daemon.relocalisation.beacons.anchors import AnchorTable
from ceilvo.daemon.relocalisation.beacons.mark_poses import MarkPose, corners
from ceilvo.daemon.replay.inputs import KnownBeacons, Sighting, input_json, read_input
from ceilvo.daemon.replay.snapshot import freeze, restore, snapshot_json
from ceilvo.senses.beacons import Anchor, Beacons, Lamp, LampSeen, Mark, MarkSeen, Range
from ceilvo.senses.heard import NOTHING, Heard
from ceilvo.sim.radio import Radio, RadioSpec, in_corners
from ceilvo.sim.rig import simulated_calibration
from ceilvo.types import Array, Displacement, Estimate, Frame, Motion, Pose, State

SPOT = np.array([2.2, 2.7])
MARK = Mark(5, 0.2, *SPOT, 0.4, 0.005, 0.005)


def small_drive(seed: int, lamps: str = "sparse") -> tuple[Drive, World]:
    world = make_world(WorldSpec("5", 0.6, lamps, seed))  # type: ignore[arg-type]
    drive = drive_in(world, np.random.default_rng(seed), False, 10.0, False, 0.5)
    load_known(drive, world, np.random.default_rng(seed))
    return drive, world


def with_ranges(drive: Drive, world: World, spec: RadioSpec) -> None:
    rng = np.random.default_rng(9)
    anchors = in_corners(np.array(world.room[:2]), np.array(world.room[2:]), 4, rng)
    at = se2.transform(Pose(world.map_from_ceiling), np.array([[a.x_m, a.y_m] for a in anchors]))
    placed = tuple(replace(a, x_m=float(p[0]), y_m=float(p[1])) for a, p in zip(anchors, at, strict=True))
    module = Radio(placed, spec, rng)
    drive.pipeline.relocaliser.know(Beacons(placed))
    drive.senses = lambda stamp_ns: Heard(ranges=module.ranges(stamp_ns, np.array([*drive.pose[:2], 0.5])))


def seen(c: Calibration, pose: Array, mark: Mark) -> tuple[MarkSeen, ...]:
    """The mark as a camera at a pose sees it, or nothing."""
    at = se2.compose(se2.inverse(pose), np.array([mark.x_m, mark.y_m, mark.theta_rad]))
    s = np.column_stack([se2.transform(Pose(at), corners(mark.size_m)), np.ones(4)]) @ c.level_from_ceiling.T
    uv = s[:, :2] / s[:, 2:]
    inside = np.all((uv > 5.0) & (uv < np.array([c.camera.width_px, c.camera.height_px]) - 5.0))
    return (MarkSeen(mark.number, c.level_view.to_raw(uv)),) if inside else ()


def estimates(drive: Drive, seconds: float) -> list[Estimate]:
    out = [drive.tick() for _ in range(round(seconds / drive.dt_s))]
    return [e for e in out if e is not None]


def test_a_good_fix_is_not_moved() -> None:
    """By bad ranges either; the bar is one per cent of a sigma."""
    plain, world = small_drive(4)
    ranged, _ = small_drive(4)
    with_ranges(ranged, world, RadioSpec(noise_m=0.3, offset_m=0.5, obstructed=0.5))
    a, b = estimates(plain, 8.0), estimates(ranged, 8.0)
    tracking = [(x, y) for x, y in zip(a, b, strict=True) if x.state is State.TRACKING]
    assert len(tracking) > 60 and all(y.state is State.TRACKING for _, y in tracking)
    moved = [np.max(np.abs(y.pose - x.pose) / np.sqrt(np.diag(x.cov))) for x, y in tracking]
    print("moved by at most", max(moved), "sigmas;", ranged.pipeline.relocaliser.beacons.taken, "ranges")
    assert max(moved) <= 0.01
    assert ranged.pipeline.relocaliser.beacons.taken > 200


def test_what_ranges_are_off_by_is_learnt_on_the_way() -> None:
    drive, world = small_drive(4)
    with_ranges(drive, world, RadioSpec(noise_m=0.05, offset_m=0.2, obstructed=0.0))
    estimates(drive, 20.0)
    table = drive.pipeline.relocaliser.beacons.anchors
    module = drive.senses
    assert module is not None
    heard = [r for k in range(200) for r in module(k).ranges]
    which = np.array([table.names.index(r.anchor) for r in heard])
    distance, _ = table.distances(which, np.repeat(drive.pose[None, :2], len(which), axis=0), 0.5)
    residual = np.array([r.range_m for r in heard]) - table.expected(which, distance)
    left = [float(np.mean(residual[which == a])) for a in range(4)]
    print("left of the errors", np.round(left, 3), "offsets", np.round(table.fit[:, 0], 3))
    assert np.max(np.abs(left)) < 0.08 < np.max(np.abs(table.fit[:, 0]))


def test_a_start_anywhere_under_a_perfect_raster_is_found() -> None:
    r = radio.start(300, 8, "20", 3, 0.3, 0.0)
    print("found after", r["found_s"], "s")
    assert r["found_s"] is not None and r["found_s"] <= 5.0 and not r["run"]["wrong_s"]


def tell_marks(drive: Drive, where: Callable[[], Mark], known: Mark = MARK) -> None:
    c = simulated_calibration(tile_m=0.6)
    drive.pipeline.relocaliser.know(Beacons(marks=(known,)))
    drive.senses = lambda stamp_ns: Heard(marks=seen(c, drive.pose, where()))


def at_spot(drive: Drive, world: World) -> None:
    """The robot stands below the mark."""
    in_room = se2.transform(Pose(se2.inverse(world.map_from_ceiling)), SPOT[None])[0]
    drive.room_pose = np.array([*in_room, 0.3])
    drive.conditions.speed = 0.0


def test_one_mark_in_view_ends_a_search_where_nothing_else_is_seen() -> None:
    drive, world = small_drive(6)
    at_spot(drive, world)
    drive.load(*drive.stored()[:2] if drive.stored() else _map(drive), pose=np.array([9.0, -7.0, 2.0]))  # type: ignore[misc]
    tell_marks(drive, lambda: MARK)
    drive.conditions.dark = True
    after = estimates(drive, 0.5)
    off = after[-1].pose - drive.pose
    print(after[-1].state, off)
    assert np.hypot(off[0], off[1]) < 0.02 and drive.pipeline.relocaliser.sure


def _map(drive: Drive) -> tuple[object, float]:
    landmarks, axis = drive.estimator.map()
    return landmarks, axis or 0.0


def test_a_mark_that_hangs_elsewhere_is_named_and_does_no_harm() -> None:
    drive, world = small_drive(6)
    at_spot(drive, world)
    drive.load(*_map(drive), pose=drive.pose)  # type: ignore[arg-type]
    assert drive.settle(20.0)
    tell_marks(drive, lambda: replace(MARK, x_m=MARK.x_m + 0.5))
    after = estimates(drive, 2.0)
    news = drive.pipeline.relocaliser.take_news()
    print(news, after[-1].state, after[-1].pose - drive.pose)
    assert len(news) == 1 and "mark 5" in news[0] and "0.50 m" in news[0] and "ignored" in news[0]
    assert all(e.state is State.TRACKING for e in after)
    assert np.hypot(*(after[-1].pose - drive.pose)[:2]) < 0.01


def test_a_search_that_a_wrong_mark_has_ended_is_put_right_by_the_ceiling() -> None:
    drive, world = small_drive(6)
    at_spot(drive, world)
    drive.load(*_map(drive), pose=np.array([9.0, -7.0, 2.0]))  # type: ignore[arg-type]
    tell_marks(drive, lambda: replace(MARK, x_m=MARK.x_m + 1.2))
    drive.conditions.dark = True
    off = estimates(drive, 0.5)[-1].pose - drive.pose
    assert np.hypot(off[0], off[1]) > 1.0, "nothing else was to be seen"
    drive.conditions.dark, drive.conditions.speed = False, 1.0
    after = estimates(drive, 40.0)
    off = after[-1].pose - drive.pose
    print([e.state.name for e in after[::20]], off, drive.pipeline.relocaliser.take_news())
    assert after[-1].state is State.TRACKING and np.hypot(off[0], off[1]) < 0.05


LAMPS = tuple(
    Lamp(f"L{k}", *(SPOT + off).tolist(), sigma_m=0.005)
    for k, off in enumerate(np.array([[0.1, 0.2], [-0.7, 0.5], [0.8, -0.3], [-0.5, -0.6], [0.4, 0.9], [6.0, 1.0]]))
)


def tell_lamps(drive: Drive, hang: tuple[Lamp, ...]) -> None:
    """LAMPS are known, and so they hang."""
    c = simulated_calibration(tile_m=0.6)
    drive.pipeline.relocaliser.know(Beacons(lamps=LAMPS))
    places = np.array([[one.x_m, one.y_m] for one in hang])
    size = np.array([c.camera.width_px, c.camera.height_px])

    def seen(stamp_ns: int) -> Heard:
        at = se2.transform(Pose(se2.inverse(drive.pose)), places)
        s = np.column_stack([at, np.ones(len(at))]) @ c.level_from_ceiling.T
        px = c.level_view.to_raw(s[:, :2] / s[:, 2:])
        return Heard(lamps=tuple(LampSeen(one) for one in px[np.all((px > 5.0) & (px < size - 5.0), axis=1)]))

    drive.senses = seen


@pytest.mark.parametrize(("lights", "found"), [(1, False), (2, False), (4, True), (5, True)])
def test_several_lamps_that_lie_as_nowhere_else_end_a_search_and_one_or_two_do_not(lights: int, found: bool) -> None:
    drive, world = small_drive(6)
    at_spot(drive, world)
    drive.load(*_map(drive), pose=np.array([9.0, -7.0, 2.0]))  # type: ignore[arg-type]
    tell_lamps(drive, LAMPS[:lights])
    drive.conditions.dark = True
    after = estimates(drive, 1.0)
    off = after[-1].pose - drive.pose
    print(after[-1].state, off)
    assert (np.hypot(off[0], off[1]) < 0.03) == found
    assert drive.pipeline.relocaliser.sure == found


def test_a_lamp_that_hangs_elsewhere_is_named_and_one_that_is_off_too() -> None:
    drive, world = small_drive(6)
    at_spot(drive, world)
    drive.load(*_map(drive), pose=drive.pose)  # type: ignore[arg-type]
    assert drive.settle(20.0)
    tell_lamps(drive, (replace(LAMPS[0], y_m=LAMPS[0].y_m + 0.25), LAMPS[1], *LAMPS[3:]))
    after = estimates(drive, 4.0)
    news = drive.pipeline.relocaliser.take_news()
    learnt = drive.pipeline.relocaliser.beacons_learnt()["lamps"]
    print(news, learnt, after[-1].pose - drive.pose)
    assert learnt == {"ignored": ["L0"], "missing": ["L2"]}
    assert len(news) == 2 and "lamp L0 is 0.25 m off" in news[0] and "lamp L2 is not seen" in news[1]
    assert all(e.state is State.TRACKING for e in after)


def test_while_vision_measures_lamps_change_nothing() -> None:
    plain, _ = small_drive(4)
    lit, _ = small_drive(4)
    rng = np.random.default_rng(3)
    tell_lamps(lit, tuple(replace(one, x_m=one.x_m + 0.1 * rng.standard_normal()) for one in LAMPS))
    a, b = estimates(plain, 5.0), estimates(lit, 5.0)
    assert sum(e.state is State.TRACKING for e in a) > 40
    assert all(np.array_equal(x.pose, y.pose) and np.array_equal(x.cov, y.cov) for x, y in zip(a, b, strict=True))


def test_inputs_and_states_with_beacons_are_read_back() -> None:
    heard = Heard(ranges=(Range("A", 5, 1.25),), marks=(MarkSeen(3, np.arange(8.0).reshape(4, 2)),))
    heard = replace(heard, lamps=(LampSeen(np.array([3.5, 4.5])),))
    known = KnownBeacons(Beacons((Anchor("A", 1.0, 2.0, 3.0),), (MARK,), LAMPS))
    assert read_input(input_json(known, 4), _no_frame) == (4, known)
    drive, world = small_drive(4)
    with_ranges(drive, world, RadioSpec())
    estimates(drive, 1.0)
    again, _ = small_drive(4)
    restore(again.pipeline, snapshot_json(freeze(drive.pipeline), "joint"))
    a, b = drive.pipeline.relocaliser.beacons, again.pipeline.relocaliser.beacons
    np.testing.assert_array_equal(a.anchors.xyz_m, b.anchors.xyz_m)
    assert a.anchors.names == b.anchors.names and a.taken == b.taken
    given = Sighting(10**12, None, None, heard)
    x, y = (p.step_crossings(given.stamp_ns, None, heard=given.heard) for p in (drive.pipeline, again.pipeline))
    np.testing.assert_array_equal(x.pose, y.pose)


def test_a_gap_under_a_mark_is_read_back_also_as_an_older_program_wrote_it() -> None:
    drive, _ = small_drive(4)
    bridge, tight = drive.pipeline.relocaliser.bridge, 1e-4 * np.eye(3)
    still = Motion(Displacement(np.zeros(3)), tight, 0, 0.0, "dark")
    bridge.move(np.zeros(3), tight, still, AnchorTable(), np.zeros(3))
    bridge.see(MarkPose(7, np.array([0.02, 0.0, 0.01]), np.eye(3), tight, -np.eye(3), tight, 1e-4))
    tree = snapshot_json(freeze(drive.pipeline), "joint")
    tree["state"]["beacons"]["bridge"]["lean_var"] = 1e-4
    again, _ = small_drive(4)
    restore(again.pipeline, tree)
    for b in (bridge, again.pipeline.relocaliser.bridge):
        b.move(
            np.zeros(3),
            tight,
            Motion(Displacement(np.array([1.0, 0.0, 0.5])), 2.0 * tight, 0, 0.0, "dark"),
            AnchorTable(),
            np.zeros(3),
        )
    np.testing.assert_array_equal(bridge.state.mean, again.pipeline.relocaliser.bridge.state.mean)
    np.testing.assert_array_equal(bridge.state.cov, again.pipeline.relocaliser.bridge.state.cov)


def _no_frame(seq: int, stamp_ns: int) -> Frame:
    pytest.fail("no frame is needed")


def test_without_beacons_nothing_is_kept() -> None:
    drive, _ = small_drive(4)
    drive.senses = lambda stamp_ns: NOTHING
    estimates(drive, 1.0)
    b = drive.pipeline.relocaliser.beacons
    assert b.odom is None and len(b.window) == 0 and b.heard == 0
