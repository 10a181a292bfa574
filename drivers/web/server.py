"""The server behind `ceilvod web`: pages, one websocket a page, three commands (docs/web.md)."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import os
import threading
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

from aiohttp import ClientConnectionResetError, WSMsgType, web
from aiohttp.http_exceptions import HttpProcessingError
from aiohttp.typedefs import Handler, Middleware

from ceilvo.config import Config
from ceilvo.drivers.bus.commands import MAX_COMMAND_BYTES, parse_command
from ceilvo.drivers.bus.messages import load_object, short
from ceilvo.drivers.ports import ON_DEMAND, Topic
from ceilvo.drivers.rate_limit import QuietLog
from ceilvo.drivers.web.guard import Guard
from ceilvo.drivers.web.recordings import Recordings
from ceilvo.drivers.web.robot import Robot
from ceilvo.drivers.web.wizard.answers import expect_json, json_of, refused
from ceilvo.drivers.web.wizard.process import Place, WizardProcess
from ceilvo.drivers.web.wizard.routes import WizardRoutes, send
from ceilvo.errors import BusError, one_line

log = logging.getLogger(__name__)

PAGES = Path(__file__).with_name("pages")
COMMANDS = ("initial_pose", "relocalise", "save_map")
"""Of the daemon's, those that a page has a button for."""
_OPEN_TO_ALL = ("/login", "/pages/login.js", "/pages/style.css", "/pages/icon.svg")
"""Nothing of the robot is in them: they ask for the token."""
_PAGES = {"/": "live.html", "/commission": "wizard.html", "/camera": "camera.html"}
_TYPES = {".html": "text/html", ".css": "text/css", ".js": "text/javascript", ".svg": "image/svg+xml"}
_MOST_PAGES = 16
"""Open at once; chosen: more than people beside a robot."""
_HEARTBEAT_S = 20.0
"""A page that does not answer within half of it is gone."""
_POLL_S = 0.1
"""How soon a stop is noticed."""
_END_S = 1.0
"""That open pages may take to close."""
_HEADERS = {
    "Content-Security-Policy": (
        "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob:; connect-src 'self'; "
        "form-action 'self'; base-uri 'none'; frame-ancestors 'none'"
    ),
    "Cache-Control": "no-store",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
}
_OF_THE_CLIENT = (HttpProcessingError, ClientConnectionResetError, web.RequestPayloadError)


class BadRequests(logging.Filter):
    """aiohttp shows a traceback for what is no HTTP and for who left early: a line is enough, and few of them."""

    def __init__(self) -> None:
        super().__init__()
        self._quiet = QuietLog(log, 0.2, 10)

    def filter(self, record: logging.LogRecord) -> bool:
        error = record.exc_info[1] if record.exc_info else None
        if not isinstance(error, _OF_THE_CLIENT):
            return True
        self._quiet.info(f"{record.getMessage()}: {one_line(error)}")
        return False


