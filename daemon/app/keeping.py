"""When map and pose are written: now and then, the pose where the robot has come to stand, and all of it at the end."""

from __future__ import annotations

import numpy as np

from ceilvo import se2
from ceilvo.daemon.app.estimator import Estimator
from ceilvo.daemon.integrity.states import UNUSABLE
from ceilvo.daemon.map.store import Store
from ceilvo.types import Array, Estimate

STOOD_NS = 10**9
"""A robot that stood for so long has stopped; chosen: nobody who parks one is quicker at its switch."""
_STILL_M, _STILL_RAD = 0.01, 0.01
"""One that moved less in that time stands; chosen: half of what telemetry.py calls moving."""
_AWAY_M, _AWAY_RAD = 0.02, 0.02
"""A stored pose that is further off is stored anew; chosen: less than half of what a restart adds to its sigmas."""


class Keeper:
    """keep() is the main thread's; save() may be called by any."""

    def __init__(self, estimator: Estimator, store: Store, period_s: float) -> None:
        self._estimator, self._store = estimator, store
        self._period_ns = round(1e9 * period_s)
        self._due_ns = 0
        self._began: Estimate | None = None
        self._kept: Estimate | None = None

    def keep(self, now_ns: int) -> None:
        """Write what is due; to be called often.

        Between two savings a killed robot's stored pose is as far off as it drove meanwhile. So that one which is
        switched off where it stands comes back there, its pose alone is written, a few hundred bytes, once it has
        stopped, and again where what is known of it changes.
        """
        if now_ns >= self._due_ns:
            self._due_ns = now_ns + self._period_ns
            self.save()
        elif (last := self._estimator.last) is not None and self._stands(last) and self._is_news(last):
            self._began = last
            if self._store.save_pose(last, self._estimator.elsewhere()):
                self._kept = last

    def save(self) -> bool:
        """Write map and pose; False when they were not, with the reason in the log."""
        last = self._estimator.last
        if last is None or not self._store.save(*self._estimator.map(), last, self._estimator.elsewhere()):
            return False
        self._kept = last
        return True

    def _stands(self, last: Estimate) -> bool:
        """By odometry, which is of eye and wheels and never jumps."""
        began = self._began
        if began is None or _apart(began.odom, last.odom, _STILL_M, _STILL_RAD):
            self._began = last
            return False
        return last.stamp_ns - began.stamp_ns >= STOOD_NS

    def _is_news(self, last: Estimate) -> bool:
        kept = self._kept
        if kept is None or _apart(kept.pose, last.pose, _AWAY_M, _AWAY_RAD):
            return True
        return (kept.state in UNUSABLE) != (last.state in UNUSABLE)


def _apart(a: Array, b: Array, most_m: float, most_rad: float) -> bool:
    """Whether two poses (3,) differ by more."""
    return float(np.hypot(*(b - a)[:2])) > most_m or abs(se2.wrap(float(b[2] - a[2]))) > most_rad
