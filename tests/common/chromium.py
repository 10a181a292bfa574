"""A headless Chromium that is driven over its DevTools protocol, and what went wrong in it."""

from __future__ import annotations

import base64
import json
import shutil
import subprocess
import threading
import urllib.request
from collections.abc import Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from patience import PATIENCE_S, until
from websockets.sync.client import connect

PROGRAM = next((p for name in ("chromium", "chromium-browser", "google-chrome") if (p := shutil.which(name))), None)
_MOST_BYTES = 1 << 26
"""Of a message: pictures of a long page."""


class Page:
    """One tab. What it asked the network for and what it complained of is kept."""

    def __init__(self, address: str) -> None:
        self._held = ExitStack()
        self._ws = self._held.enter_context(connect(address, max_size=_MOST_BYTES, compression=None))
        self._answers: dict[int, Mapping[str, Any]] = {}
        self._number = 0
        self.asked: list[str] = []
        self.complaints: list[str] = []
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()
        for domain in ("Page", "Runtime", "Network", "Log"):
            self.do(f"{domain}.enable")

    def _read(self) -> None:
        for text in self._ws:
            message = json.loads(text)
            if "id" in message:
                self._answers[message["id"]] = message
                continue
            method, said = message["method"], message["params"]
            if method == "Network.requestWillBeSent":
                self.asked.append(said["request"]["url"])
            elif method == "Network.webSocketCreated":
                self.asked.append(said["url"])
            elif method == "Runtime.exceptionThrown":
                self.complaints.append(json.dumps(said["exceptionDetails"])[:500])
            elif method == "Runtime.consoleAPICalled" and said["type"] in ("error", "warning", "assert"):
                self.complaints.append(json.dumps(said["args"])[:500])
            elif method == "Log.entryAdded" and said["entry"]["level"] in ("error", "warning"):
                self.complaints.append(json.dumps(said["entry"])[:500])

    def do(self, method: str, **parameters: object) -> Mapping[str, Any]:
        self._number += 1
        number = self._number
        self._ws.send(json.dumps({"id": number, "method": method, "params": parameters}))
        until(lambda: number in self._answers, method)
        answer = self._answers.pop(number)
        assert "error" not in answer, (method, answer["error"])
        result: Mapping[str, Any] = answer["result"]
        return result

    def value(self, script: str) -> Any:
        """Of an expression; promises are waited for."""
        got = self.do("Runtime.evaluate", expression=script, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in got, (script, got["exceptionDetails"])
        return got["result"].get("value")

    def until(self, script: str) -> None:
        until(lambda: self.value(script), script)

    def text(self, selector: str) -> str:
        return str(self.value(f"document.querySelector({json.dumps(selector)}).innerText"))

    def size(self, width_px: int, height_px: int, dark: bool = False, touch: bool = False) -> None:
        self.do(
            "Emulation.setDeviceMetricsOverride", width=width_px, height=height_px, deviceScaleFactor=1, mobile=touch
        )
        self.do("Emulation.setScrollbarsHidden", hidden=True)
        scheme = {"name": "prefers-color-scheme", "value": "dark" if dark else "light"}
        self.do("Emulation.setEmulatedMedia", features=[scheme])

    def go(self, address: str) -> None:
        self.do("Page.navigate", url=address)
        self.until("document.readyState === 'complete' && location.protocol !== 'about:'")

    def click(self, selector: str) -> None:
        self.value(f"document.querySelector({json.dumps(selector)}).click()")

    def key(self, name: str) -> None:
        text = {"text": name} if len(name) == 1 else {}
        for kind in ("keyDown", "keyUp"):
            self.do("Input.dispatchKeyEvent", type=kind, key=name, **(text if kind == "keyDown" else {}))

    def drag(self, start: tuple[float, float], end: tuple[float, float]) -> None:
        """With the mouse, in pixels of the window, in ten steps."""
        self._mouse("mousePressed", start)
        for i in range(1, 11):
            x, y = (a + (b - a) * i / 10 for a, b in zip(start, end, strict=True))
            self._mouse("mouseMoved", (x, y))
        self._mouse("mouseReleased", end)

    def _mouse(self, kind: str, at: tuple[float, float]) -> None:
        self.do("Input.dispatchMouseEvent", type=kind, x=at[0], y=at[1], button="left", buttons=1, clickCount=1)

    def picture(self, file: Path, whole: bool = True) -> None:
        """As PNG: the whole page, or what the window shows."""
        file.parent.mkdir(parents=True, exist_ok=True)
        shot = self.do("Page.captureScreenshot", format="png", captureBeyondViewport=whole)
        file.write_bytes(base64.b64decode(shot["data"]))

    def close(self) -> None:
        self._held.close()
        self._reader.join(PATIENCE_S)


class Chromium:
    """Use as a context manager."""

    def __init__(self, folder: Path) -> None:
        assert PROGRAM is not None
        self._told = folder / "DevToolsActivePort"
        self._log = (folder / "chromium.log").open("wb")
        options = ("--headless=new", "--no-sandbox", "--disable-gpu", "--no-first-run", "--disable-dev-shm-usage")
        quiet = ("--disable-background-networking", "--disable-component-update", "--disable-sync")
        more = ("--remote-debugging-port=0", f"--user-data-dir={folder}", "about:blank")
        self._process = subprocess.Popen([PROGRAM, *options, *quiet, *more], stdout=self._log, stderr=self._log)
        self._pages: list[Page] = []

    def __enter__(self) -> Chromium:
        until(lambda: self._told.exists() and len(self._told.read_text().splitlines()) > 1, "Chromium has started")
        return self

    def __exit__(self, *_: object) -> None:
        for page in self._pages:
            page.close()
        self._process.terminate()
        self._process.wait(PATIENCE_S)
        self._log.close()

    def page(self) -> Page:
        port = self._told.read_text().splitlines()[0]
        ask = urllib.request.Request(f"http://127.0.0.1:{port}/json/new?about:blank", method="PUT")
        with urllib.request.urlopen(ask, timeout=PATIENCE_S) as answer:
            page = Page(json.load(answer)["webSocketDebuggerUrl"])
        self._pages.append(page)
        return page
