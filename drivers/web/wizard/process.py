"""The wizard's process: started when a page needs it, ended when nobody has looked for a while."""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
import os
import struct
import sys
from asyncio.subprocess import PIPE, Process
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ceilvo.config import Config
from ceilvo.config.rendering import render_config

log = logging.getLogger(__name__)

Message = str | bytes
"""A line of JSON; a picture."""
_HEAD = struct.Struct(">cI")
_MOST_BYTES = 1 << 25
"""Of a message of the process: the picture to click in of the largest camera."""
_IDLE_S = 120.0
"""After the last page has closed a process without work is ended; its state is on disk. Chosen."""
_STOP_S = 2.0
"""That a step may take to stop between two pictures; one that computes does not listen, and is ended."""
_LOST = "the wizard's process ended ({code}); what was taken is kept: do the step again to go on"


@dataclass(frozen=True)
class Place:
    """What the process is told at its start.

    Attributes:
        config_file: that the configuration came from, None = the defaults.
        folder: that sessions are kept in.
        simulate: the robot is the simulated one.
    """

    config: Config
    config_file: Path | None
    folder: Path
    simulate: bool = False


class WizardProcess:
    """For one event loop."""

    def __init__(self, place: Place) -> None:
        self._place = place
        self._process: Process | None = None
        self._reader: asyncio.Task[None] | None = None
        self._told: dict[str, tuple[int, Message]] = {}
        self._number = 0
        self._busy = self._tuning = False
        self._pages = 0
        self._ending: asyncio.TimerHandle | None = None
        self.session: Path | None = None

    def arrive(self) -> None:
        """A page is open."""
        self._pages += 1
        if self._ending is not None:
            self._ending.cancel()
            self._ending = None

    def leave(self) -> None:
        """A page is closed: the camera's settings are of no use without one, a step goes on."""
        self._pages -= 1
        if self._pages == 0:
            if self._tuning:
                self._write({"do": "stop"})
            self._end_later()

    def _end_later(self) -> None:
        self._ending = asyncio.get_running_loop().call_later(_IDLE_S, self._end_if_idle)

    def _end_if_idle(self) -> None:
        self._ending = None
        if self._pages:
            return
        if self._busy:
            self._end_later()
        elif self._process is not None and self._process.stdin is not None:
            self._process.stdin.close()

    def works(self) -> bool:
        """Whether a step goes on."""
        return self._busy

    async def ready(self) -> None:
        """Start the process where there is none."""
        if self._process is not None and self._process.returncode is None:
            return
        env = {"OPENBLAS_NUM_THREADS": "1"} | dict(os.environ)
        words = (sys.executable, "-m", "ceilvo.calib.wizard")
        self._process = await asyncio.create_subprocess_exec(*words, stdin=PIPE, stdout=PIPE, env=env)
        self._told.clear()
        place = self._place
        self._write(
            {
                "config": render_config(place.config),
                "config_file": "" if place.config_file is None else str(place.config_file),
                "folder": str(place.folder),
                "simulate": place.simulate,
            }
        )
        self._reader = asyncio.create_task(self._read(self._process))

    async def do(self, command: Mapping[str, Any]) -> None:
        """Pass a command on; a stop that is not heard ends the process, and another one takes over."""
        await self.ready()
        self._write(command)
        if command.get("do") == "stop" and self.works():
            for _ in range(round(10 * _STOP_S)):
                await asyncio.sleep(0.1)
                if not self.works():
                    return
            await self.end()
            await self.ready()

    def news(self, seen: dict[str, int]) -> list[Message]:
        """What a page has not seen yet, the newest of each kind; `seen` is the page's and brought up to date."""
        new = [(n, name, m) for name, (n, m) in self._told.items() if seen.get(name, -1) != n]
        for n, name, _ in new:
            seen[name] = n
        return [m for _, _, m in sorted(new, key=lambda row: row[0])]

    async def end(self) -> None:
        """Idempotent."""
        process, self._process = self._process, None
        if process is not None and process.returncode is None:
            with contextlib.suppress(ProcessLookupError):
                process.kill()
            await process.wait()
        if self._reader is not None:
            self._reader.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await self._reader
        self._busy = False

    def _write(self, command: Mapping[str, Any]) -> None:
        if self._process is not None and self._process.stdin is not None and not self._process.stdin.is_closing():
            self._process.stdin.write(json.dumps(command).encode() + b"\n")

    async def _read(self, process: Process) -> None:
        assert process.stdout is not None
        with contextlib.suppress(asyncio.IncompleteReadError):
            while True:
                kind, length = _HEAD.unpack(await process.stdout.readexactly(_HEAD.size))
                if length > _MOST_BYTES:
                    break
                self._take(kind, await process.stdout.readexactly(length))
        code = await process.wait()
        if code != 0 and process is self._process:
            log.warning(_LOST.format(code=code))
            self._tell("lost", json.dumps({"topic": "lost", "data": {"text": _LOST.format(code=code)}}))
        self._busy = self._tuning = False

    def _take(self, kind: bytes, payload: bytes) -> None:
        if kind != b"J":
            self._tell(f"picture {kind.decode('latin-1')}", payload)
            return
        text = payload.decode("utf-8")
        message = json.loads(text)
        topic, data = str(message["topic"]), message["data"]
        if topic == "state":
            self._busy = bool(data["busy"])
            self.session = Path(str(data["folder"]))
            if not self._busy:
                for name in ("look", "computing", "click", "picture C"):
                    self._told.pop(name, None)
        elif topic == "tuning":
            self._tuning = bool(data["on"])
        elif topic == "clicked":
            for name in ("click", "picture C"):
                self._told.pop(name, None)
        elif topic == "look":
            self._told.pop("computing", None)
        self._tell(" ".join([topic, *(str(data[k]) for k in ("step", "part") if topic != "look" and k in data)]), text)

    def _tell(self, name: str, message: Message) -> None:
        self._number += 1
        self._told[name] = self._number, message
