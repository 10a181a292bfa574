"""Zenoh sessions as config.yaml asks for them, opened without ever holding up the caller."""

from __future__ import annotations

import json
import logging
import re
import secrets
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import zenoh

from ceilvo.config import Zenoh
from ceilvo.config.zenoh_names import endpoint_problems, on_this_computer
from ceilvo.drivers.bus.messages import short
from ceilvo.errors import BusError, ConfigError, one_line

log = logging.getLogger(__name__)

OPEN_WAIT_S = 3.0
"""Longest that open() waits; an absent router takes the rest of its time in the background."""
CLOSE_WAIT_S = 1.0
"""Longest that close() waits; chosen."""
_RETRY_FIRST_S, _RETRY_MAX_S = 0.25, 1.0
"""Of a client without a router, and of a peer's links: a router that restarts is found within a second."""
_REASON_CHARS, _LOOKED_AT_CHARS = 200, 2000
"""Of a Zenoh error: the log keeps one line; it repeats the file that it is about, however long that is."""
_NOBODY: dict[str, list[str]] = {"router": [], "peer": [], "client": []}
_ONLY_FOUND: dict[str, Any] = {"scouting/multicast/autoconnect": _NOBODY}
"""The daemon is found by multicast and connects to nobody it finds: its scouting socket takes answers from the network,
and whoever forges one would have the daemon come to him."""
_ONLY_INTRODUCED: dict[str, Any] = {"scouting/gossip/autoconnect": _NOBODY}
"""A stranger found by multicast may be on the network, and would introduce the daemon to its peers there: they may come
to it, where they can, and it goes to none of them."""
_SMALL_ID = "000000"
"""The end of a session id, which Zenoh compares first: of two peers that a router introduces, ROS 2's has only the one
with the greater id connect (rmw_zenoh's autoconnect_strategy), so the daemon's is smaller than any of theirs."""
_STAMPED = {"router": True, "peer": True, "client": True}
"""What a late subscriber of ROS 2 gets from a publisher's cache must have a time."""
_LOCAL_ROUTER = "tcp/127.0.0.1:7447"
"""Where a Zenoh router listens by default."""
_RECEIVED: dict[str, Any] = {
    # Sessions with shared memory take one of 351 counters each: strangers that do nothing would lock everybody out.
    "transport/shared_memory/enabled": False,
    "transport/link/rx/max_message_size": 1 << 17,
    "low_pass_filter": [
        {
            "id": "requests",
            "flows": ["ingress"],
            "messages": ["put", "delete", "query", "reply"],
            "key_exprs": ["**"],
            "size_limit": 1 << 16,
        }
    ],
}
"""The daemon is sent requests only, of at most 4 KiB: what is far larger is dropped before it is put together."""


_VISIT: dict[str, Any] = {
    "mode": "client",
    "listen/endpoints": [],
    "connect/timeout_ms": 0,
    "connect/exit_on_failure": True,
    "scouting/multicast/enabled": False,
}


def session_config(config: Zenoh) -> zenoh.Config:
    """What the daemon opens: config_file whole when it is given, else our keys.

    Raises:
        BusError: an endpoint cannot be used; names the key.
        ConfigError: the file cannot be used.
    """
    ros2 = set(config.wire) & {"rmw_zenoh", "ros2dds"}
    if config.config_file:
        out = _from_file(config.config_file)
        if ros2:
            out.insert_json5("timestamping/enabled", json.dumps(_STAMPED))
        return out
    listen, connect = _checked_endpoints(config)
    found = _ONLY_FOUND | (_ONLY_INTRODUCED if _meets_strangers(config, listen, connect) else {})
    name = {"id": f"1{secrets.token_hex(12)}{_SMALL_ID}"}
    stamped = {"timestamping/enabled": _STAMPED} if ros2 else {}
    return _from_settings(_settings(config, listen, connect) | _RECEIVED | found | name | stamped)


