"""Line fit on synthetic edge points whose lines, direction and tilt are known."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ceilvo.config import Features
from ceilvo.daemon.vision.edges import EdgeDetector, Edges
from ceilvo.daemon.vision.line_detection import LastFit, detect, dominant_direction, find_lines
from ceilvo.daemon.vision.tilt_prior import TiltPrior, TiltTracker
from ceilvo.sim.rig import simulated_calibration, simulated_camera
from ceilvo.types import LineKind, Lines

FOCAL_PX = 410.0
Segment = tuple[int, float, int, float, float]
"""axis, offset px, polarity +-1, start and end along the line px."""


def edges(
    segments: list[Segment], psi: float, seed: int, noise_px: float = 0.2, tilt: tuple[float, float] = (0, 0)
) -> Edges:
    rng = np.random.default_rng(seed)
    uv, phi = [], []
    for axis, offset, polarity, start, end in segments:
        angle = psi + axis * np.pi / 2
        n, t = np.array([np.cos(angle), np.sin(angle)]), np.array([-np.sin(angle), np.cos(angle)])
        s = np.arange(start, end, 1.0)
        p = offset * n + s[:, None] * t
        rays = np.column_stack([p / FOCAL_PX, np.ones(len(p))])
        w = np.array([tilt[0], tilt[1], 0.0])
        seen = rays - np.cross(w, rays)  # a tilted robot sees the world turned back
        p = FOCAL_PX * seen[:, :2] / seen[:, 2:]
        uv.append(p + rng.normal(0, noise_px, len(s))[:, None] * n)
        phi.append(angle + (0 if polarity > 0 else np.pi) + rng.normal(0, 0.02, len(s)))
    phi_deg = np.degrees(np.concatenate(phi)) % 360.0
    return Edges(np.concatenate(uv).astype(np.float32), phi_deg.astype(np.float32))


GRID: list[Segment] = [
    (axis, 110.0 * k + side, int(np.sign(side)), -300.0, 300.0)
    for axis in (0, 1)
    for k in (-2, -1, 0, 1, 2)
    for side in (-1.5, 1.5)
]


def world_offsets(lines: Lines, axis_angle: float) -> np.ndarray:
    """Offsets of the lines whose normal is along +-axis_angle, measured along it, sorted."""
    normal = lines.psi_rad + lines.axis * np.pi / 2
    along = np.cos(normal - axis_angle)
    return np.sort((lines.offset_px * np.sign(along))[np.abs(along) > 0.9])


@pytest.mark.parametrize(("width", "height"), [(160, 120), (161, 121), (160, 121)])
def test_edges_are_found_in_pictures_of_even_and_odd_sizes(width: int, height: int) -> None:
    detect = EdgeDetector(simulated_calibration(simulated_camera(width_px=width, height_px=height)), Features())
    gray = np.full((height, width), 60, np.uint8)
    gray[:, width // 2 :] = 200
    assert len(detect(gray).uv_px) > 0.8 * height


@given(st.floats(-3.2, 3.2))
def test_direction_is_found_at_any_angle(psi: float) -> None:
    found = dominant_direction(edges(GRID, psi, 1).phi_deg)
    assert found is not None
    assert abs((found - psi + np.pi / 4) % (np.pi / 2) - np.pi / 4) < np.radians(0.3)


@given(st.floats(-3.1, 3.1), st.integers(0, 100))
def test_grid_of_grooves_is_measured_to_hundredths_of_a_pixel(psi: float, seed: int) -> None:
    lines = find_lines(edges(GRID, psi, seed), Features(), FOCAL_PX)
    assert lines is not None
    assert len(lines.axis) == 10 and (lines.kind == LineKind.GROOVE).all()
    assert abs((lines.psi_rad - psi + np.pi / 4) % (np.pi / 2) - np.pi / 4) < np.radians(0.02)
    for axis in (0, 1):
        truth = 110.0 * np.arange(-2, 3)
        assert np.abs(world_offsets(lines, psi + axis * np.pi / 2) - truth).max() < 0.15


@pytest.mark.parametrize("scale", [0.25, 0.5, 1.0, 1.4, 2.0])
def test_the_sides_of_a_bar_are_one_line_to_cameras_of_any_size(scale: float) -> None:
    """24 mm on a ceiling 2.2 m up: 4.5 px of the usual camera, 9 px of one with twice as many."""
    side = max(2.25 * scale, 1.0)
    bars: list[Segment] = [
        (axis, 110.0 * scale * k + polarity * side, polarity, -300.0 * scale, 300.0 * scale)
        for axis in (0, 1)
        for k in range(-2, 3)
        for polarity in (-1, 1)
    ]
    lines = find_lines(edges(bars, 0.3, 5), Features(), scale * FOCAL_PX)
    assert lines is not None
    assert len(lines.axis) == 10 and (lines.kind == LineKind.GROOVE).all()


def test_tilt_is_estimated_and_taken_out() -> None:
    tilt = np.radians([1.2, -0.8])
    lines = find_lines(edges(GRID, 0.3, 5, tilt=(tilt[0], tilt[1])), Features(), FOCAL_PX)
    assert lines is not None
    print("seed 5: tilt found", np.degrees(lines.tilt_rad), "deg, sigma", np.degrees(lines.tilt_sigma_rad))
    assert np.abs(lines.tilt_rad - tilt).max() < np.radians(0.06)
    assert np.abs(world_offsets(lines, 0.3) - 110.0 * np.arange(-2, 3)).max() < 0.3


def test_without_tilt_estimation_the_tilt_stays_zero() -> None:
    lines = find_lines(edges(GRID, 0.3, 5, tilt=(0.01, 0.0)), Features(estimate_tilt=False), FOCAL_PX)
    assert lines is not None
    assert np.abs(lines.tilt_rad).max() < 1e-6


@pytest.mark.parametrize(("polarity", "kind"), [(1, LineKind.RISING), (-1, LineKind.FALLING)])
def test_single_edges_keep_their_polarity(polarity: int, kind: LineKind) -> None:
    lamp: list[Segment] = [(0, 40.0, polarity, -100.0, 100.0), (1, -60.0, 1, -100.0, 100.0)]
    lines = find_lines(edges(lamp, 0.2, 2), Features(), FOCAL_PX)
    assert lines is not None
    assert lines.kind[lines.axis == 0].tolist() == [kind]


def test_kinds_turn_with_the_axes() -> None:
    """The same scene seen a quarter turn further: axis names change, and so does the sign along them."""
    scene: list[Segment] = [(0, 40.0, 1, -100.0, 100.0), (1, -60.0, 1, -100.0, 100.0)]
    level = Features(estimate_tilt=False)
    here, there = (find_lines(edges(scene, psi, 2), level, FOCAL_PX) for psi in (0.1, 0.1 + np.pi / 2))
    assert here is not None and there is not None
    assert here.kind[here.axis == 0].tolist() == [LineKind.RISING]
    assert here.kind[here.axis == 1].tolist() == [LineKind.RISING]
    # the scene's axis 0 is now along 0.1 + 90 deg = axis 1; its axis 1 is along 0.1 + 180 deg = axis 0 reversed
    assert there.kind[there.axis == 1].tolist() == [LineKind.RISING]
    assert there.kind[there.axis == 0].tolist() == [LineKind.FALLING]
    assert there.offset_px[there.axis == 0][0] == pytest.approx(60.0, abs=0.2)


def test_no_points_and_noise_alone_give_no_lines() -> None:
    rng = np.random.default_rng(1)
    none = Edges(np.zeros((0, 2), np.float32), np.zeros(0, np.float32))
    noise = Edges(rng.uniform(-300, 300, (300, 2)).astype(np.float32), rng.uniform(0, 360, 300).astype(np.float32))
    assert find_lines(none, Features(), FOCAL_PX) is None
    assert find_lines(noise, Features(), FOCAL_PX) is None


def test_a_fitting_prior_quietens_the_tilt() -> None:
    """Over many noisy views of a level robot, the prior must shrink the spread of the tilt."""
    prior = TiltPrior(np.zeros(2), np.full(2, 1e-5))
    free, led = [], []
    for seed in range(30):
        seen = edges(GRID, 0.3, seed)
        for known, out in ((None, free), (prior, led)):
            lines = find_lines(seen, Features(), FOCAL_PX, known)
            assert lines is not None
            out.append(lines.tilt_rad)
    assert np.std(led) < 0.5 * np.std(free)


def test_a_contradicted_prior_gives_way() -> None:
    tilt = np.radians([1.2, -0.8])
    seen = edges(GRID, 0.3, 5, tilt=(tilt[0], tilt[1]))
    without = find_lines(seen, Features(), FOCAL_PX)
    against = find_lines(seen, Features(), FOCAL_PX, TiltPrior(np.zeros(2), np.full(2, 1e-5)))
    assert without is not None and against is not None
    assert np.array_equal(without.tilt_rad, against.tilt_rad)


def test_few_lines_do_not_imitate_a_tilt() -> None:
    """One lamp cannot tell a tilt from noise: none is read from it, and it does not teach the prior."""
    lamp: list[Segment] = [(a, o, p, -20.0, 20.0) for a in (0, 1) for o, p in ((-20.0, 1), (20.0, -1))]
    tracker = TiltTracker()
    for seed in range(60):
        lines = find_lines(edges(lamp, 0.2, seed, noise_px=0.5), Features(min_line_deg=2.1), FOCAL_PX)
        assert lines is not None
        assert np.abs(lines.tilt_rad).max() < 1e-9
        tracker.update(lines)
    assert tracker.prior() is None


@pytest.mark.parametrize("lean_deg", [(0.0, 2.6), (2.6, 0.0), (3.0, 3.0)])
def test_a_lean_that_no_line_tells_is_not_kept(lean_deg: tuple[float, float]) -> None:
    """Slats tell the tilt about one axis only: what one frame took it for is gone with the next."""
    slats = [s for s in GRID if s[0] == 0]
    last = LastFit(np.radians(lean_deg), 0.2)
    assert last.leans
    for seed in range(5):
        found = detect(edges(slats, 0.1, seed), Features(), FOCAL_PX, None, last)
        assert found is not None
        assert np.abs(found[0].tilt_rad).max() < 1e-3, f"seed {seed}"


@pytest.mark.parametrize("several", [False, True])
def test_points_that_leave_every_line_are_no_lines(several: bool) -> None:
    """A few short segments in clutter, looked for at another tilt: the last round may be left with none."""
    left_with_none = 0
    for seed in range(200):
        rng = np.random.default_rng(seed)
        length = [sorted(rng.uniform(-300, 300, 2)) for _ in range(rng.integers(1, 5))]
        short = [
            (int(rng.integers(2)), float(rng.uniform(-250, 250)), int(rng.choice([-1, 1])), float(a), float(b) + 1.0)
            for a, b in length
        ]
        seen = edges(short, rng.uniform(-1, 1), seed, float(rng.choice([0.2, 1, 3, 8])), tuple(rng.normal(0, 0.05, 2)))
        count = int(rng.integers(0, 300))
        clutter = rng.uniform(-300, 300, (count, 2)), rng.uniform(0, 360, count)
        both = Edges(
            np.vstack([seen.uv_px, clutter[0]]).astype(np.float32),
            np.concatenate([seen.phi_deg, clutter[1]]).astype(np.float32),
        )
        prior = TiltPrior(np.zeros(2), np.full(2, rng.choice([0.001, 0.02])))
        found = detect(both, Features(), FOCAL_PX, prior, LastFit(rng.normal(0, 0.1, 2), 0.3, several))
        left_with_none += found is None
        assert found is None or np.isfinite(found[0].offset_px).all(), f"seed {seed}"
    assert 0 < left_with_none < 200