class Server:
    """Its handlers run in one event loop."""

    def __init__(self, config: Config, robot: Robot, config_file: Path | None = None, simulate: bool = False) -> None:
        """
        Args:
            config_file: where the configuration came from, None = the defaults.
            simulate: the robot is the simulated one.

        Raises:
            ConfigError: a file cannot be used.
        """
        self.guard = Guard(config.web)
        self._robot, self._web = robot, config.web
        self._files = {p.name: p.read_bytes() for p in sorted(PAGES.rglob("*.*")) if p.suffix in _TYPES}
        folder = Path(config.web.state_dir or os.environ.get("STATE_DIRECTORY") or ".").resolve()
        self._process = WizardProcess(Place(config, config_file, folder, simulate))
        self._recordings = Recordings(config, folder / "recordings", simulate, lambda: robot.alive)
        self._wizard = WizardRoutes(self._process, config.web.read_only, self._hello())
        self._open: set[web.WebSocketResponse] = set()
        self._quiet = QuietLog(log, 0.2, 10)

    def app(self) -> web.Application:
        app = web.Application(middlewares=[self._checked()], client_max_size=MAX_COMMAND_BYTES)
        app.add_routes(
            [
                *(web.get(path, partial(self._file, name)) for path, name in _PAGES.items()),
                *self._wizard.routes(),
                *self._recordings.routes(),
                web.get("/login", partial(self._file, "login.html")),
                web.get("/pages/{name}", self._named),
                web.get("/live", self._live),
                web.post("/login", self._sign_in),
                web.post("/logout", self._sign_out),
                web.post("/cmd/{name}", self._command),
            ]
        )
        app.on_response_prepare.append(_add_headers)
        app.on_shutdown.append(self._close_pages)
        return app

    def _checked(self) -> Middleware:
        @web.middleware
        async def checked(request: web.Request, handler: Handler) -> web.StreamResponse:
            self.guard.admit(request)
            if request.path not in _OPEN_TO_ALL:
                try:
                    self.guard.authorise(request)
                except web.HTTPUnauthorized:
                    if request.path in _PAGES and request.method == "GET":
                        raise web.HTTPSeeOther("/login") from None
                    raise
            return await handler(request)

        return checked

    async def _file(self, name: str, request: web.Request) -> web.StreamResponse:
        if name not in self._files:
            raise web.HTTPNotFound(text="no such page\n")
        kind = _TYPES[Path(name).suffix]
        return web.Response(body=self._files[name], content_type=kind, charset="utf-8")

    async def _named(self, request: web.Request) -> web.StreamResponse:
        return await self._file(request.match_info["name"], request)

    # -- commands

    async def _sign_in(self, request: web.Request) -> web.StreamResponse:
        fields = await json_of(request)
        response = web.json_response({"ok": True})
        token = fields.get("token")
        if not isinstance(token, str) or not self.guard.sign_in(token, response):
            self._quiet.warning(f"{request.remote}: the wrong token for the pages")
            return refused(401, "found another token, expected the one of web.token_file")
        return response

    async def _sign_out(self, request: web.Request) -> web.StreamResponse:
        response = web.json_response({"ok": True})
        self.guard.sign_out(request, response)
        return response

    async def _command(self, request: web.Request) -> web.StreamResponse:
        name = request.match_info["name"]
        if name not in COMMANDS:
            return refused(404, f"command {short(name)} is unknown here, expected one of {', '.join(COMMANDS)}")
        if self._web.read_only:
            return refused(403, "web.read_only: pages may look and command nothing")
        expect_json(request)
        payload = await request.read()
        try:
            parse_command(name, payload)
        except BusError as e:
            return refused(400, str(e))
        log.info("%s: command %s", request.remote, name)
        answer = await asyncio.to_thread(self._robot.command, name, payload)
        if answer is None:
            return refused(504, f"command {name}: the daemon does not answer; is it running?")
        return web.Response(body=answer[1], content_type="application/json", status=200 if answer[0] else 409)

    # -- what a page gets

    async def _live(self, request: web.Request) -> web.StreamResponse:
        if len(self._open) >= _MOST_PAGES:
            return refused(503, f"{_MOST_PAGES} pages are open, close one")
        ws = web.WebSocketResponse(max_msg_size=MAX_COMMAND_BYTES, heartbeat=_HEARTBEAT_S)
        await ws.prepare(request)
        self._open.add(ws)
        topics: set[Topic] = set()
        telling = asyncio.create_task(self._tell(ws, topics))
        try:
            async for message in ws:
                if message.type != WSMsgType.TEXT:
                    continue
                wanted = _wanted(message.data)
                if wanted is not None:
                    topics.clear()
                    topics.update(wanted)
                    self._robot.want(ws, wanted)
        finally:
            self._open.discard(ws)
            self._robot.leave(ws)
            telling.cancel()
            with contextlib.suppress(asyncio.CancelledError, ConnectionError):
                await telling
        return ws

    async def _tell(self, ws: web.WebSocketResponse, topics: set[Topic]) -> None:
        """The newest of everything at the page's pace: what a slow page misses is not kept for it."""
        await ws.send_json({"topic": "hello", "data": self._hello()})
        seen: dict[str, int] = {}
        recordings = ""
        with contextlib.suppress(ConnectionError):
            while not ws.closed:
                for message in self._robot.news(seen, topics):
                    await send(ws, message)
                now = self._recordings.news()
                if now != recordings:
                    recordings = now
                    await send(ws, now)
                await asyncio.sleep(1.0 / self._web.rate_hz)

    def _hello(self) -> dict[str, object]:
        return {"robot": self._robot.name, "read_only": self._web.read_only, "signed_in": self.guard.needs_token}

    async def _close_pages(self, app: web.Application) -> None:
        for ws in list(self._open):
            await ws.close(code=1001, message=b"the server ends")
        await self._wizard.close()
        await self._recordings.close()


def _wanted(text: str) -> set[Topic] | None:
    """What a page says that it needs; None for what is no such message."""
    try:
        names = load_object(text.encode("utf-8", "replace"), "page").get("want")
    except BusError:
        return None
    return {t for t in ON_DEMAND if t.value in names} if isinstance(names, list) else None


async def _add_headers(request: web.Request, response: web.StreamResponse) -> None:
    response.headers.update(_HEADERS)
    response.headers["Server"] = "ceilvo"


def serve(
    config: Config,
    stop: threading.Event,
    on_ready: Callable[[str], None] = lambda address: None,
    alive: Callable[[], None] = lambda: None,
    config_file: Path | None = None,
    simulate: bool = False,
) -> None:
    """Serve pages of a robot until `stop` is set.

    Args:
        on_ready: is told the address for a browser.
        alive: called several times a second.
        config_file: where the configuration came from, None = the defaults.
        simulate: the robot is the simulated one, which may be commissioned without a camera.

    Raises:
        ConfigError: a file cannot be used.
        BusError: the port is taken, or Zenoh cannot be used as configured.
    """
    robot = Robot(config)
    server = Server(config, robot, config_file, simulate)
    ended: list[BaseException] = []

    def listen() -> None:
        try:
            robot.run(stop)
        except BaseException as e:  # told by serve(), whose end it is
            ended.append(e)
            stop.set()

    listener = threading.Thread(target=listen, name="web-robot", daemon=True)
    listener.start()
    try:
        asyncio.run(_serve(server, config, stop, on_ready, alive))
    finally:
        stop.set()
        listener.join()
    if ended:
        raise ended[0]


async def _serve(
    server: Server, config: Config, stop: threading.Event, on_ready: Callable[[str], None], alive: Callable[[], None]
) -> None:
    host, port = config.web.host, config.web.port
    said = logging.Logger(f"{__name__}.http")
    said.parent = log
    said.addFilter(BadRequests())
    options: dict[str, Any] = {"access_log": None, "logger": said}
    runner = web.AppRunner(server.app(), handle_signals=False, shutdown_timeout=_END_S, **options)
    await runner.setup()
    try:
        site = web.TCPSite(runner, host, port, ssl_context=server.guard.tls)
        try:
            await site.start()
        except OSError as e:
            raise BusError(f"web.port: {host}:{port} cannot be listened on: {e.strerror}; choose another one") from e
        at = f"[{host}]" if ":" in host else host
        on_ready(f"{'https' if server.guard.tls else 'http'}://{at}:{runner.addresses[0][1]}")
        while not stop.is_set():
            alive()
            await asyncio.sleep(_POLL_S)
    finally:
        await runner.cleanup()
