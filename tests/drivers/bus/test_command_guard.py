"""Commands need the owner as soon as anybody else can reach the bus."""

from __future__ import annotations

import json
import os
import random
from dataclasses import replace
from pathlib import Path

import pytest
from zenoh_world import Robot, bus_config, free_port, get, peer

from ceilvo.config import Zenoh
from ceilvo.daemon.app.command_log import MOST_BYTES, NAME, CommandLog
from ceilvo.drivers.bus.command_guard import CommandGuard
from ceilvo.drivers.bus.requests import Requests
from ceilvo.drivers.bus.zenoh_bus import ZenohBus
from ceilvo.errors import BusError, ConfigError

TOKEN = b"0123456789abcdef0123456789abcdef"
SEED = 14
FOREIGN = 10_000


@pytest.fixture
def token_file(tmp_path: Path) -> Path:
    file = tmp_path / "token"
    file.write_bytes(TOKEN + b"\n")
    file.chmod(0o640)
    return file


@pytest.mark.parametrize(
    ("changes", "who"),
    [
        ({}, "this computer"),
        ({"listen": ("tcp/127.0.0.1:7447",), "connect": ("tcp/[::1]:7447",)}, "this computer"),
        ({"listen": ("tcp/0.0.0.0:7447",)}, None),
        ({"connect": ("tcp/10.0.0.9:7447",)}, None),
        ({"config_file": "/etc/ceilvo/zenoh.json5"}, "who zenoh.config_file lets in"),
    ],
)
def test_who_may_command_without_a_token(changes: dict[str, object], who: str | None) -> None:
    guard = CommandGuard.of(replace(Zenoh(), **changes))  # type: ignore[arg-type]
    if who is not None:
        assert guard.admit("reset", b"") == who
        return
    with pytest.raises(BusError, match="leave this computer, so commands need the owner"):
        guard.admit("reset", b"anything")


def test_with_a_token_nobody_commands_without_it_wherever_he_is(token_file: Path) -> None:
    for changes in ({}, {"listen": ("tcp/0.0.0.0:7447",)}, {"config_file": "/etc/x"}):
        guard = CommandGuard.of(replace(Zenoh(command_token_file=str(token_file)), **changes))  # type: ignore[arg-type]
        assert guard.admit("reset", TOKEN) == "owner, by token"
        assert guard.admit("reset", TOKEN + b"\n") == "owner, by token"
        for wrong in (b"", TOKEN[:-1], TOKEN + b"0", TOKEN.upper(), b"\0" * len(TOKEN)):
            with pytest.raises(BusError, match=r"command reset: found \w+ ?\w*, expected the owner's token"):
                guard.admit("reset", wrong)


@pytest.mark.parametrize(("content", "mode", "says"), [
    (None, 0o640, "No such file"), (b"short", 0o640, "has 5 characters, expected 16 or more"), (b"", 0o600, "has 0"),
    (b"x" * 9000, 0o600, "has 4097 characters"), (TOKEN, 0o644, "may be read by everybody"),
])  # fmt: skip
def test_a_token_file_that_cannot_be_used(tmp_path: Path, content: bytes | None, mode: int, says: str) -> None:
    file = tmp_path / "token"
    if content is not None:
        file.write_bytes(content)
        file.chmod(mode)
    with pytest.raises(ConfigError, match=says) as caught:
        CommandGuard.of(Zenoh(command_token_file=str(file)))
    assert str(file) in str(caught.value) and "\n" not in str(caught.value)


def test_a_pipe_in_the_place_of_a_token_is_not_waited_for(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "token")
    with pytest.raises(ConfigError, match="not a file, expected one with a token"):
        CommandGuard.of(Zenoh(command_token_file=str(tmp_path / "token")))


