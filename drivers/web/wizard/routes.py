"""What pages may ask of the wizard: each request checked before it goes on to its process."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import math
from collections.abc import Callable, Mapping
from typing import Any

from aiohttp import WSMsgType, web

from ceilvo.drivers.bus.messages import short
from ceilvo.drivers.web.wizard.answers import json_of, refused
from ceilvo.drivers.web.wizard.process import Message, WizardProcess

log = logging.getLogger(__name__)

_MOST_CLICKS = 100
_LARGEST = 1e9
"""Of any number."""
_HEARTBEAT_S = 20.0
_MOST_PAGES = 8
"""Open at once; chosen: one engineer, some devices."""
_PERIOD_S = 0.1
"""From one look for news to the next."""
_FILES = {"report.html": "text/html", "report.pdf": "application/pdf", "calibration.yaml": "application/yaml"}
"""Of the session, that may be taken home."""

Check = Callable[[Mapping[str, object]], dict[str, Any]]


def _nothing(fields: Mapping[str, object]) -> dict[str, Any]:
    return {}


def _start(fields: Mapping[str, object]) -> dict[str, Any]:
    answers = fields.get("answers", {})
    if not isinstance(answers, dict) or not all(isinstance(v, str | bool | int | float) for v in answers.values()):
        raise ValueError("answers: expected names with texts, numbers or true and false")
    if not all(_is_number(v) for v in answers.values() if isinstance(v, int | float)):
        raise ValueError("answers: found a number that is none")
    mode = fields.get("mode", "go")
    if mode not in ("go", "anew", "compute"):
        raise ValueError(f"mode: found {short(mode)}, expected go, anew or compute")
    return {"step": _text(fields, "step"), "mode": mode, "answers": answers}


def _drop(fields: Mapping[str, object]) -> dict[str, Any]:
    index = fields.get("index")
    if isinstance(index, bool) or not isinstance(index, int) or not 0 <= index < 1_000_000:
        raise ValueError(f"index: found {short(index)}, expected a place in the list")
    return {"part": _text(fields, "part"), "index": index}


def _clicks(fields: Mapping[str, object]) -> dict[str, Any]:
    uv = fields.get("uv")
    if not isinstance(uv, list) or not 0 < len(uv) <= _MOST_CLICKS:
        raise ValueError("uv: expected a list of [u, v]")
    if not all(isinstance(p, list) and len(p) == 2 and all(_is_number(v) for v in p) for p in uv):
        raise ValueError("uv: expected pairs of numbers")
    return {"uv": uv}


def _practice(fields: Mapping[str, object]) -> dict[str, Any]:
    on = fields.get("on")
    if not isinstance(on, bool):
        raise ValueError(f"on: found {short(on)}, expected true or false")
    return {"on": on}


def _settings(fields: Mapping[str, object]) -> dict[str, Any]:
    out: dict[str, Any] = {}
    for key in ("exposure_us", "gain"):
        if key in fields:
            if fields[key] is not None and not _is_number(fields[key]):
                raise ValueError(f"{key}: found {short(fields[key])}, expected a number or null")
            out[key] = fields[key]
    if len(out) == 1:
        raise ValueError("expected exposure_us and gain together")
    return out


def _tune(fields: Mapping[str, object]) -> dict[str, Any]:
    return _settings(fields) | {"practice": fields.get("practice") is True}


def _save(fields: Mapping[str, object]) -> dict[str, Any]:
    out = _settings(fields)
    if not out:
        raise ValueError("expected exposure_us and gain")
    return out


CHECKS: Mapping[str, Check] = {
    "look": _nothing, "start": _start, "enough": _nothing, "stop": _nothing, "drop": _drop, "undo": _nothing,
    "clicks": _clicks, "practice": _practice, "apply": _nothing, "report": _nothing, "tune": _tune,
    "save_camera": _save,
}  # fmt: skip


class WizardRoutes:
    """Its handlers run in the server's event loop."""

    def __init__(self, process: WizardProcess, read_only: bool, hello: Mapping[str, object]) -> None:
        self._process, self._read_only, self._hello = process, read_only, hello
        self._open: set[web.WebSocketResponse] = set()

    def routes(self) -> list[web.RouteDef]:
        return [
            web.get("/wizard", self._follow),
            web.post("/wizard/{do}", self._do),
            web.get("/wizard/file/{name}", self._file),
        ]

    async def _do(self, request: web.Request) -> web.StreamResponse:
        do = request.match_info["do"]
        if do not in CHECKS:
            return refused(404, f"{short(do)} is unknown here, expected one of {', '.join(CHECKS)}")
        if self._read_only:
            return refused(403, "web.read_only: pages may look and command nothing")
        fields = await json_of(request)
        try:
            command = {"do": do} | CHECKS[do](fields)
        except ValueError as e:
            return refused(400, str(e))
        if do != "look":
            log.info("%s: wizard: %s", request.remote, do)
        await self._process.do(command)
        return web.json_response({"ok": True})

    async def _file(self, request: web.Request) -> web.StreamResponse:
        name = request.match_info["name"]
        folder = self._process.session
        if name not in _FILES or folder is None:
            raise web.HTTPNotFound(text="no such file\n")
        try:
            data = await asyncio.to_thread((folder / name).read_bytes)
        except OSError:
            raise web.HTTPNotFound(text=f"{name}: not there yet\n") from None
        kept = {"Content-Disposition": f'attachment; filename="{name}"'}
        return web.Response(body=data, content_type=_FILES[name], headers=kept)

    async def _follow(self, request: web.Request) -> web.StreamResponse:
        if len(self._open) >= _MOST_PAGES:
            return refused(503, f"{_MOST_PAGES} pages are open, close one")
        ws = web.WebSocketResponse(max_msg_size=1024, heartbeat=_HEARTBEAT_S)
        await ws.prepare(request)
        self._open.add(ws)
        self._process.arrive()
        telling = asyncio.create_task(self._tell(ws))
        try:
            async for message in ws:
                if message.type == WSMsgType.ERROR:
                    break
        finally:
            self._open.discard(ws)
            self._process.leave()
            telling.cancel()
            with contextlib.suppress(asyncio.CancelledError, ConnectionError):
                await telling
        return ws

    async def _tell(self, ws: web.WebSocketResponse) -> None:
        with contextlib.suppress(ConnectionError):
            await ws.send_json({"topic": "hello", "data": dict(self._hello)})
            await self._process.ready()
            seen: dict[str, int] = {}
            while not ws.closed:
                for message in self._process.news(seen):
                    await send(ws, message)
                await asyncio.sleep(_PERIOD_S)

    async def close(self) -> None:
        """Pages and process."""
        for ws in list(self._open):
            await ws.close(code=1001, message=b"the server ends")
        await self._process.end()


async def send(ws: web.WebSocketResponse, message: Message) -> None:
    await (ws.send_bytes(message) if isinstance(message, bytes) else ws.send_str(message))


def _text(fields: Mapping[str, object], name: str) -> str:
    value = fields.get(name)
    if not isinstance(value, str) or len(value) > 100:
        raise ValueError(f"{name}: found {short(value)}, expected a name")
    return value


def _is_number(value: object) -> bool:
    if isinstance(value, bool):
        return True
    return isinstance(value, int | float) and math.isfinite(value) and abs(value) < _LARGEST