def watcher_config(config: Zenoh) -> zenoh.Config:
    """For a second process beside the daemon: the same, but it listens on a free loopback port instead of the daemon's,
    and connects to the ports that the daemon listens on.

    Raises:
        BusError: as session_config().
    """
    if config.config_file:
        out: zenoh.Config = _from_file(config.config_file)
        daemon, connect = _listed(out, "listen"), _listed(out, "connect")
        out.insert_json5("listen/endpoints", json.dumps(["tcp/127.0.0.1:0"]))
        out.insert_json5("connect/endpoints", json.dumps([*connect, *_reachable(daemon)]))
        return out
    listen, connect = _checked_endpoints(config)
    return _from_settings(_settings(config, ["tcp/127.0.0.1:0"], [*connect, *_reachable(listen)]))


def visitor_configs(config: Zenoh) -> list[zenoh.Config]:
    """For a short look at who is there: a client of each router that is named, for clients see all that it serves.

    Raises:
        BusError: as session_config().
    """
    if config.config_file:
        file = _from_file(config.config_file)
        ends = _listed(file, "connect")
        out = [_from_file(config.config_file) for _ in ends]
    else:
        _, ends = _checked_endpoints(config)
        out = [zenoh.Config() for _ in ends]
    for one, end in zip(out, ends, strict=True):
        for key, value in _VISIT.items():
            one.insert_json5(key, json.dumps(value))
        one.insert_json5("connect/endpoints", json.dumps([end]))
    return out


def _checked_endpoints(config: Zenoh) -> tuple[list[str], list[str]]:
    """zenoh.listen and zenoh.connect.

    Raises:
        BusError: one of them is impossible.
    """
    for keys, problem in endpoint_problems(config):
        raise BusError(f"{keys[0]}: {problem}")
    needs_router = config.mode == "client" or "rmw_zenoh" in config.wire  # as every node of rmw_zenoh has
    router = [_LOCAL_ROUTER] if needs_router and not config.connect else []
    return list(config.listen), [*config.connect, *router]


def _settings(config: Zenoh, listen: list[str], connect: list[str]) -> dict[str, Any]:
    client = config.mode == "client"
    return {
        "mode": config.mode,
        "listen/endpoints": [] if client else listen,
        "connect/endpoints": connect,
        # A peer retries in the background for ever. A client's open fails at once and is retried by Connection.
        "connect/timeout_ms": 0 if client else -1,
        "connect/exit_on_failure": client,
        "connect/retry": {
            "period_init_ms": round(1e3 * _RETRY_FIRST_S),
            "period_max_ms": round(1e3 * _RETRY_MAX_S),
            "period_increase_factor": 2,
        },
        "open/return_conditions/connect_scouted": client,
        # What the queue to a subscriber cannot take within this is dropped for that subscriber. With 0 a put would not
        # wait at all, but healthy subscribers lose images.
        "transport/link/tx/queue/congestion_control/drop/wait_before_drop": 1000,
        "scouting/multicast/enabled": config.multicast,
        # By address: a name would be looked up by netlink, which the unit does without.
        "scouting/multicast/interface": "127.0.0.1",
        # A router carries nothing between its peers: it introduces them to one another by gossip.
        "scouting/gossip/enabled": bool(connect) or not _meets_strangers(config, listen, connect),
    }


def _meets_strangers(config: Zenoh, listen: list[str], connect: list[str]) -> bool:
    """By multicast, on a computer that the daemon itself does not leave."""
    return config.multicast and all(map(on_this_computer, [*listen, *connect]))


def _from_settings(settings: dict[str, Any]) -> zenoh.Config:
    out: zenoh.Config = zenoh.Config()
    for key, value in settings.items():
        out.insert_json5(key, json.dumps(value))
    return out


def _from_file(path: str) -> zenoh.Config:
    if not Path(path).is_file():
        raise ConfigError(f"zenoh.config_file: found {short(path)}, expected a Zenoh configuration file; no such file")
    try:
        out: zenoh.Config = zenoh.Config.from_file(path)
    except (zenoh.ZError, OSError, ValueError) as e:
        raise ConfigError(
            f"zenoh.config_file: {path} cannot be used: {zenoh_reason(e)}; correct the file, or restore it"
        ) from e
    return out


def _listed(config: zenoh.Config, key: str) -> list[str]:
    """Endpoints of a configuration, whether given plainly or by mode."""
    value = json.loads(config.get_json(f"{key}/endpoints"))
    if isinstance(value, dict):
        value = value.get(session_mode(config), [])
    return [e for e in value or [] if isinstance(e, str)]


