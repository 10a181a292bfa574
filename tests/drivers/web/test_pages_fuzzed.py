"""Random requests to the pages' server: every answer is one on purpose, and the server goes on."""

from __future__ import annotations

import contextlib
import json
import logging
import random
import socket
import struct
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path

import pytest
from web_parts import Client, config_for, served
from zenoh_world import free_port

REQUESTS = 1000
SEED = 17
_ANSWER_S = 7.0
"""Longer than a command waits for a daemon that is not there; only requests that do not end are given up."""
_AT_ONCE = 50
METHODS = ("GET", "POST", "HEAD", "PUT", "DELETE", "OPTIONS", "PATCH", "TRACE", "CONNECT", "get", "X\0", "")
PATHS = (
    *("/", "/login", "/logout", "/live", "/pages/live.js", "/pages/..%2f..%2fguard.py", "/pages//etc/passwd"),
    *(
        "/cmd/save_map",
        "/cmd/initial_pose",
        "/cmd/relocalise",
        "/cmd/reset",
        "/cmd/",
        "/commission",
        "/camera",
        "/wizard",
        *(f"/wizard/{name}" for name in ("start", "drop", "clicks", "undo", "apply", "tune", "save_camera", "x")),
        *("/wizard/file/report.html", "/wizard/file/..%2f..%2ftoken"),
        *("/recording/stop", "/recording/delete", "/recording/file/x.mcap", "/recording/file/%2e%2e%2ftoken"),
        "*",
        "http://h/",
        "//",
        "/%",
        "/%ff",
    ),
)
HEADERS = (
    *("Host", "Origin", "Cookie", "Authorization", "Content-Type", "Content-Length", "Transfer-Encoding", "Upgrade"),
    *("Connection", "Sec-WebSocket-Key", "Sec-WebSocket-Version", "Sec-WebSocket-Extensions", "Sec-WebSocket-Protocol"),
    *("Sec-Fetch-Site", "Expect", "Range", "Content-Encoding", "X-Forwarded-For", "If-None-Match"),
)
VALUES = (
    *("127.0.0.1", "localhost:80", "evil.example", "[::1", "application/json", "text/plain; charset=nonsense"),
    *(
        "multipart/form-data; boundary=x",
        "chunked",
        "-1",
        "0",
        "5",
        "99999999999999999999",
        "websocket",
        "Upgrade",
        "13",
    ),
    *("Upgrade", "13", "AQIDBAUGBwgJCgsMDQ4PEA==", "permessage-deflate; client_max_window_bits=99", "same-origin"),
    *("100-continue", "Bearer x", "Bearer", "ceilvo=x; ceilvo=y", '"', "gzip", "\u00e4", "\0", "a" * 9000),
)
BODIES = (
    *(b"", b"{}", b'{"token": "x"}', b'{"token": "\\ud800"}', b'{"x_m": 1, "y_m": 2, "theta_rad": 0}', b"[" * 3000),
    *(b'{"x_m": 1e999, "y_m": 0, "theta_rad": 0}', b"\xff\xfe", b"null", b"5\r\nhello\r\n0\r\n\r\n", b"x" * 6000),
    *(b'{"step": "intrinsics", "answers": {"columns": -1e308}}', b'{"part": "\\u0000", "index": 0}'),
    *(b'{"uv": [[1, 2]]}', b'{"exposure_us": 1e5, "gain": null}', b'{"name": "..%2f.mcap"}'),
)


