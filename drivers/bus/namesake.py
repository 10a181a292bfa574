"""Does another daemon of the same name answer behind the same routers? One command would move both robots."""

from __future__ import annotations

import contextlib
import logging
import threading
import time

import zenoh

from ceilvo.config import Zenoh
from ceilvo.drivers.bus.messages import robot_key
from ceilvo.drivers.bus.zenoh_session import visitor_configs, zenoh_reason
from ceilvo.errors import ConfigError

log = logging.getLogger(__name__)

ASK_S = 1.0
"""Longest that one router is asked; chosen: it answers within milliseconds, or is not there."""
LEASE_S = 12.0
"""A token whose owner lost its power or its network stands until Zenoh's lease of 10 s is over; and a little."""
_AGAIN_S = 0.5
"""Between two looks at a token that may be the last of a dead daemon."""


def refuse_namesake(config: Zenoh, robot: str, patience_s: float = LEASE_S) -> None:
    """Return when nobody of this name is behind the routers that are named, or none of them answers.

    Raises:
        ConfigError: somebody still is after `patience_s`, so that a restart on one's own old name is none.
    """
    if config.allow_same_name or not config.enabled:
        return
    stem = robot_key(config.prefix, robot)
    deadline = time.monotonic() + patience_s
    router = _where(config, stem)
    if router:
        log.warning("%s is on the network already; waiting %g s, for that may be its last sign", stem, patience_s)
    while router:
        if time.monotonic() >= deadline:
            raise ConfigError(
                f"robot.name: found {robot} in use behind {router}, expected no other daemon of this name on the "
                "network; stop that one, give this one another name, or set zenoh.allow_same_name"
            )
        threading.Event().wait(_AGAIN_S)
        router = _where(config, stem)


def session_token(stem: str, zid: str) -> str:
    """A token that tells daemons of one name apart."""
    return f"{stem}/@session/{zid}"


def namesake(config: Zenoh, stem: str, zid: str) -> str:
    """The router behind which another session than one's own has this name; "" for none. Takes up to 2 s."""
    return _where(config, session_token(stem, "*"), session_token(stem, zid))


def _where(config: Zenoh, token: str, own: str = "") -> str:
    """The router behind which somebody else's token stands; "" for none."""
    found: list[str] = []

    def ask() -> None:
        for visitor in visitor_configs(config):
            end = visitor.get_json("connect/endpoints").strip('[]"')
            try:
                with zenoh.open(visitor) as session:
                    replies = session.liveliness().get(token, timeout=ASK_S)
                    found.extend(end for r in replies if r.ok is not None and str(r.ok.key_expr) != own)
            except zenoh.ZError as e:
                log.debug("%s: %s", end, zenoh_reason(e))

    # In a thread, because a router that takes a connection and says no more holds up whoever opens a session.
    asking = threading.Thread(target=ask, name="zenoh-visit", daemon=True)
    asking.start()
    asking.join(2.0 * ASK_S)
    with contextlib.suppress(IndexError):
        return found[0]
    return ""
