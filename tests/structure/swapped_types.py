"""What must not type-check: `make check` runs mypy over this file, and an ignore that is not needed is an error."""

from __future__ import annotations

from ceilvo.daemon.pipeline import Pipeline
from ceilvo.daemon.slam.pose_filter import PoseFilter
from ceilvo.types import Array, Displacement, Motion, Pose, Twist, WheelMotion


def a_twist_is_no_pose(pipeline: Pipeline, twist: Twist, cov: Array) -> None:
    pipeline.set_pose(twist, cov, "a velocity")  # type: ignore[arg-type]


def a_displacement_is_no_pose(pipeline: Pipeline, moved: Displacement, cov: Array) -> None:
    pipeline.set_pose(moved, cov, "a motion")  # type: ignore[arg-type]


def a_pose_is_no_displacement(pose: Pose, cov: Array) -> None:
    WheelMotion(pose, cov)  # type: ignore[arg-type]
    Motion(pose, cov, 0, 0.0)  # type: ignore[arg-type]


def a_twist_is_no_displacement(twist: Twist, cov: Array) -> None:
    Motion(twist, cov, 0, 0.0)  # type: ignore[arg-type]


def a_pose_is_no_motion(poses: PoseFilter, pose: Pose) -> None:
    poses.predict(pose)  # type: ignore[arg-type]


def wheels_are_no_motion(poses: PoseFilter, wheels: WheelMotion) -> None:
    poses.predict(wheels)  # type: ignore[arg-type]
