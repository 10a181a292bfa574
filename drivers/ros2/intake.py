"""What ROS 2 tells the daemon: a pose, a search, a saving; made into the bus's commands, with its guard and limits."""

from __future__ import annotations

import json
import logging
import math
import threading
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from ceilvo.config import Ros2
from ceilvo.drivers.bus.requests import Answer
from ceilvo.drivers.ports import Clock
from ceilvo.drivers.rate_limit import QuietLog
from ceilvo.drivers.ros2.cdr import TRIGGER, Cdr
from ceilvo.drivers.ros2.endpoints import Endpoint, Endpoints
from ceilvo.errors import BusError, one_line

log = logging.getLogger(__name__)

Ask = Callable[[str, bytes], Answer]
"""The bus's Requests: a command's name and its JSON."""

MOST_BYTES = 4096
"""Of a message; a pose has 400."""
_UNIT = 0.01
"""By which the length of a quaternion may be off 1; chosen: far more than rounding, far less than a mistake."""
_LEVEL = math.radians(10.0)
"""A pose that leans more is none of a robot on a floor; chosen."""


class Intake:
    """Thread-safe; nothing raises. What cannot be used is counted, said in one line, and changes nothing."""

    LOGGED_PER_S, LOG_BURST = 0.2, 20

    def __init__(
        self, config: Ros2, cdr: Cdr, endpoints: Endpoints, ask: Ask, clock: Clock = time.monotonic_ns
    ) -> None:
        self._config, self._cdr, self._endpoints, self._ask = config, cdr, endpoints, ask
        self._quiet = QuietLog(log, self.LOGGED_PER_S, self.LOG_BURST, clock)
        self._lock = threading.Lock()
        self._counts = {"taken": 0, "malformed": 0, "refused": 0}

    def counters(self) -> dict[str, int]:
        with self._lock:
            return dict(self._counts)

    def initial_pose(self, where: str, payload: bytes, right_type: bool = True) -> None:
        """/initialpose, as RViz and nav2 send it."""
        try:
            if not right_type:
                raise BusError(f"found another type, expected {self._endpoints.initial_pose.message}")
            request = self._pose_request(payload)
        except BusError as e:
            self._malformed(where, e)
            return
        self._command("cmd/initial_pose", json.dumps(request).encode())

    def call(self, service: Endpoint, where: str, payload: bytes, *, exact: bool = True) -> bytes | None:
        """The answer to a call, None where it is refused: std_srvs/Empty has no other way to say so."""
        try:
            if not exact:
                raise BusError("found a call to many services at once, expected this one's own key")
            if len(payload) > MOST_BYTES:
                raise BusError(f"found more than {MOST_BYTES} bytes, expected a request without fields")
            if payload:
                self._cdr.decode(payload, f"{service.message.replace('/srv/', '/msg/')}_Request")
        except BusError as e:
            self._malformed(where, e)
            return None
        response = f"{service.message.replace('/srv/', '/msg/')}_Response"
        answer = self._command("cmd/relocalise" if service == self._endpoints.relocalise else "cmd/save_map", b"")
        if service.message == TRIGGER:
            said = json.loads(answer.payload)
            text = json.dumps(said["result"]) if answer.ok else str(said["error"])
            return self._cdr.encode(self._cdr.make(response, success=answer.ok, message=text))
        if not answer.ok:
            return None
        return self._cdr.encode(self._cdr.make(response, structure_needs_at_least_one_member=0))

    def _command(self, name: str, payload: bytes) -> Answer:
        answer = self._ask(name, payload)  # which says why it refuses
        self._count("taken" if answer.ok else "refused")
        return answer

    def _pose_request(self, payload: bytes) -> dict[str, float]:
        """The JSON command for a PoseWithCovarianceStamped.

        Raises:
            BusError: it is none, or none that a robot can have.
        """
        if len(payload) > MOST_BYTES:
            raise BusError(f"found more than {MOST_BYTES} bytes, expected a pose")
        message = self._cdr.decode(payload, self._endpoints.initial_pose.message)
        frame = message.header.frame_id
        if frame.lstrip("/") != self._config.map_frame:
            raise BusError(f"header.frame_id: found {one_line(repr(frame), 60)}, expected {self._config.map_frame!r}")
        position, turn, cov = message.pose.pose.position, message.pose.pose.orientation, message.pose.covariance
        numbers = np.array([position.x, position.y, turn.x, turn.y, turn.z, turn.w])
        if not np.isfinite(numbers).all():
            raise BusError("pose: found a number that is not finite, expected x, y and a unit quaternion")
        return {"x_m": float(position.x), "y_m": float(position.y), "theta_rad": _yaw(turn)} | _sigmas(np.asarray(cov))

    def _malformed(self, where: str, error: BusError) -> None:
        self._count("malformed")
        self._quiet.warning(f"{where}: {error}; nothing was done")

    def _count(self, name: str) -> None:
        with self._lock:
            self._counts[name] += 1


def _yaw(q: Any) -> float:
    """
    Raises:
        BusError: no unit quaternion, or of a robot that lies on its side.
    """
    length = math.sqrt(q.x**2 + q.y**2 + q.z**2 + q.w**2)
    if abs(length - 1.0) > _UNIT:
        raise BusError(f"orientation: found a quaternion of length {length:.3g}, expected 1")
    up = 1.0 - 2.0 * (q.x**2 + q.y**2) / length**2
    if up < math.cos(_LEVEL):
        raise BusError(
            f"orientation: found a lean of {math.degrees(math.acos(max(up, -1.0))):.0f} deg, expected a turn about z"
        )
    return math.atan2(2.0 * (q.w * q.z + q.x * q.y), 1.0 - 2.0 * (q.y**2 + q.z**2))


def _sigmas(cov: Any) -> dict[str, float]:
    """Standard deviations from a 6x6 covariance; without those that are 0, as programs send that know none.

    Raises:
        BusError: one is not finite or negative.
    """
    xx, yy, turn = float(cov[0]), float(cov[7]), float(cov[35])
    if not all(math.isfinite(v) and v >= 0.0 for v in (xx, yy, turn)):
        raise BusError(
            "covariance: found a variance that is negative or not finite, expected x, y and yaw's in m^2, rad^2"
        )
    out = {}
    if max(xx, yy) > 0.0:
        out["sigma_m"] = min(max(math.sqrt(max(xx, yy)), 1e-4), 100.0)
    if turn > 0.0:
        out["sigma_theta_rad"] = min(max(math.sqrt(turn), 1e-4), math.pi)
    return out
