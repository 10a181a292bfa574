"""What a robot that maps apart says of itself: where it may be, and what to drive by. Against the truth of drives."""

import json

import numpy as np
import pytest

from ceilvo.bench.place.case import drive_in
from ceilvo.bench.place.ceiling.worlds import WorldSpec, make_world
from ceilvo.daemon.relocalisation.relocaliser_state import MAPPED_APART
from ceilvo.daemon.relocalisation.submap import turned_cov
from ceilvo.drivers.bus.messages import encode_pose
from ceilvo.se2 import between, compose, inverse, lever, wrap
from ceilvo.types import State

CHI2 = 16.27
"""Of three degrees of freedom, exceeded once in 1000."""
PROMISED_M, PROMISED_RAD = 0.3, np.radians(5.0)
"""Bound of a pose that is called usable, docs/states.md."""
COVARIANCE = np.array([[0.09, 0.02, 0.03], [0.02, 0.04, -0.01], [0.03, -0.01, 0.25]])


@pytest.mark.parametrize("heading_sigma_rad", [0.02, 0.5, 1.2])
def test_a_turned_way_has_the_moments_that_drawing_gives(heading_sigma_rad: float) -> None:
    scale = np.diag([1.0, 1.0, heading_sigma_rad / np.sqrt(COVARIANCE[2, 2])])
    cov, way = scale @ COVARIANCE @ scale, np.array([3.0, -1.5])
    drawn = np.random.default_rng(1).multivariate_normal(np.zeros(3), cov, 400_000)
    c, s = np.cos(drawn[:, 2]) - 1.0, np.sin(drawn[:, 2])
    off = drawn + np.column_stack([c * way[0] - s * way[1], s * way[0] + c * way[1], 0.0 * c])
    told, root = turned_cov(cov, way), np.sqrt(np.mean(off**2, axis=0))
    assert np.allclose(off.T @ off / len(off) / np.outer(root, root), told / np.outer(root, root), atol=0.01)
    assert np.linalg.eigvalsh(told)[0] > 0.0


def test_a_small_turn_is_the_lever_of_first_order_and_no_way_changes_nothing() -> None:
    small = COVARIANCE * np.outer([1.0, 1.0, 1e-3], [1.0, 1.0, 1e-3])
    f = lever(np.zeros(3), np.array([2.0, 1.0, 0.0]))
    assert np.allclose(turned_cov(small, np.array([2.0, 1.0])), f @ small @ f.T, atol=1e-9)
    assert np.array_equal(turned_cov(COVARIANCE, np.zeros(2)), COVARIANCE)
    assert not np.any(turned_cov(np.zeros((3, 3)), np.array([9.0, 9.0])))


@pytest.mark.parametrize(("seed", "dark_s"), [(7, 2.0), (13, 1.0)])
def test_after_a_gap_on_new_ground_the_pose_covers_the_gap_and_the_reason_says_what_to_drive_by(
    seed: int, dark_s: float
) -> None:
    """20 s of mapping a hall of 20 m, darkness without wheels, 20 s more: one tile, or a quarter turn, or 2 m off.

    The covariance said 5 mm to 6 cm, up to 1e5 in NEES.
    """
    print(f"seed {seed}")
    drive = drive_in(
        make_world(WorldSpec("20", 0.6, "sparse", seed)), np.random.default_rng(seed), False, 10.0, True, 0.8
    )
    drive.at_truth()
    drive.go(3)
    estimate = drive.tick()
    assert estimate is not None
    map_from_truth = compose(np.asarray(estimate.pose), inverse(drive.pose))
    drive.go(17)
    assert drive.estimator.place_search() is None
    drive.conditions.dark = True
    drive.go(dark_s)
    drive.conditions.dark = False
    worst, worst_m, odom, reasons = 0.0, 0.0, [], set()
    for _ in range(200):
        estimate = drive.tick()
        assert estimate is not None
        off = np.asarray(estimate.pose) - compose(map_from_truth, drive.pose)
        off[2] = wrap(float(off[2]))
        worst, worst_m = max(worst, float(off @ np.linalg.solve(estimate.cov, off))), max(worst_m, np.hypot(*off[:2]))
        usable = estimate.state in (State.TRACKING, State.DEGRADED)
        assert not usable or (np.hypot(*off[:2]) < PROMISED_M and abs(off[2]) < PROMISED_RAD)
        message = json.loads(encode_pose("r", estimate, 0, 0, "", 0))
        reasons.add(message["reason"])
        if message["reason"].endswith(MAPPED_APART):
            assert message["state"] == "RELOCALISING"
            odom.append((np.asarray(estimate.odom), drive.pose))
    print(f"NEES {worst:.1f}, {worst_m:.2f} m off")
    search = drive.estimator.place_search()
    assert search is not None
    assert 0.0 <= search["false_alarm_probability"] <= 1.0
    assert worst < CHI2
    assert worst_m > PROMISED_M
    assert len(odom) > 100, reasons
    went = [between(*(row[k] for row in (odom[0], odom[-1]))) for k in (0, 1)]
    assert np.hypot(*(went[0] - went[1])[:2]) < 0.1
