"""The daemon's side of what applications ask for on the bus."""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np

from ceilvo.calibration import Calibration
from ceilvo.config import Config
from ceilvo.daemon.app.command_log import CommandLog
from ceilvo.daemon.app.estimator import Estimator
from ceilvo.daemon.map.kept.store import Store
from ceilvo.drivers.bus import commands, messages
from ceilvo.drivers.bus.requests import Handlers, Result
from ceilvo.errors import CeilvoError
from ceilvo.types import Estimate, Landmarks, Pose

Ahead = Callable[[Estimate, float], tuple[Estimate, float]]


def as_it_is(estimate: Estimate, ahead_ms: float) -> tuple[Estimate, float]:
    """Where nothing is predicted."""
    return estimate, 0.0


def handlers(
    config: Config,
    calibration: Calibration,
    estimator: Estimator,
    store: Store,
    save: Callable[[], bool],
    ahead: Ahead = as_it_is,
) -> Handlers:
    """Handlers that are safe to call from any thread.

    Args:
        save: writes map and pose.
        ahead: moves an estimate on to so many milliseconds from now.
    """

    def here() -> Landmarks:
        """The map of the floor that the robot is on."""
        return estimator.map_on(estimator.floor)[0]

    def initial_pose(c: commands.InitialPose) -> Result:
        only = store.map_of("")[0]
        if c.map_id and not estimator.floors() and c.map_id != only:
            raise CeilvoError(f"map_id: found {c.map_id!r}, expected {only!r}, the only map that is loaded")
        sigma = np.array([c.sigma_m, c.sigma_m, c.sigma_theta_rad])
        estimator.set_pose(Pose(np.array([c.x_m, c.y_m, c.theta_rad])), sigma, "initial pose given", c.map_id)
        return {"did": "pose taken as a hypothesis; TRACKING once landmarks confirm it"}

    def relocalise(c: commands.Relocalise) -> Result:
        if not len(estimator.map()[0]):
            raise CeilvoError("no map to find the pose in: drive first, or restore map.db and restart")
        sigma = estimator.relocalise()
        reach = f"{sigma[0]:.1f} m and {np.degrees(sigma[2]):.0f} deg (1 sigma)"
        return {"did": f"searching within {reach} of the last pose"}

    def save_map(c: commands.SaveMap) -> Result:
        if store.folder is None:
            raise CeilvoError("no state directory: set service.state_dir or run under systemd")
        if not save():
            raise CeilvoError(f"nothing saved: {store.error or 'no landmarks yet'}")
        return {"did": "saved", "folder": str(store.folder), "landmarks": len(here()), "map_id": estimator.floor}

    def reset(c: commands.Reset) -> Result:
        floor = estimator.floor
        estimator.reset(keep_map=c.keep_map)
        if c.keep_map:
            map_now = f"{len(estimator.map()[0])} landmarks kept"
        else:
            map_now = "map forgotten" + ("; the last one that was saved stays as map.db.1" * store.begin_anew(floor))
        return {"did": f"started again at the configured initial pose, {map_now}"}

    def pose(asked: commands.PoseAt) -> bytes:
        last = estimator.last
        if last is None:
            raise CeilvoError("no pose yet: the camera has given no picture")
        then, ahead_ms = (last, None) if asked.predict_ms is None else ahead(last, asked.predict_ms)
        now_ns = time.monotonic_ns()
        unix_ns = time.time_ns() - (now_ns - last.stamp_ns)
        kept = store.map_of(last.floor)
        return messages.encode_pose(config.robot.name, then, unix_ns, now_ns, *kept, predicted_ms=ahead_ms)

    return Handlers(
        map=here,
        calibration=lambda: calibration,
        config=lambda: config,
        initial_pose=initial_pose,
        relocalise=relocalise,
        save_map=save_map,
        reset=reset,
        told=CommandLog(store.folder),
        pose=pose,
    )
