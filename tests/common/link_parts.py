"""What a BaseLink under test is made of: a clock that stands, an estimate, a base that can be waited for."""

from __future__ import annotations

import threading
from collections.abc import Callable

import numpy as np
from patience import PATIENCE_S

from ceilvo import config
from ceilvo.drivers.base.mock_base import BaseModel, MockBase
from ceilvo.drivers.telegrams import BaseStatus, PoseTelegram
from ceilvo.types import Estimate, FilterHealth, Motion, State

SETTINGS = config.Base(port="mock", rate_hz=200.0, timeout_s=0.01, reconnect_max_s=0.05)


class FakeClock:
    now_ns = 5_000_000_000

    def __call__(self) -> int:
        return self.now_ns


def estimate(seq: int, stamp_ns: int = FakeClock.now_ns, state: State = State.TRACKING) -> Estimate:
    return Estimate(
        seq=seq,
        stamp_ns=stamp_ns,
        pose=np.array([1.0, 2.0, 0.5]),
        cov=np.diag([1e-4, 4e-4, 1e-6]),
        odom=np.zeros(3),
        twist=np.array([0.1, 0.0, 0.2]),
        state=state,
        quality=0.9,
        reason="",
        motion=Motion(np.zeros(3), np.eye(3), 0, 0.0),
        health=FilterHealth(0, 0.0, 0, 0.0, 0.0, 0),
        crossings=0,
        landmarks=0,
    )


class Watched(MockBase):
    """Counts attempts of every kind, and lets a test wait for them."""

    def __init__(self) -> None:
        super().__init__(BaseModel(clock=FakeClock()), timeout_s=0.01)
        self.changed = threading.Condition()
        self.opens = self.exchanges = self.closes = 0

    def _count(self, name: str) -> None:
        with self.changed:
            setattr(self, name, getattr(self, name) + 1)
            self.changed.notify_all()

    def open(self) -> None:
        self._count("opens")
        super().open()

    def exchange(self, telegram: PoseTelegram) -> BaseStatus:
        self._count("exchanges")
        return super().exchange(telegram)

    def close(self) -> None:
        self._count("closes")
        super().close()

    def wait(self, condition: Callable[[], bool], timeout_s: float = PATIENCE_S) -> None:
        with self.changed:
            assert self.changed.wait_for(condition, timeout_s)


def received(base: MockBase) -> list[PoseTelegram]:
    return [r.telegram for r in base.model.telegrams]


def wait_more(base: MockBase, count: int = 2) -> None:
    """`count` more telegrams; with 2, the second was begun after this call."""
    assert base.model.wait_received(base.model.received + count, PATIENCE_S)
