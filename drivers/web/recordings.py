"""Recordings that a page starts: a process of their own each, in a folder of their own, ended at a size."""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
import re
import shutil
import signal
import sys
import time
from asyncio.subprocess import DEVNULL, PIPE, Process
from collections.abc import Callable
from dataclasses import dataclass
from datetime import datetime, timezone
from pathlib import Path

from aiohttp import web

from ceilvo.config import Config
from ceilvo.config.rendering import render_config
from ceilvo.drivers.bus.messages import short
from ceilvo.drivers.web.wizard.answers import json_of, refused
from ceilvo.errors import one_line
from ceilvo.files import write_atomic

log = logging.getLogger(__name__)

_NAME = re.compile(r"[A-Za-z0-9_.-]{1,80}\.mcap")
_LISTED = 20
"""The latest ones."""
_LOOK_S = 0.5
"""From one look at the size to the next."""
_BEGIN_S, _POLL_S = 60.0, 0.05
"""That a recording may take until it has begun, and how often that is looked at: a stop before leaves none."""
_BEGUN_BYTES = 1000
"""More than a file's head; then the first message is there."""
_END_S = 60.0
"""That a recording may take to write its index, on a computer with much else to do."""
_SPARE = 2
"""Times the size of a recording that must be free on the disk."""


@dataclass
class _Running:
    process: Process
    file: Path
    lossless: bool
    began_s: float | None = None
    """None until its first message is there."""


