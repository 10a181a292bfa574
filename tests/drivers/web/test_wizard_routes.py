"""Commissioning and recordings as requests: what is refused, who may ask, and a process that ends and comes back."""

from __future__ import annotations

import json
import os
import signal
from pathlib import Path
from typing import Any

import pytest
from patience import until
from web_parts import Client, config_for, served
from websockets.sync.client import connect
from zenoh_world import free_port

TOKEN = "a token of the owner"
COMMANDS = ("look", "start", "enough", "stop", "drop", "undo", "clicks", "practice", "apply", "report", "tune")
PATHS = [f"/wizard/{name}" for name in (*COMMANDS, "save_camera")]
PATHS += [f"/recording/{name}" for name in ("start", "stop", "delete")]


def workers() -> list[int]:
    """Wizards that this process has started."""
    found = []
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            words = (folder / "cmdline").read_bytes().split(b"\0")
            parent = (folder / "stat").read_text().rpartition(")")[2].split()[1]
        except OSError:
            continue
        if b"ceilvo.calib.wizard" in words and int(parent) == os.getpid():
            found.append(int(folder.name))
    return found


@pytest.mark.parametrize(
    ("path", "body", "status"),
    [
        ("/wizard/nonsense", b"{}", 404),
        ("/wizard/start", b"{}", 400),
        ("/wizard/start", b'{"step": "intrinsics", "mode": "fast"}', 400),
        ("/wizard/start", b'{"step": "intrinsics", "answers": {"columns": [9]}}', 400),
        ("/wizard/start", b'{"step": "intrinsics", "answers": {"columns": 1e999}}', 400),
        ("/wizard/start", b'{"step": 7}', 400),
        ("/wizard/drop", b'{"part": "intrinsics", "index": -1}', 400),
        ("/wizard/drop", b'{"part": "intrinsics", "index": true}', 400),
        ("/wizard/clicks", b'{"uv": []}', 400),
        ("/wizard/clicks", b'{"uv": [[1, "2"]]}', 400),
        ("/wizard/practice", b'{"on": 1}', 400),
        ("/wizard/tune", b'{"gain": 1}', 400),
        ("/wizard/tune", b'{"gain": "1", "exposure_us": null}', 400),
        ("/wizard/save_camera", b"{}", 400),
        ("/wizard/start", b"[]", 400),
        ("/wizard/start", b"{" * 5000, 413),
        ("/recording/stop", b"{}", 409),
        ("/recording/delete", b'{"name": "../config.yaml"}', 404),
        ("/recording/delete", b'{"name": "x.mcap"}', 404),
        ("/recording/delete", b'{"name": ["x.mcap"]}', 404),
    ],
)
def test_wrong_requests_start_nothing(path: str, body: bytes, status: int, tmp_path: Path) -> None:
    with served(config_for(free_port(), state_dir=str(tmp_path))) as address:
        answer = Client(address).post(path, body)
        assert answer.status == status and b"Traceback" not in answer.body
        assert workers() == [] and list(tmp_path.iterdir()) == []


def test_read_only_and_strangers_start_nothing(tmp_path: Path) -> None:
    token = tmp_path / "token"
    token.write_text(TOKEN)
    token.chmod(0o600)
    state = str(tmp_path / "state")
    with served(config_for(free_port(), read_only=True, state_dir=state)) as address:
        assert {Client(address).post(path, b"{}").status for path in PATHS} == {403}
    with served(config_for(free_port(), token_file=str(token), state_dir=state)) as address:
        client = Client(address)
        assert {client.post(path, b"{}").status for path in PATHS} == {401}
        for path in ("/commission", "/camera"):
            assert client.get(path).headers["Location"] == "/login"
        for path in ("/wizard", "/wizard/file/report.html", "/recording/file/x.mcap", "/pages/wizard.js"):
            assert client.get(path).status == 401
        bearer = {"Authorization": f"Bearer {TOKEN}"}
        foreign = bearer | {"Origin": "https://evil.example"}
        assert {client.post(path, b"{}", foreign).status for path in PATHS} == {403}
        assert {client.post(p, b"{}", bearer | {"Content-Type": "text/plain"}).status for p in PATHS} == {415}
        for path in ("/wizard/file/../../token", "/wizard/file/answers.json", "/recording/file/..%2ftoken"):
            assert client.get(path, bearer).status == 404
    assert workers() == [] and not (tmp_path / "state").exists()


def heard(ws: Any, topic: str) -> dict[str, Any]:
    while True:
        text = ws.recv(timeout=60.0)
        if isinstance(text, str) and (message := json.loads(text))["topic"] == topic:
            found = message["data"]
            assert isinstance(found, dict)
            return found


def test_a_process_that_is_killed_is_said_and_another_goes_on(tmp_path: Path) -> None:
    config = config_for(free_port(), state_dir=str(tmp_path))
    with served(config, simulate=True) as address, connect(f"{address.replace('http', 'ws', 1)}/wizard") as ws:
        state = heard(ws, "state")
        assert state["folder"] == str(tmp_path / "practice") and state["busy"] is None
        [worker] = workers()
        client = Client(address)
        assert client.post("/wizard/start", b'{"step": "projection"}').status == 200
        assert "intrinsics" in heard_error(ws), "the lens comes first"
        os.kill(worker, signal.SIGKILL)
        assert "kept" in heard(ws, "lost")["text"]
        assert client.post("/wizard/practice", b'{"on": true}').status == 200
        assert heard(ws, "state")["practice"] is True
        assert workers() != [worker]
    until(lambda: workers() == [], "no process is left behind")


def heard_error(ws: Any) -> str:
    while not (error := str(heard(ws, "state")["error"])):
        pass
    return error