def _reachable(listen: list[str]) -> list[str]:
    """Where to connect to reach a process of this computer that listens there: fixed ports only."""
    ends = [e.replace("/0.0.0.0:", "/127.0.0.1:").replace("/[::]:", "/127.0.0.1:") for e in listen]
    return [e for e in ends if not re.search(r":0([?#]|$)", e)]


def session_mode(config: zenoh.Config) -> str:
    """peer, client or router."""
    return str(json.loads(config.get_json("mode")) or "peer")


def zenoh_reason(e: Exception) -> str:
    """What a Zenoh error says, on one line and without its source positions."""
    text = " ".join(str(e).split())[:_LOOKED_AT_CHARS]
    return one_line(re.sub(r" at /\S+\.rs:\d+\.?", "", text), _REASON_CHARS)


class Connection:
    """A session that is opened in a thread of its own, because Zenoh's open may block for as long as a router is away.

    `on_open` declares what the session is for; it runs once, in that thread, before `session` is set.
    """

    def __init__(self, config: zenoh.Config, key: str, on_open: Callable[[zenoh.Session], None]) -> None:
        """`key` names the configuration in errors."""
        self._config = config
        self._key = key
        self._on_open = on_open
        self._retry = session_mode(config) == "client"
        self._stop = threading.Event()
        self._first_try = threading.Event()
        self._error: Exception | None = None
        self._lock = threading.Lock()
        self._session: zenoh.Session | None = None
        self._thread = threading.Thread(target=self._run, name="zenoh-open", daemon=True)

    @property
    def session(self) -> zenoh.Session | None:
        """None until it is open and after close()."""
        return self._session

    def open(self) -> None:
        """Return when the session is open, or a client's router does not answer yet, or after OPEN_WAIT_S.

        Raises:
            BusError: the session cannot be opened as configured.
        """
        self._thread.start()
        if not self._first_try.wait(OPEN_WAIT_S):
            log.warning("%s: Zenoh is not open yet, going on without it until it is", self._key)
        elif self._error is not None:
            raise BusError(f"{self._key}: Zenoh cannot open: {zenoh_reason(self._error)}") from self._error

    def links(self) -> tuple[int, int]:
        """Routers and peers connected now."""
        session = self._session
        if session is None:
            return 0, 0
        return len(session.info.routers_zid()), len(session.info.peers_zid())

    def close(self) -> None:
        """Idempotent; waits at most CLOSE_WAIT_S."""
        self._stop.set()
        with self._lock:
            session, self._session = self._session, None
        if session is None:
            return
        closer = threading.Thread(target=_close_quietly, args=(session,), name="zenoh-close", daemon=True)
        closer.start()
        closer.join(CLOSE_WAIT_S)
        if closer.is_alive():
            log.warning("Zenoh did not close within %.1f s", CLOSE_WAIT_S)

    def _run(self) -> None:
        try:
            self._open_session()
        except Exception as e:
            # Reported by open(); a later failure can only be logged.
            self._error = e
            if self._first_try.is_set():
                log.error("%s: Zenoh cannot open: %s", self._key, zenoh_reason(e))
        finally:
            self._first_try.set()

    def _open_session(self) -> None:
        wait_s = _RETRY_FIRST_S
        while not self._stop.is_set():
            try:
                session = zenoh.open(self._config)
            except zenoh.ZError as e:
                if not self._retry:
                    raise
                if not self._first_try.is_set():
                    log.warning("%s: %s; retrying", self._key, zenoh_reason(e))
                self._first_try.set()
                self._stop.wait(wait_s)
                wait_s = min(2 * wait_s, _RETRY_MAX_S)
            else:
                self._adopt(session)
                return

    def _adopt(self, session: zenoh.Session) -> None:
        try:
            self._on_open(session)
        except Exception:
            _close_quietly(session)
            raise
        with self._lock:
            if not self._stop.is_set():
                self._session = session
                return
        _close_quietly(session)


def _close_quietly(session: zenoh.Session) -> None:
    try:
        session.close()  # type: ignore[no-untyped-call]
    except zenoh.ZError as e:
        log.debug("closing Zenoh: %s", e)