class Recordings:
    """For one event loop."""

    def __init__(self, config: Config, folder: Path, simulate: bool, alive: Callable[[], bool]) -> None:
        """
        Args:
            simulate: a daemon that is started for a recording is that of the simulated robot.
            alive: whether the robot's daemon runs.
        """
        self._config, self._folder, self._simulate, self._alive = config, folder, simulate, alive
        self._read_only = config.web.read_only
        self._running: _Running | None = None
        self._watching: asyncio.Task[None] | None = None
        self._error = ""
        self._news, self._news_s = "", -_LOOK_S

    def routes(self) -> list[web.RouteDef]:
        return [
            web.post("/recording/start", self._start),
            web.post("/recording/stop", self._stop),
            web.post("/recording/delete", self._delete),
            web.get("/recording/file/{name}", self._file),
        ]

    def news(self) -> str:
        """How things stand, as a line for a page; looked at twice a second at the most."""
        if time.monotonic() - self._news_s >= _LOOK_S:
            self._news, self._news_s = self._look(), time.monotonic()
        return self._news

    def _look(self) -> str:
        now = self._running
        files = sorted(self._folder.glob("*.mcap"), reverse=True)[:_LISTED]
        rows = [{"name": p.name, "bytes": _size(p)} for p in files if now is None or p != now.file]
        on = None
        if now is not None:
            seconds = None if now.began_s is None else round(time.monotonic() - now.began_s)
            on = {"name": now.file.name, "bytes": _size(now.file), "seconds": seconds, "lossless": now.lossless}
        data = {"on": on, "files": rows, "error": self._error, "most_bytes": self._config.web.recording_bytes}
        return json.dumps({"topic": "recordings", "data": data})

    async def close(self) -> None:
        """End what is being recorded."""
        await self._end()

    # -- requests

    async def _start(self, request: web.Request) -> web.StreamResponse:
        """What a running daemon says is kept; where none runs `ceilvod record` is the daemon, and keeps all it sees."""
        await json_of(request)
        if self._read_only:
            return refused(403, "web.read_only: pages may look and command nothing")
        if self._running is not None:
            return refused(409, f"{self._running.file.name} is being recorded, stop it first")
        need = _SPARE * self._config.web.recording_bytes
        name = f"{_slug(self._config.robot.name)}-{datetime.now(timezone.utc).strftime('%Y%m%d-%H%M%S')}.mcap"
        file, settings = self._folder / name, self._folder / "config.yaml"
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
            free = shutil.disk_usage(self._folder).free
            if free < need:
                return refused(507, f"{self._folder}: found {free} bytes free, expected {need} (web.recording_bytes)")
            write_atomic(settings, render_config(self._config), 0o600)
        except OSError as e:
            return refused(507, f"{self._folder}: cannot be written ({one_line(e)}); set web.state_dir")
        lossless = not self._alive()
        words = ["record", str(file)] if lossless else ["view", "--mcap", str(file)]
        words += ["--config", str(settings), *(["--simulate"] if lossless and self._simulate else [])]
        self._error = ""
        process = await asyncio.create_subprocess_exec(
            sys.executable, "-m", "ceilvo.daemon.cli", *words, stdin=DEVNULL, stdout=DEVNULL, stderr=PIPE
        )
        self._running = _Running(process, file, lossless)
        self._watching = asyncio.create_task(self._watch(self._running))
        deadline = time.monotonic() + _BEGIN_S
        while _size(file) < _BEGUN_BYTES and not self._watching.done() and time.monotonic() < deadline:
            await asyncio.sleep(_POLL_S)
        if self._watching.done():
            return refused(409, self._error or "the recording ended before it began")
        if self._running is not None:
            self._running.began_s = time.monotonic()
        log.info("%s: recording into %s", request.remote, file)
        return web.json_response({"ok": True, "result": {"name": name, "lossless": lossless}})

    async def _stop(self, request: web.Request) -> web.StreamResponse:
        await json_of(request)
        if self._read_only:
            return refused(403, "web.read_only: pages may look and command nothing")
        if self._running is None:
            return refused(409, "nothing is being recorded")
        if self._running.began_s is None:
            return refused(409, "the recording has not begun yet")
        name = self._running.file.name
        await self._end()
        return web.json_response({"ok": True, "result": {"name": name}})

    async def _delete(self, request: web.Request) -> web.StreamResponse:
        name = (await json_of(request)).get("name")
        if self._read_only:
            return refused(403, "web.read_only: pages may look and command nothing")
        file = self._named(name)
        if file is None or (self._running is not None and file == self._running.file):
            return refused(404, f"{short(name)}: found no such recording, expected one of the list")
        try:
            await asyncio.to_thread(file.unlink)
        except OSError as e:
            return refused(409, f"{name}: {one_line(e)}")
        return web.json_response({"ok": True})

    async def _file(self, request: web.Request) -> web.StreamResponse:
        file = self._named(request.match_info["name"])
        if file is None:
            raise web.HTTPNotFound(text="no such recording\n")
        kept = {
            "Content-Disposition": f'attachment; filename="{file.name}"',
            "Content-Type": "application/octet-stream",
        }
        return web.FileResponse(file, headers=kept)

    def _named(self, name: object) -> Path | None:
        """A file of the folder, however a request names it."""
        if not isinstance(name, str) or not _NAME.fullmatch(name):
            return None
        file = self._folder / name
        return file if file.is_file() and not file.is_symlink() else None

    # -- the process

    async def _watch(self, running: _Running) -> None:
        """End it at its size; say why it ended by itself."""
        assert running.process.stderr is not None
        said = asyncio.create_task(_last_line(running.process.stderr))
        while running.process.returncode is None:
            with contextlib.suppress(asyncio.TimeoutError):
                await asyncio.wait_for(asyncio.shield(running.process.wait()), _LOOK_S)
            if _size(running.file) >= self._config.web.recording_bytes and running.process.returncode is None:
                self._error = f"{running.file.name}: ended at web.recording_bytes, {_size(running.file)} bytes"
                await _ended(running.process)
        line = await said
        if self._running is running:
            self._running = None
        if running.process.returncode not in (0, -signal.SIGINT, 130) and not self._error:
            self._error = f"the recording ended by itself: {line or running.process.returncode}"
            log.warning("%s", self._error)

    async def _end(self) -> None:
        running, watching = self._running, self._watching
        if running is None or watching is None:
            return
        await _ended(running.process)
        await watching


async def _ended(process: Process) -> None:
    """By an orderly end, else at once."""
    if process.returncode is not None:
        return
    with contextlib.suppress(ProcessLookupError):
        process.send_signal(signal.SIGINT)
    try:
        await asyncio.wait_for(asyncio.shield(process.wait()), _END_S)
    except asyncio.TimeoutError:
        with contextlib.suppress(ProcessLookupError):
            process.kill()
        await process.wait()


async def _last_line(stream: asyncio.StreamReader) -> str:
    """What it said last before its end; all of it is read, so that it is never held up."""
    last = ""
    with contextlib.suppress(ValueError):
        while line := await stream.readline():
            last = line.decode("utf-8", "replace").strip() or last
    return one_line(last, 300)


def _size(path: Path) -> int:
    try:
        return path.stat().st_size
    except OSError:
        return 0


def _slug(name: str) -> str:
    return re.sub(r"[^A-Za-z0-9_-]", "-", name)[:40] or "robot"
