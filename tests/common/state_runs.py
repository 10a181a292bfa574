"""What the state machine says of evidence, frame after frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from ceilvo.config import States
from ceilvo.daemon.integrity.states import Evidence, StateMachine, Verdict

PERIOD_NS = 33_000_000
CONFIG = States()


def run(evidence: Sequence[Evidence], config: States = CONFIG) -> list[Verdict]:
    machine = StateMachine(config)
    return [machine.step(replace(e, stamp_ns=k * PERIOD_NS)) for k, e in enumerate(evidence)]