def request(rng: random.Random) -> bytes:
    """Bytes on the wire: half of them HTTP, others nearly so, or noise, or websockets with frames."""
    kind = rng.random()
    if kind < 0.1:
        return rng.randbytes(rng.randrange(1, 400))
    if kind < 0.2:
        wish = "GET /live HTTP/1.1\r\nHost: 127.0.0.1\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
        key = "Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: AQIDBAUGBwgJCgsMDQ4PEA==\r\n\r\n"
        return (wish + key).encode() + b"".join(frame(rng) for _ in range(rng.randrange(4)))
    body = rng.choice(BODIES)
    if kind < 0.6:
        head = (
            f"{rng.choice(METHODS[:6])} {rng.choice(PATHS)} HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Length: {len(body)}"
        )
        kept = [f"{rng.choice(HEADERS[-6:])}: {rng.choice(VALUES[:6])}", "Content-Type: application/json"]
        return "\r\n".join([head, *kept[rng.randrange(2) :], "", ""]).encode() + body
    lines = [f"{rng.choice(METHODS)} {rng.choice(PATHS)} HTTP/{rng.choice(('1.1', '1.1', '1.1', '1.0', '2.0', '9'))}"]
    if rng.random() < 0.7:
        lines.append("Host: 127.0.0.1")
    if rng.random() < 0.5:
        lines += ["Content-Type: application/json", f"Content-Length: {len(body)}"]
    lines += [f"{rng.choice(HEADERS)}: {rng.choice(VALUES)}" for _ in range(rng.randrange(5))]
    out = bytearray("\r\n".join(lines).encode() + b"\r\n\r\n" + body)
    for _ in range(rng.choice((0, 0, 0, 1, 3))):
        out[rng.randrange(len(out))] = rng.randrange(256)
    return bytes(out)


def frame(rng: random.Random) -> bytes:
    """Of a websocket: any first byte, masked or not, a length that may be a lie."""
    payload = rng.choice((b'{"want": ["image"]}', b'{"want": [["image"]]}', b"[" * 200, rng.randbytes(50)))
    first = rng.choice((0x81, 0x82, 0x88, 0x89, rng.randrange(256)))
    mask = rng.randbytes(4)
    if rng.random() < 0.2:
        return bytes([first, 0xFF]) + struct.pack(">Q", rng.getrandbits(63)) + mask
    if len(payload) < 126:
        masked = bytes(b ^ mask[i % 4] for i, b in enumerate(payload))
        return bytes([first, 0x80 | len(payload)]) + mask + masked
    return bytes([first, len(payload) % 126]) + payload


def answered(port: int, sent: bytes) -> int:
    """The status of the first answer; 0 for none, as to a request that does not end."""
    with socket.create_connection(("127.0.0.1", port), timeout=_ANSWER_S) as s:
        got = b""
        with contextlib.suppress(ConnectionError, TimeoutError):
            s.sendall(sent)
            while len(got) < 12 and (more := s.recv(4096)):
                got += more
    words = got.split(b" ", 2)
    return int(words[1]) if len(words) > 1 and words[0].startswith(b"HTTP/") else 0


@pytest.mark.parametrize("with_token", [False, True], ids=["loopback", "token"])
def test_random_requests_get_no_500_and_leave_no_traceback(
    with_token: bool, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    token = tmp_path / "token"
    token.write_text("a token of the owner")
    token.chmod(0o600)
    config = config_for(free_port(), token_file=str(token) if with_token else "", state_dir=str(tmp_path / "state"))
    rng = random.Random(SEED)
    found: Counter[int] = Counter()
    with caplog.at_level(logging.INFO), served(config) as address:
        port = int(address.rpartition(":")[2])
        requests = [request(rng) for _ in range(REQUESTS)]
        with ThreadPoolExecutor(_AT_ONCE) as pool:
            statuses = list(pool.map(partial(answered, port), requests))
        for i, (sent, status) in enumerate(zip(requests, statuses, strict=True)):
            found[status] += 1
            assert status < 500 or status == 503 or (status == 504 and b"/cmd/" in sent), (SEED, i, status, sent)
        assert Client(address).get("/login").status == 200
        alive = Client(address).post("/login", json.dumps({"token": "x"}).encode())
        assert alive.status == 401
    print(f"seed {SEED}, {sorted(found.items())}")
    assert found[0] < REQUESTS / 2 and len(found) > 5
    assert [r.getMessage() for r in caplog.records if r.exc_info or r.exc_text or "Traceback" in r.getMessage()] == []
