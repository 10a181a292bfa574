"""Plates, walls, joints and switched lamps of the simulator against projections worked out by hand."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from ceilvo import se2
from ceilvo.errors import ConfigError
from ceilvo.sim.ceiling.ceiling import Ceiling
from ceilvo.sim.ceiling.layout import CrossingType
from ceilvo.sim.ceiling.spec import CeilingSpec
from ceilvo.sim.motion import LapSpec
from ceilvo.sim.renderer import RenderSpec
from ceilvo.sim.surroundings.surroundings import Slab, SurroundingsSpec
from ceilvo.sim.world import World, WorldSpec
from ceilvo.types import LineKind

POSE = np.array([2.3, 1.7, 0.6])
TILT = np.array([0.03, -0.02])
PLAIN = CeilingSpec(texture=0.0, tile_spread=0.0, stains=0)


def world(surroundings: SurroundingsSpec, **render: object) -> World:
    return World(
        WorldSpec(lap=LapSpec(), ceiling=PLAIN, render=RenderSpec(**render), surroundings=surroundings)  # type: ignore[arg-type]
    )


def pixel(w: World, xyz_map: tuple[float, float, float], pose: np.ndarray, tilt: np.ndarray) -> np.ndarray:
    """Raw pixel of a point in map with its height above the camera, by the camera model alone."""
    base = se2.transform(se2.inverse(pose), np.array([xyz_map[:2]]))[0] - w.calibration.mount_xy_m
    ray = cv2.Rodrigues(np.array([*tilt, 0.0]))[0].T @ np.array([*base, xyz_map[2]])
    return w.calibration.camera.pixels((w.calibration.camera_from_base @ ray)[None])[0]


def edge_at(hidden: np.ndarray, inside: np.ndarray, outside: np.ndarray) -> np.ndarray:
    """Where the line from one pixel to the other crosses from hidden to clear."""
    at = inside + np.linspace(0.0, 1.0, 801)[:, None] * (outside - inside)
    values = cv2.remap(hidden, at.astype(np.float32)[None], None, cv2.INTER_LINEAR)[0]
    assert values[0] > 0.99
    assert values[-1] < 0.01
    return at[int(np.argmin(np.abs(values - 0.5)))]


@pytest.mark.parametrize("frame", ["map", "base"])
@pytest.mark.parametrize("tilt", [np.zeros(2), TILT])
def test_a_plate_hides_what_the_camera_model_says(frame: str, tilt: np.ndarray) -> None:
    centre = (2.4, 1.8) if frame == "map" else (0.2, 0.1)
    slab = Slab(centre, (0.6, 0.4), 0.35, 1.2, frame=frame)  # type: ignore[arg-type]
    w = world(SurroundingsSpec(slabs=(slab,)))
    hidden = w.renderer.occlusion(POSE, tilt)
    to_map = POSE if frame == "base" else np.zeros(3)
    own = np.array([*centre, 0.35])

    def point(x: float, y: float) -> np.ndarray:
        xy = se2.transform(to_map, se2.transform(own, np.array([[x, y]])))[0]
        return pixel(w, (float(xy[0]), float(xy[1]), 1.2), POSE, tilt)

    for x, y in ((0.3, 0.0), (-0.3, 0.05), (0.1, 0.2), (-0.1, -0.2)):
        found = edge_at(hidden, point(0.7 * x, 0.7 * y), point(1.3 * x, 1.3 * y))
        assert np.hypot(*(found - point(x, y))) < 0.5


def test_walls_hide_the_ceiling_beyond_them_and_nothing_of_the_room() -> None:
    w = world(SurroundingsSpec(walls=True))
    pose = np.array([2.5, 0.8, 0.3])
    hidden = w.renderer.occlusion(pose)
    high = w.calibration.ceiling_height_m
    for x in (2.0, 2.5, 3.0):
        found = edge_at(
            hidden, pixel(w, (x, -0.2, high), pose, np.zeros(2)), pixel(w, (x, 0.3, high), pose, np.zeros(2))
        )
        assert np.hypot(*(found - pixel(w, (x, 0.0, high), pose, np.zeros(2)))) < 0.6
    assert hidden[round(w.calibration.camera.cy_px), round(w.calibration.camera.cx_px)] == 0.0


def test_a_door_frame_is_dark_where_the_wall_is_not() -> None:
    spec = SurroundingsSpec(walls=True, doors_per_wall=1, door_top_m=1.55)
    w = world(spec, vignetting=0.0)
    pose = np.array([2.5, 0.8, 0.0])
    image = w.renderer.render(pose, np.random.default_rng(1))
    xs = np.linspace(1.6, 3.4, 40)

    def level(z: float) -> np.ndarray:
        at = np.array([pixel(w, (float(x), 0.0, z), pose, np.zeros(2)) for x in xs], np.float32)
        return cv2.remap(image, at[None], None, cv2.INTER_LINEAR)[0].astype(float)

    door, wall = level(1.52), level(1.60)
    assert (door < 0.6 * wall).sum() > 12, "the lintel, 0.9 m wide"
    assert (door > 0.9 * wall).sum() > 5, "wall beside it"


def test_without_surroundings_nothing_is_hidden() -> None:
    assert not world(SurroundingsSpec()).renderer.occlusion(POSE, TILT).any()


def test_lamp_groups_take_turns_and_add_up() -> None:
    w = world(SurroundingsSpec(), switch_groups=3, switch_period_s=2.0, read_noise=0.0, shot_noise=0.0)
    off = [np.flatnonzero(w.renderer.lamp_shares(2.0 * k + 0.1) == 0.0).tolist() for k in range(4)]
    assert sorted(off) == [[], [0], [1], [2]]
    whole = world(SurroundingsSpec(), read_noise=0.0, shot_noise=0.0)
    on_s = 2.0 * off.index([]) + 0.1
    a = w.renderer.render(POSE, np.random.default_rng(1), t_s=on_s)
    b = whole.renderer.render(POSE, np.random.default_rng(1))
    assert np.abs(a.astype(int) - b.astype(int)).max() <= 1
    darker = w.renderer.render(POSE, np.random.default_rng(1), t_s=on_s + 2.0)
    assert darker.mean() < 0.95 * a.mean()


@pytest.mark.parametrize("bad", [{"switch_groups": -1}, {"switch_period_s": 0.0}])
def test_impossible_switching_is_refused(bad: dict[str, float]) -> None:
    with pytest.raises(ConfigError, match="switch_"):
        RenderSpec(**bad)  # type: ignore[arg-type]


def test_a_bare_ceiling_keeps_its_lamps_and_loses_its_joints() -> None:
    tiled, bare = Ceiling(PLAIN, seed=2), Ceiling(CeilingSpec(**{**PLAIN.__dict__, "joints": False}), seed=2)
    xy, kind = bare.true_crossings()
    assert set(kind.tolist()) == {CrossingType.LAMP, CrossingType.VENT}
    all_xy, all_kind = tiled.true_crossings()
    np.testing.assert_allclose(xy, all_xy[all_kind >= CrossingType.LAMP])
    assert np.ptp(bare.albedo[:40, :200]) < 0.2 < np.ptp(tiled.albedo[:40, :200])


def test_a_wide_bright_joint_has_a_middle_and_two_edges_where_it_is_bright() -> None:
    spec = CeilingSpec(**{**PLAIN.__dict__, "groove_m": 0.024, "lip_m": 0.0, "groove_albedo": 0.95})
    c = Ceiling(spec, seed=2)
    lines = c.true_lines()
    first = c.layout.grooves[0][3]
    mine = (lines.axis == 0) & (np.abs(lines.segments[:, 0, 0] - first) < 0.013)
    found = {
        (round(float(x - first), 3), int(k)) for x, k in zip(lines.segments[mine, 0, 0], lines.kind[mine], strict=True)
    }
    assert found >= {(0.0, LineKind.GROOVE), (-0.012, LineKind.RISING), (0.012, LineKind.FALLING)}
    x0, y0 = c.layout.extent[:2]
    j = int((c.layout.grooves[1][3] + 0.3 - y0) / spec.texel_m)
    i = int((first - x0) / spec.texel_m)
    assert c.albedo[j, i] > 0.9 > 0.85 > c.albedo[j, i + 20]
