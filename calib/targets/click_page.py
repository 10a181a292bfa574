"""A page for clicking marks in a picture: the robot has no screen, the engineer's laptop has a browser."""

from __future__ import annotations

import base64
import json
import sys
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import cv2
import numpy as np
from numpy.typing import NDArray

from ceilvo.errors import CalibrationError

Array = NDArray[np.float64]
Gray = NDArray[np.uint8]

_MOST_BYTES = 1_000_000
"""Of a request: far more than clicks need, far less than memory."""
_PORT_MAX = 0xFFFF
_POLL_S = 0.2
"""How soon Ctrl-C is noticed."""
_PAGE = """<!doctype html><meta charset="utf-8"><title>ceilvo: marks</title>
<style>body{font:16px sans-serif;background:#222;color:#eee}canvas{cursor:crosshair}</style>
<p id="ask"></p><p><button id="undo">undo</button></p><canvas id="c"></canvas>
<script>
const names = NAMES, zoom = 2, uv = [], image = new Image(), c = document.getElementById("c");
const ask = document.getElementById("ask"), g = c.getContext("2d");
function draw() {
  g.drawImage(image, 0, 0, c.width, c.height);
  g.strokeStyle = "#4f4"; g.fillStyle = "#4f4";
  uv.forEach(([u, v], i) => {
    const x = (u + 0.5) * zoom, y = (v + 0.5) * zoom;
    g.beginPath(); g.moveTo(x - 9, y); g.lineTo(x + 9, y); g.moveTo(x, y - 9); g.lineTo(x, y + 9); g.stroke();
    g.fillText(String(i + 1), x + 6, y - 6);
  });
  ask.textContent = uv.length < names.length ? "click " + names[uv.length] : "sent; go on in the terminal";
}
image.onload = () => { c.width = image.width * zoom; c.height = image.height * zoom; draw(); };
image.src = "data:image/png;base64,PICTURE";
document.getElementById("undo").onclick = () => { uv.pop(); draw(); };
c.onclick = e => {
  if (uv.length >= names.length) return;
  uv.push([e.offsetX / zoom - 0.5, e.offsetY / zoom - 0.5]); draw();
  if (uv.length === names.length) fetch("/", {method: "POST", body: JSON.stringify(uv)});
};
</script>"""


class ClickPage:
    """Serves one picture until all marks are clicked.

    Args:
        listen: host:port; port 0 takes a free one. Only this computer can reach the default.
    """

    def __init__(self, listen: str = "127.0.0.1:0") -> None:
        host, _, port = listen.rpartition(":")
        if not host or not port.isdigit() or int(port) > _PORT_MAX:
            raise CalibrationError(f"--listen: found {listen!r}, expected HOST:PORT, for example 0.0.0.0:8080")
        self._address = (host, int(port))

    def __call__(self, gray: Gray, names: list[str]) -> Array:
        """(N, 2) pixels, in the order of names. Ctrl-C ends the waiting."""
        page = _PAGE.replace("NAMES", json.dumps(names).replace("<", "\\u003c"))
        page = page.replace("PICTURE", base64.b64encode(cv2.imencode(".png", gray)[1].tobytes()).decode())
        got: list[Array] = []
        done = threading.Event()

        class Handler(BaseHTTPRequestHandler):
            def do_GET(self) -> None:
                self._answer(200, page.encode(), "text/html; charset=utf-8")

            def do_POST(self) -> None:
                size = int(self.headers.get("Content-Length") or 0)
                try:
                    uv = np.array(json.loads(self.rfile.read(min(size, _MOST_BYTES))), np.float64)
                except (ValueError, TypeError):
                    uv = np.zeros(0)
                if uv.shape != (len(names), 2) or not np.isfinite(uv).all():
                    self._answer(400, b"expected a list of [u, v]", "text/plain")
                    return
                got.append(uv)
                self._answer(204, b"", "text/plain")
                done.set()

            def _answer(self, code: int, body: bytes, kind: str) -> None:
                self.send_response(code)
                self.send_header("Content-Type", kind)
                self.send_header("Content-Length", str(len(body)))
                self.end_headers()
                self.wfile.write(body)

            def log_message(self, *_: object) -> None:
                """Nothing: the terminal is for the engineer."""

        try:
            server = ThreadingHTTPServer(self._address, Handler)
        except OSError as e:
            raise CalibrationError(
                f"--listen: {self._address[0]}:{self._address[1]} cannot be used ({e.strerror}); choose another port"
            ) from None
        thread = threading.Thread(target=server.serve_forever, name="click page", daemon=True)
        thread.start()
        try:
            print(f"marks: open http://{self._address[0]}:{server.server_port}/ and click {len(names)} marks",
                  file=sys.stderr, flush=True)  # fmt: skip
            while not done.wait(_POLL_S):
                pass
        finally:
            server.shutdown()
            server.server_close()
        return got[0]