def test_none_of_ten_thousand_foreign_commands_is_taken_and_the_owner_is_served(tmp_path: Path) -> None:
    robot, rng = Robot(), random.Random(SEED)
    log = CommandLog(tmp_path)
    requests = Requests("robot1", replace(robot.handlers(), told=log), guard=CommandGuard(TOKEN))
    for n in range(FOREIGN):
        guess = rng.choice(
            [b"", TOKEN[: rng.randrange(32)], rng.randbytes(rng.randrange(64)), TOKEN + bytes([n % 256])]
        )
        if guess.strip() == TOKEN:
            continue
        assert not requests.answer("cmd/reset", b'{"keep_map": false}', guess).ok
    assert robot.calls == [], f"seed {SEED}"
    assert requests.answer("cmd/reset", b"", TOKEN).ok, "strangers do not use up the owner's rate"
    assert len(robot.calls) == 1
    rows = [json.loads(line) for line in (tmp_path / NAME).read_text().splitlines()]
    assert len(rows) < 60, "strangers do not fill the disk"
    assert rows[0]["who"] == "somebody" and rows[0]["outcome"].startswith("refused: command reset")
    assert (rows[-1]["who"], rows[-1]["command"], rows[-1]["outcome"]) == ("owner, by token", "reset", "done")


def test_what_failed_is_in_the_log_and_the_log_is_bounded(tmp_path: Path) -> None:
    robot, log = Robot(refuse=BusError("no map yet")), CommandLog(tmp_path)
    assert not Requests("robot1", replace(robot.handlers(), told=log)).answer("cmd/relocalise", b"").ok
    (row,) = [json.loads(line) for line in (tmp_path / NAME).read_text().splitlines()]
    assert (row["who"], row["outcome"]) == ("this computer", "failed: no map yet")
    for _ in range(3 * MOST_BYTES // 4000):
        log("reset", "x" * 4000, "owner", "done")
    sizes = [p.stat().st_size for p in tmp_path.iterdir()]
    assert len(sizes) == 2 and max(sizes) < MOST_BYTES + 5000


@pytest.mark.parametrize("there", [b'{"format": "ceilvo-map", "content": {}}\n', b"\x89PNG\r\n", b"7\n", None])
def test_what_is_no_log_of_commands_makes_way(
    tmp_path: Path, there: bytes | None, caplog: pytest.LogCaptureFixture
) -> None:
    """A map under this name was spoilt by the first command, and the next but a few thousand would have deleted it."""
    path = tmp_path / NAME
    if there is None:
        path.mkdir()
    else:
        path.write_bytes(there)
    log = CommandLog(tmp_path)
    for _ in range(2):
        log("reset", "", "owner", "done")
    assert len(path.read_text().splitlines()) == 2
    aside = tmp_path / f"{NAME}.rejected"
    assert aside.is_dir() if there is None else aside.read_bytes() == there
    assert [r.getMessage() for r in caplog.records] == [f"{path}: no log of commands; set aside as {aside.name}"]


def test_a_line_that_was_cut_short_costs_no_other(tmp_path: Path) -> None:
    CommandLog(tmp_path)("reset", "", "owner", "done")
    path = tmp_path / NAME
    path.write_bytes(path.read_bytes() + path.read_bytes()[:20])
    CommandLog(tmp_path)("save_map", "", "owner", "done")
    rows = path.read_text().splitlines()
    assert len(rows) == 3
    assert [json.loads(rows[n])["command"] for n in (0, 2)] == ["reset", "save_map"]


def test_the_token_comes_over_a_real_session(token_file: Path) -> None:
    robot, port = Robot(), free_port()
    bus = ZenohBus(bus_config(port, command_token_file=str(token_file)), "robot1", robot.handlers())
    bus.open()
    session = peer(connect=port)
    try:
        key = "ceilvo/robot1/cmd/save_map"
        get(session, "ceilvo/robot1/map")
        for attachment, taken in ((None, False), (b"0" * 32, False), (TOKEN, True)):
            replies = list(session.get(key, attachment=attachment, timeout=10.0))
            assert [r.ok is not None for r in replies] == [taken]
        assert len(robot.calls) == 1
        assert next(iter(session.get("ceilvo/robot1/map", timeout=10.0))).ok is not None, "reading is open"
    finally:
        session.close()
        bus.close()
