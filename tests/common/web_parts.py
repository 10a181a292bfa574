"""A server of pages in a thread of the test's own process, and who asks it."""

from __future__ import annotations

import contextlib
import http.client
import json
import ssl
import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

from patience import PATIENCE_S
from websockets.sync.client import ClientConnection, connect

from ceilvo.config import Config, Web, Zenoh
from ceilvo.drivers.web.server import serve


def config_for(zenoh_port: int, **web: object) -> Config:
    """For a daemon that listens on this port of loopback."""
    zenoh = Zenoh(listen=(f"tcp/127.0.0.1:{zenoh_port}",), multicast=False)
    return Config(zenoh=zenoh, web=replace(Web(port=0), **web))  # type: ignore[arg-type]


@contextmanager
def served(config: Config, config_file: Path | None = None, simulate: bool = False) -> Iterator[str]:
    """The address for a browser. Raises what the server ended with."""
    stop, ready = threading.Event(), threading.Event()
    address: list[str] = []
    ended: list[BaseException] = []

    def on_ready(at: str) -> None:
        address.append(at)
        ready.set()

    def body() -> None:
        try:
            serve(config, stop, on_ready, config_file=config_file, simulate=simulate)
        except BaseException as e:
            ended.append(e)
            ready.set()

    thread = threading.Thread(target=body)
    thread.start()
    try:
        assert ready.wait(PATIENCE_S)
        if not ended:
            yield address[0]
    finally:
        stop.set()
        thread.join(PATIENCE_S)
    assert not thread.is_alive()
    if ended:
        raise ended[0]


class Answer:
    """Of the server to one request."""

    def __init__(self, response: http.client.HTTPResponse) -> None:
        self.status, self.headers, self.body = response.status, response.headers, response.read()

    @property
    def json(self) -> dict[str, Any]:
        fields = json.loads(self.body)
        assert isinstance(fields, dict)
        return fields


class Client:
    """Who asks with the standard library alone, one connection a request."""

    def __init__(self, address: str, tls: ssl.SSLContext | None = None) -> None:
        self._tls, self._own = tls, address.partition("//")[2]

    def get(self, path: str, headers: Mapping[str, str] | None = None) -> Answer:
        return self._ask("GET", path, None, headers or {})

    def post(self, path: str, body: bytes, headers: Mapping[str, str] | None = None) -> Answer:
        return self._ask("POST", path, body, {"Content-Type": "application/json"} | dict(headers or {}))

    def upgrade(self, headers: Mapping[str, str]) -> int:
        """The status of the answer to a wish for the websocket."""
        wish = {"Connection": "Upgrade", "Upgrade": "websocket", "Sec-WebSocket-Version": "13"}
        return self._ask(
            "GET", "/live", None, {**wish, "Sec-WebSocket-Key": "AQIDBAUGBwgJCgsMDQ4PEA==", **headers}
        ).status

    def live(self, headers: Mapping[str, str] | None = None) -> ClientConnection:
        """A page's websocket; a context manager."""
        scheme = "wss" if self._tls else "ws"
        return connect(f"{scheme}://{self._own}/live", additional_headers=dict(headers or {}), ssl=self._tls)

    def _ask(self, method: str, path: str, body: bytes | None, headers: Mapping[str, str]) -> Answer:
        if self._tls is None:
            connection = http.client.HTTPConnection(self._own, timeout=PATIENCE_S)
        else:
            connection = http.client.HTTPSConnection(self._own, timeout=PATIENCE_S, context=self._tls)
        with contextlib.closing(connection):
            connection.request(method, path, body, dict(headers))
            return Answer(connection.getresponse())
