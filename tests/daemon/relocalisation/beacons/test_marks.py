"""Tags drawn into pictures by the camera's true projection, found again; and marks that hang elsewhere."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from ceilvo import se2
from ceilvo.calibration import Calibration
from ceilvo.daemon.relocalisation.beacons.mark_finder import MarkFinder
from ceilvo.daemon.relocalisation.beacons.mark_poses import MarkPose, corners, derivatives, mark_pose
from ceilvo.daemon.relocalisation.beacons.trust import STRIKES, Trust
from ceilvo.senses.beacons import Mark
from ceilvo.sim.rig import simulated_calibration
from ceilvo.types import Array

SIZE_M = 0.2
MARK = Mark(7, SIZE_M, 4.0, -2.0, 0.7, 0.005, 0.005)


def corners_px(c: Calibration, pose: Array, mark: Mark, below_m: float = 0.0) -> Array:
    """(4, 2) raw pixels of the corners of a mark that hangs so far below the ceiling, by the true projection."""
    base_from_mark = se2.compose(se2.inverse(pose), np.array([mark.x_m, mark.y_m, mark.theta_rad]))
    at = se2.transform(base_from_mark, corners(mark.size_m))  # type: ignore[arg-type]
    # what hangs lower is seen where a ray through it meets the ceiling
    at = c.mount_xy_m + (at - c.mount_xy_m) * c.ceiling_height_m / (c.ceiling_height_m - below_m)
    s = np.column_stack([at, np.ones(4)]) @ c.level_from_ceiling.T
    return c.level_view.to_raw(s[:, :2] / s[:, 2:])


def picture(c: Calibration, at_px: Array, number: int, rng: np.random.Generator) -> np.ndarray:
    """A tag on a white card in a grey ceiling; its first corner at the first pixel."""
    tag = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11).generateImageMarker(number, 160)
    card = cv2.copyMakeBorder(tag, 40, 40, 40, 40, cv2.BORDER_CONSTANT, value=255)
    flat = 40.0 - 0.5 + np.array([[0, 0], [160, 0], [160, 160], [0, 160]], np.float32)
    turn = cv2.getPerspectiveTransform(flat.astype(np.float32), at_px.astype(np.float32))
    size = (c.camera.width_px, c.camera.height_px)
    four = (4 * size[0], 4 * size[1])
    up = np.array([[4.0, 0.0, 1.5], [0.0, 4.0, 1.5], [0.0, 0.0, 1.0]]) @ turn
    drawn, mask = (cv2.warpPerspective(image, up, four) for image in (card, np.full_like(card, 255)))
    whole = cv2.resize(np.where(mask > 127, drawn, 120).astype(np.float32), size, interpolation=cv2.INTER_AREA)
    return np.clip(whole + 2.0 * rng.standard_normal(whole.shape), 0, 255).astype(np.uint8)


@pytest.mark.parametrize("pose", [(4.3, -1.8, 0.2), (3.5, -2.3, 2.9), (4.6, -2.5, -1.6)])
def test_a_tag_in_a_picture_says_where_the_robot_is(pose: tuple[float, float, float]) -> None:
    c, true = simulated_calibration(tile_m=0.6), np.array(pose)
    at_px = corners_px(c, true, MARK)
    a, b = at_px[1] - at_px[0], at_px[2] - at_px[1]
    assert a[0] * b[1] - a[1] * b[0] > 0, "clockwise in the picture, as it is printed"
    found = MarkFinder("tag36h11", frozenset({7}))(picture(c, at_px, 7, np.random.default_rng(1)))
    assert [m.number for m in found] == [7]
    said = mark_pose(c, MARK, found[0].corners_px)
    assert said is not None
    off = said.pose - true
    off[2] = se2.wrap(float(off[2]))
    print("off by", off, "sigma", np.sqrt(np.diag(said.cov)))
    assert np.hypot(off[0], off[1]) < 0.008 and abs(off[2]) < np.radians(0.5)
    assert float(off @ np.linalg.solve(said.cov, off)) < 16.3


def test_tags_that_nobody_knows_are_not_told() -> None:
    c = simulated_calibration(tile_m=0.6)
    gray = picture(c, corners_px(c, np.array([4.3, -1.8, 0.2]), MARK), 7, np.random.default_rng(1))
    assert MarkFinder("tag36h11", frozenset({8}))(gray) == ()
    assert MarkFinder("tag25h9", frozenset({7}))(gray) == ()
    assert MarkFinder("tag36h11", frozenset({7}))(np.full_like(gray, 128)) == ()


def test_one_that_hangs_lower_is_put_where_it_is_by_its_size() -> None:
    c, true = simulated_calibration(tile_m=0.6), np.array([4.4, -1.7, 0.4])
    said = mark_pose(c, MARK, corners_px(c, true, MARK, below_m=0.3))
    assert said is not None
    np.testing.assert_allclose(said.pose, true, atol=1e-6)


def test_another_size_is_another_mark() -> None:
    c, true = simulated_calibration(tile_m=0.6), np.array([4.4, -1.7, 0.4])
    large = Mark(7, 2.0 * SIZE_M, MARK.x_m, MARK.y_m, MARK.theta_rad)
    assert mark_pose(c, MARK, corners_px(c, true, large)) is None
    askew = corners_px(c, true, MARK) + np.array([[0.0, 0.0], [9.0, 0.0], [0.0, 0.0], [0.0, 9.0]])
    assert mark_pose(c, MARK, askew) is None


def test_the_covariance_is_that_of_noisy_corners() -> None:
    c, true, rng = simulated_calibration(tile_m=0.6), np.array([4.5, -1.6, 0.4]), np.random.default_rng(5)
    exact, off = corners_px(c, true, MARK), []
    for _ in range(1000):
        said = mark_pose(c, MARK, exact + 0.3 * rng.standard_normal((4, 2)))
        assert said is not None
        off.append(said.pose - true)
    ratio = ratios(np.cov(np.array(off).T), said.by_picture @ said.picture_cov @ said.by_picture.T)
    print("variances over what is said", ratio)
    assert np.all((ratio > 0.3) & (ratio < 1.5))
    tilted = said.picture_cov + said.tilt_var * np.diag([1.0, 1.0, 0.0])
    assert np.all(np.var(np.array(off)[:, :2], axis=0) < np.diag(said.by_picture @ tilted @ said.by_picture.T)[:2])


def ratios(found: Array, said: Array) -> Array:
    """Variances (3,) that were found over those that were said, in the directions in which they differ the most."""
    half = np.linalg.inv(np.linalg.cholesky(said))
    return np.linalg.eigvalsh(half @ found @ half.T)


def test_what_a_mark_says_changes_with_its_place_and_the_picture_as_is_said() -> None:
    in_map, in_base = np.array([4.0, -2.0, 0.7]), np.array([-0.4, 0.9, -2.0])
    pose = se2.compose(in_map, se2.inverse(in_base))
    for said, of in zip(
        derivatives(pose, in_map),
        (
            lambda d: se2.compose(in_map + d, se2.inverse(in_base)),
            lambda d: se2.compose(in_map, se2.inverse(in_base + d)),
        ),
        strict=True,
    ):
        found = np.column_stack([(of(d) - of(-d)) / 2e-6 for d in 1e-6 * np.eye(3)])
        np.testing.assert_allclose(said, found, atol=1e-6)


def shifted(x_m: float, turn_deg: float = 0.0) -> MarkPose:
    tight = np.diag([1e-4, 1e-4, 1e-4])
    pose = np.array([x_m, 0.0, np.radians(turn_deg)])
    return MarkPose(7, pose, np.eye(3), tight, -np.eye(3), tight, 0.0)


def test_a_mark_that_was_moved_is_named_and_ignored() -> None:
    trust, cov = Trust(), np.diag([1e-6, 1e-6, 1e-6])
    for k in range(STRIKES):
        assert trust.believed(shifted(0.4)), k
        assert not trust.hold(shifted(0.4), np.zeros(3), cov)
    assert not trust.believed(shifted(0.4))
    news = trust.take_news()
    assert len(news) == 1 and "mark 7" in news[0] and "0.40 m" in news[0] and "ignored" in news[0]
    assert trust.take_news() == []


@pytest.mark.parametrize("mark", [shifted(0.03), shifted(0.0, 1.5), shifted(0.0)])
def test_one_that_is_off_by_a_tape_measure_is_not(mark: MarkPose) -> None:
    trust, cov = Trust(), np.diag([1e-6, 1e-6, 1e-6])
    assert all(trust.hold(mark, np.zeros(3), cov) for _ in range(50))
    assert trust.believed(mark) and trust.take_news() == []


def test_now_and_then_a_reflection_condemns_nobody() -> None:
    trust, cov = Trust(), np.diag([1e-6, 1e-6, 1e-6])
    for k in range(100):
        trust.hold(shifted(0.4 if k % 3 == 0 else 0.0), np.zeros(3), cov)
    assert trust.believed(shifted(0.0))
