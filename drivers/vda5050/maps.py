"""VDA 5050's actions of maps: done one after another in a thread, because a download takes its time."""

from __future__ import annotations

import logging
import queue
import threading
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

from ceilvo.drivers.vda5050.messages import Action
from ceilvo.errors import CeilvoError, one_line

log = logging.getLogger(__name__)

DOWNLOAD, ENABLE, DELETE = "downloadMap", "enableMap", "deleteMap"
KINDS = (DOWNLOAD, ENABLE, DELETE)
RUNNING, FINISHED, FAILED = "RUNNING", "FINISHED", "FAILED"
_WAITING = 20
"""Actions that wait for the one that is done; chosen."""


@dataclass(frozen=True)
class KnownMap:
    """
    Attributes:
        enabled: the daemon has it loaded.
        floor: what poses and commands of the daemon call it then; "" where it has only one.
    """

    id: str
    version: str
    enabled: bool
    floor: str = ""


class Maps(Protocol):
    """What the robot has. A map is named by id and version; every method may raise CeilvoError, which says why."""

    def known(self) -> Sequence[KnownMap]:
        """The one in use first. Never raises."""

    def download(self, map_id: str, version: str, link: str, sha256: str) -> str:
        """What came."""

    def enable(self, map_id: str, version: str) -> str:
        """What has to happen yet; "" where it is in use."""

    def settled(self, map_id: str, version: str) -> str | None:
        """What became of enable(); None while that is open."""

    def delete(self, map_id: str, version: str) -> str: ...


@dataclass(frozen=True)
class Told:
    """An action, its status in VDA 5050's word, and what came of it."""

    action: Action
    status: str
    text: str


class MapActions:
    """add() and news() are one thread's."""

    def __init__(self, maps: Maps) -> None:
        self._maps = maps
        self._todo: queue.Queue[Action] = queue.Queue(_WAITING)
        self._news: queue.SimpleQueue[Told] = queue.SimpleQueue()
        self._open: list[Told] = []
        self._thread: threading.Thread | None = None

    def add(self, action: Action) -> Told:
        """Begin; how it stands."""
        if self._thread is None:
            self._thread = threading.Thread(target=self._run, name="maps", daemon=True)
            self._thread.start()
        try:
            self._todo.put_nowait(action)
        except queue.Full:
            return Told(action, FAILED, f"found {_WAITING} actions that wait, expected fewer; send it again later")
        return Told(action, RUNNING, "")

    def news(self) -> list[Told]:
        """Of actions, since it was last asked."""
        out: list[Told] = []
        while not self._news.empty():
            told = self._news.get()
            out.append(told)
            if told.status == RUNNING:
                self._open.append(told)
        for told in tuple(self._open):
            now = self._looked(told.action)
            if now is not None:
                self._open.remove(told)
                out.append(now)
        return out

    def _looked(self, action: Action) -> Told | None:
        try:
            text = self._maps.settled(*_named(action))
        except CeilvoError as e:
            return _logged(Told(action, FAILED, str(e)))
        return None if text is None else _logged(Told(action, FINISHED, text))

    # -- the thread

    def _run(self) -> None:
        while True:
            action = self._todo.get()
            try:
                told = self._done(action)
            except CeilvoError as e:
                told = Told(action, FAILED, str(e))
            except Exception as e:  # of one map, which must not end the others
                log.exception("%s", action.kind)
                told = Told(action, FAILED, f"{type(e).__name__}: the log says more")
            self._news.put(_logged(told))

    def _done(self, action: Action) -> Told:
        name = _named(action)
        if action.kind == DOWNLOAD:
            link, sha256 = _text(action, "mapDownloadLink"), _text(action, "mapHash", needed=False)
            if not name[1]:
                raise CeilvoError("mapVersion: found nothing, expected a text")
            return Told(action, FINISHED, self._maps.download(*name, link, sha256))
        if action.kind == DELETE:
            return Told(action, FINISHED, self._maps.delete(*name))
        to_come = self._maps.enable(*name)
        return Told(action, RUNNING, to_come) if to_come else Told(action, FINISHED, f"{name[0]} is in use")


def _named(action: Action) -> tuple[str, str]:
    return _text(action, "mapId"), _text(action, "mapVersion", needed=False)


def _text(action: Action, key: str, needed: bool = True) -> str:
    value = action.parameters.get(key, "")
    if not isinstance(value, str) or (needed and not value):
        raise CeilvoError(f"{key}: found {one_line(repr(value), 60) if value else 'nothing'}, expected a text")
    return value


def _logged(told: Told) -> Told:
    name = f"{told.action.parameters.get('mapId')} {told.action.parameters.get('mapVersion', '')}"
    log.info("%s %s: %s: %s", told.action.kind, one_line(name, 80), told.status, one_line(told.text))
    return told
