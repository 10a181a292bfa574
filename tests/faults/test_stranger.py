"""From another network namespace nobody reaches a daemon with the default configuration, whatever it sends."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
import stranger
from kept_maps import load_database

from ceilvo.daemon.app.command_log import NAME as COMMANDS
from ceilvo.daemon.map.kept.store import MAP_NAME

SECONDS = float(os.environ.get("CEILVO_ATTACK_S", "6"))
BARE = """
import json, sys, time, zenoh
conf = zenoh.Config()
for key, value in json.loads(sys.argv[1]).items():
    conf.insert_json5(key, json.dumps(value))
with zenoh.open(conf) as session:
    if len(sys.argv) > 2:
        with session.declare_subscriber(sys.argv[2]) as s:
            print(s.recv().payload.to_string(), flush=True)
    else:
        print("open", flush=True)
        time.sleep(60.0)
"""
ON_LO = {"listen/endpoints": ["tcp/127.0.0.1:0"], "scouting/multicast/interface": "lo"}
pytestmark = pytest.mark.skipif(bool(stranger.why_not()), reason=stranger.why_not() or "-")


@pytest.fixture(scope="module")
def worlds() -> Iterator[stranger.Worlds]:
    with stranger.worlds() as made:
        yield made


def started(worlds: stranger.Worlds, folder: Path, *args: str) -> subprocess.Popen[str]:
    command = worlds.command(worlds.robot, sys.executable, *args)
    return subprocess.Popen(command, cwd=folder, text=True, stdout=subprocess.PIPE, stderr=subprocess.STDOUT)


def read_until(process: subprocess.Popen[str], word: str) -> None:
    assert process.stdout is not None
    for line in process.stdout:
        if word in line:
            return
    raise AssertionError(f"it ended without saying {word}")


def test_the_attack_works_on_a_session_that_is_not_protected(worlds: stranger.Worlds, tmp_path: Path) -> None:
    """Else the test below could not fail."""
    victim = started(worlds, tmp_path, "-c", BARE, json.dumps(ON_LO))
    try:
        read_until(victim, "open")
        assert worlds.attack(3.0)[0] > 0
    finally:
        victim.kill()
        victim.communicate()


def test_a_default_daemon_comes_to_nobody_and_answers_nobody(worlds: stranger.Worlds, tmp_path: Path) -> None:
    kept = f"service.state_dir={tmp_path}"
    daemon = started(worlds, tmp_path, "-m", "ceilvo.daemon.cli", "run", "--simulate", "--set", kept)
    try:
        read_until(daemon, "TRACKING")
        assert worlds.attack(SECONDS) == (0, 0)
        local = subprocess.run(
            worlds.command(worlds.robot, sys.executable, "-c", BARE, json.dumps(ON_LO), "ceilvo/*/pose"),
            text=True,
            capture_output=True,
            timeout=30.0,
            check=True,
        )
        assert json.loads(local.stdout)["state"] == "TRACKING", "a neighbour process finds it still"
    finally:
        daemon.terminate()
        daemon.communicate()
    assert not (tmp_path / COMMANDS).exists(), "nobody told it anything"
    stored = load_database(tmp_path / MAP_NAME)
    assert stored is not None and len(stored.landmarks), "the map is as it learnt it"
