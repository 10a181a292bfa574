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
_PAGE = """<!doctype html><html lang="en"><meta charset="utf-8"><title>ceilvo: marks</title>
<meta name="viewport" content="width=device-width">
<style>body{font:16px/1.4 sans-serif;background:#222;color:#eee;margin:.5rem}button{font:inherit;padding:.3rem .8rem}
canvas{cursor:crosshair;touch-action:none;display:block;max-width:100%;margin-top:.5rem}</style>
<p id="ask" role="status"></p>
<p><button id="undo">undo (U)</button> <button id="fit">whole picture (0)</button>
<button id="send" disabled>send (Enter)</button>
<span>wheel or + - zooms, drag moves, click marks</span></p><canvas id="c" tabindex="0"></canvas>
<script>
const names = NAMES, truth = TRUTH, uv = [], image = new Image(), c = document.getElementById("c");
const ask = document.getElementById("ask"), g = c.getContext("2d"), send = document.getElementById("send");
let zoom = 1, ox = 0, oy = 0, done = false, down = null, moved = false;  // canvas = (pixel + 0.5 - o) * zoom
const toCanvas = (u, v) => [(u + 0.5 - ox) * zoom, (v + 0.5 - oy) * zoom];
const toPixel = (x, y) => [x / zoom + ox - 0.5, y / zoom + oy - 0.5];
function cross(u, v, text, colour) {
  const [x, y] = toCanvas(u, v);
  g.strokeStyle = g.fillStyle = colour; g.lineWidth = 1;
  g.beginPath(); g.moveTo(x - 9, y); g.lineTo(x + 9, y); g.moveTo(x, y - 9); g.lineTo(x, y + 9); g.stroke();
  g.fillText(text, x + 6, y - 6);
}
function axes() {
  const step = [1, 2, 5, 10, 20, 50, 100, 200, 500, 1000].find(s => s * zoom >= 60) || 1000;
  g.fillStyle = "#000a"; g.fillRect(0, 0, c.width, 18); g.fillRect(0, 18, 44, c.height);
  g.fillStyle = g.strokeStyle = "#9cf"; g.font = "12px sans-serif"; g.lineWidth = 1;
  for (let u = Math.ceil(ox / step) * step; (u - ox) * zoom < c.width; u += step) {
    const x = (u + 0.5 - ox) * zoom; if (x < 44) continue; g.fillRect(x, 0, 1, 6); g.fillText("u " + u, x + 2, 14);
  }
  for (let v = Math.ceil(oy / step) * step; (v - oy) * zoom < c.height; v += step) {
    const y = (v + 0.5 - oy) * zoom; if (y < 18) continue; g.fillRect(0, y, 6, 1); g.fillText("v " + v, 2, y + 12);
  }
}
function draw() {
  g.setTransform(1, 0, 0, 1, 0, 0); g.imageSmoothingEnabled = zoom < 4;
  g.fillStyle = "#000"; g.fillRect(0, 0, c.width, c.height);
  g.drawImage(image, -ox * zoom, -oy * zoom, image.width * zoom, image.height * zoom);
  axes();
  g.font = "14px sans-serif";
  uv.forEach(([u, v], i) => cross(u, v, String(i + 1), "#fd4"));
  const all = uv.length === names.length;
  send.disabled = !all || done;
  if (done && truth) truth.forEach(([u, v], i) => cross(u, v, "true " + (i + 1), "#4cf"));
  if (!done) ask.textContent = all ? "all marked: look once more, undo or send"
    : "click " + names[uv.length] + " (" + (uv.length + 1) + " of " + names.length + ")";
}
function fit() { zoom = c.width / image.width; ox = oy = 0; draw(); }
function zoomAt(x, y, factor) {
  const [u, v] = toPixel(x, y);
  zoom = Math.min(40, Math.max(0.2, zoom * factor)); ox = u + 0.5 - x / zoom; oy = v + 0.5 - y / zoom; draw();
}
const place = e => { const r = c.getBoundingClientRect();
  return [(e.clientX - r.left) * c.width / r.width, (e.clientY - r.top) * c.height / r.height]; };
image.onload = () => { c.width = Math.min(1600, Math.max(image.width, 960));
  c.height = Math.round(c.width * image.height / image.width); fit(); };
image.src = "data:image/png;base64,PICTURE";
function undo() { if (!done) { uv.pop(); draw(); } }
function post() {
  if (send.disabled) return;
  fetch("/", {method: "POST", body: JSON.stringify(uv)}).then(r => {
    if (!r.ok) { ask.textContent = "refused: " + r.status; return; }
    done = true; draw();
    const off = truth ? truth.map(([u, v], i) => Math.hypot(u - uv[i][0], v - uv[i][1])) : [];
    ask.textContent = "sent; go on in the terminal" +
      (truth ? "; off by " + off.map(d => d.toFixed(1)).join(", ") + " px" : "");
  }).catch(() => { ask.textContent = "not sent: the terminal's program has ended"; });
}
document.getElementById("undo").onclick = undo;
document.getElementById("fit").onclick = fit;
send.onclick = post;
c.onwheel = e => { e.preventDefault(); zoomAt(...place(e), e.deltaY < 0 ? 1.25 : 0.8); };
c.onpointerdown = e => { down = [...place(e), ox, oy]; moved = false; c.setPointerCapture(e.pointerId); };
c.onpointermove = e => {
  if (!down) return;
  const [x, y] = place(e);
  if (!moved && Math.hypot(x - down[0], y - down[1]) < 4) return;
  moved = true; ox = down[2] - (x - down[0]) / zoom; oy = down[3] - (y - down[1]) / zoom; draw();
};
c.onpointerup = e => {
  if (down && !moved && !done && uv.length < names.length) { uv.push(toPixel(...place(e))); draw(); }
  down = null;
};
document.onkeydown = e => {
  if (e.key === "u" || e.key === "U") undo();
  else if (e.key === "0") fit();
  else if (e.key === "Enter" && e.target.tagName !== "BUTTON") post();
  else if (e.key === "+" || e.key === "-") zoomAt(c.width / 2, c.height / 2, e.key === "+" ? 1.25 : 0.8);
};
</script></html>"""


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

    def __call__(self, gray: Gray, names: list[str], true_px: Array | None = None) -> Array:
        """(N, 2) pixels, in the order of names. Ctrl-C ends the waiting.

        Args:
            true_px: (N, 2) where the marks are, for practice: shown once they have been clicked and sent.
        """
        page = _PAGE.replace("NAMES", json.dumps(names).replace("<", "\\u003c"))
        page = page.replace("TRUTH", "null" if true_px is None else json.dumps(true_px.tolist()))
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
