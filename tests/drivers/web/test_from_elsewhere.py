"""The pages' server from another computer: a second network namespace, with TLS and without the token."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest
from patience import PATIENCE_S
from stranger import ROBOT, Worlds, why_not, worlds
from zenoh_world import free_port

ASKING = """
import http.client, json, ssl, sys
host, port, ca, token = sys.argv[1:]
def ask(method, path, body=None, headers={}):
    if ca:
        c = http.client.HTTPSConnection(host, int(port), timeout=30, context=ssl.create_default_context(cafile=ca))
    else:
        c = http.client.HTTPConnection(host, int(port), timeout=30)
    try:
        c.request(method, path, body, {"Content-Type": "application/json", **headers})
        return c.getresponse().status
    except OSError as e:
        return type(e).__name__
bearer = {"Authorization": f"Bearer {token}"} if token else {}
paths = ["/", "/live", "/pages/live.js", "/pages/map.js", "/cmd/save_map", "/x"]
print(json.dumps([ask("GET", p, headers=bearer) for p in paths]
                 + [ask("POST", f"/cmd/{n}", b"{}", bearer) for n in ("save_map", "relocalise", "initial_pose")]))
"""


def asked(at: Worlds, port: int, ca: str, token: str) -> list[object]:
    command = at.command(at.stranger, sys.executable, "-c", ASKING, ROBOT, str(port), ca, token)
    done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=PATIENCE_S)
    found = json.loads(done.stdout)
    assert isinstance(found, list)
    return found


def certificate(folder: Path) -> None:
    for name in ("token", "tls.key"):
        (folder / name).touch(0o600)
    (folder / "token").write_text("a token of the owner")
    command = ["openssl", "req", "-x509", "-newkey", "rsa:2048", "-nodes", "-days", "2", "-subj", "/CN=robot1"]
    names = ["-addext", f"subjectAltName=IP:{ROBOT}", "-keyout", folder / "tls.key", "-out", folder / "tls.pem"]
    subprocess.run([*command, *names], check=True, capture_output=True)


@pytest.mark.skipif(bool(why_not()), reason=why_not())
def test_from_another_address_nothing_is_readable_or_changeable_without_the_token(tmp_path: Path) -> None:
    certificate(tmp_path)
    port, files = free_port(), {"token_file": "token", "certificate_file": "tls.pem", "key_file": "tls.key"}
    beyond = [f"web.{key}={tmp_path / name}" for key, name in files.items()]
    with worlds() as at:
        settings = ["zenoh.multicast=false", f"web.port={port}"]
        for more, inside in (([f"web.host={ROBOT}", *beyond], False), ([], True)):
            words = [w for s in (*settings, *more) for w in ("--set", s)]
            command = at.command(at.robot, sys.executable, "-m", "ceilvo.daemon.cli", "web", *words)
            with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as server:
                assert server.stdout is not None and server.stderr is not None
                assert "robot1 on http" in server.stdout.readline(), server.stderr.read()
                if inside:
                    assert asked(at, port, "", "") == ["ConnectionRefusedError"] * 9
                else:
                    ca = str(tmp_path / "tls.pem")
                    assert asked(at, port, ca, "") == [303, *[401] * 8]
                    assert asked(at, port, ca, "a token of another") == [303, *[401] * 8]
                    assert asked(at, port, ca, "a token of the owner") == [200, 400, 200, 200, 405, 404, 504, 504, 400]
                server.terminate()
                assert server.wait(PATIENCE_S) == 0, server.stderr.read()
