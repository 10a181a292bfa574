"""`ceilvod mapd` and `ceilvod map fetch|offer|key` as people type them, the service over real Zenoh."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
from fleet_parts import HALL, SERVICE, SIZE_M, running, survey, surveyed
from patience import PATIENCE_S, until
from zenoh_world import free_port, peer

from ceilvo.bench.fleet.robots import AXIS_RAD, key_of
from ceilvo.bench.fleet.world import Region, driven
from ceilvo.daemon.cli import main
from ceilvo.daemon.fleet import extra
from ceilvo.daemon.fleet.replies import OFFER, Refusal, service_key
from ceilvo.daemon.fleet.service.ledger import Ledger
from ceilvo.daemon.fleet.service.server import Server
from ceilvo.daemon.fleet.service.tables import ledger_of
from ceilvo.daemon.map.database.content import MapContent
from ceilvo.daemon.map.database.copies import open_map

Capture = pytest.CaptureFixture[str]
WORDS = ("mapd", "mapd run", "mapd pending", "mapd approve", "mapd reject", "mapd stats", "mapd keys")
MAP_WORDS = ("map fetch", "map offer", "map key")


@pytest.mark.parametrize("word", [*WORDS, *MAP_WORDS])
def test_help_has_an_example(word: str, capsys: Capture) -> None:
    with pytest.raises(SystemExit) as end:
        main([*word.split(), "--help"])
    assert end.value.code == 0 and f"example: ceilvod {word} " in capsys.readouterr().out


@pytest.fixture
def port() -> int:
    return free_port()


@pytest.fixture
def server(tmp_path: Path, port: int) -> Iterator[Server]:
    yield from running(surveyed(tmp_path / "b.db"), port)


@pytest.fixture
def robot(tmp_path: Path, port: int, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with a robot's configuration and key, to work in."""
    folder = tmp_path / "robot"
    folder.mkdir()
    monkeypatch.chdir(folder)
    key = folder / "robot.key"
    key.write_text(bytes([1] * 32).hex() + "\n")
    key.chmod(0o600)
    (folder / "config.yaml").write_text(
        f"zenoh: {{connect: [tcp/127.0.0.1:{port}], multicast: false}}\n"
        f"fleet: {{service: {SERVICE}, key_file: {key}}}\n"
    )
    return folder


def test_a_robots_day(server: Server, robot: Path, tmp_path: Path, capsys: Capture) -> None:
    service = str(tmp_path / "b.db")
    assert main(["map", "fetch", "map.db", "--config", "config.yaml"]) == 0
    out = capsys.readouterr().out
    assert re.search(rf"hall: version 1 \d+ tiles came, \d+ bytes\nmap.db: gets {len(survey())} landmarks", out), out
    with open_map(robot / "map.db") as db:
        learnt = driven(
            db.content().landmarks, HALL, Region(np.zeros(2), np.array(SIZE_M)), np.zeros(2), np.random.default_rng(1)
        )
        db.save(learnt, AXIS_RAD, "robot1/drive")
    assert main(["map", "offer", "map.db", "--config", "config.yaml"]) == 0
    assert capsys.readouterr().out == "map.db: 1 offers made, 1 wait\n1 offers are with the service\n"

    assert main(["mapd", "pending", "--db", service]) == 0
    out = capsys.readouterr().out
    number = out.split()[0]
    assert "robot0: " in out and "robot1/drive" in out and out.endswith("1 offers wait\n")
    assert main(["mapd", "approve", "--db", service, number, "--png", "offer.png"]) == 0
    assert cv2.imread("offer.png") is not None
    assert main(["mapd", "approve", "--db", service, number]) == 0
    assert "1 offers approved" in capsys.readouterr().out
    until(lambda: server.status()["floors"] == {"": 2}, "a new version")
    assert main(["map", "fetch", "map.db", "--config", "config.yaml", "--dry-run"]) == 0
    assert "would get" in capsys.readouterr().out
    assert main(["map", "fetch", "map.db", "--config", "config.yaml"]) == 0
    assert "0 landmarks are this robot's own" in capsys.readouterr().out
    with open_map(robot / "map.db") as db, open_map(tmp_path / "b.db") as fleet:
        ours, theirs = db.content().landmarks, fleet.content().landmarks
        assert np.array_equal(ours.ids, theirs.ids) and np.abs(ours.xy_map_m - theirs.xy_map_m).max() < 1e-6
        assert len(ours) == len(learnt)
    assert main(["map", "fetch", "map.db", "--config", "config.yaml"]) == 0
    assert "is the newest one" in capsys.readouterr().out
    assert main(["mapd", "stats", "--db", service]) == 0
    assert re.search(r"map +version 2, \d+ landmarks wait", capsys.readouterr().out)
    assert main(["mapd", "stats", "--db", service, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["floors"] == {"": 2}


def test_keys_are_made_shown_added_and_taken_back(tmp_path: Path, capsys: Capture) -> None:
    key, db = str(tmp_path / "robot.key"), str(tmp_path / "b.db")
    assert main(["map", "key", key]) == 0
    public = capsys.readouterr().out.strip()
    assert main(["map", "key", key]) == 0
    assert capsys.readouterr().out.strip() == public and Path(key).stat().st_mode & 0o777 == 0o600
    assert main(["mapd", "keys", "--db", db, "--add", "robot1", "--key", public, "--trusted"]) == 0
    assert capsys.readouterr().out == f"{public}  trusted     robot1\n"
    assert main(["mapd", "keys", "--db", db, "--add", "robot1", "--key", key_of(3).public.hex()]) == 1
    assert "another key has this name" in capsys.readouterr().err
    assert main(["mapd", "keys", "--db", db, "--add", "robot2"]) == 1
    assert "needs --key" in capsys.readouterr().err
    assert main(["mapd", "keys", "--db", db, "--add", "robot2", "--key", "12"]) == 1
    assert "64 hexadecimal digits" in capsys.readouterr().err
    assert main(["mapd", "keys", "--db", db, "--remove", "robot1"]) == 0
    assert "taken back" in capsys.readouterr().out
    assert main(["mapd", "keys", "--db", db, "--remove", "robot1"]) == 1


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["map", "fetch", "map.db"], "fleet.service: found nothing"),
        (["map", "offer", "map.db", "--set", "fleet.service=hall"], "fleet.key_file: found nothing"),
        (["map", "offer", "map.db", "--set", "fleet.service=a/b"], "fleet.service: found 'a/b'"),
        (["map", "key", "."], "not a file, expected one with a robot's key"),
        (["mapd", "pending", "--db", "none.db"], "none.db.mapd: no such file"),
        (["mapd", "approve", "--db", "b.db"], "no offer was named"),
        (["mapd", "reject", "--db", "b.db", "7"], "offer 7: does not wait"),
    ],
)
def test_wrong_use_is_one_line(
    words: list[str], said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Capture
) -> None:
    monkeypatch.chdir(tmp_path)
    Ledger(ledger_of(tmp_path / "b.db")).close()
    assert main(words) in (1, 78)
    err = capsys.readouterr().err
    assert said in err and err.count("\n") == 1


@pytest.mark.parametrize(("content", "mode"), [("12\n", 0o600), (bytes([1] * 32).hex(), 0o644), ("\0é", 0o600)])
def test_a_key_that_is_none_or_known_to_all_is_refused(
    content: str, mode: int, tmp_path: Path, capsys: Capture
) -> None:
    key = tmp_path / "robot.key"
    key.write_text(content)
    key.chmod(mode)
    assert main(["map", "key", str(key)]) == 78
    assert capsys.readouterr().err.startswith("ceilvod: fleet.key_file: ")


def test_a_service_that_is_away_is_one_line_and_offers_wait(robot: Path, capsys: Capture) -> None:
    with open_map(robot / "map.db", create=True) as db:
        db.edit(MapContent.of(survey(), AXIS_RAD), "learnt")
    assert main(["map", "offer", "map.db", "--config", "config.yaml"]) == 1
    out = capsys.readouterr().out
    assert out.startswith("map.db: 1 offers made, 1 wait\nhall: ") and out.count("\n") == 2
    assert main(["map", "fetch", "map.db", "--config", "config.yaml"]) == 1


def test_without_the_libraries_it_says_what_to_install(monkeypatch: pytest.MonkeyPatch, capsys: Capture) -> None:
    def missing(name: str) -> None:
        raise ModuleNotFoundError(name, name="msgpack")

    monkeypatch.setattr(extra.importlib, "import_module", missing)
    assert main(["map", "key", "x"]) == 1
    assert capsys.readouterr().err == (
        "ceilvod: msgpack is not installed; pip install 'ceilvo[fleet]', or install.sh --fleet\n"
    )


def test_what_is_no_request_gets_one_line_and_the_service_lives(server: Server, port: int) -> None:
    with peer(connect=port) as session:
        for word in ("manifest", "tiles", OFFER):
            found: list[Refusal] = []
            for payload in (b"", b"nonsense", bytes(60_001)):

                def ask(word: str = word, payload: bytes = payload, found: list[Refusal] = found) -> bool:
                    replies = list(
                        session.get(service_key("ceilvo", SERVICE, word), payload=payload, timeout=PATIENCE_S)
                    )
                    found += [Refusal.unpacked(r.err.payload.to_bytes()) for r in replies if r.err is not None]
                    return bool(replies)

                until(ask, f"an answer of {word}")
            assert len(found) == 3 and all(r.why == "malformed" and "\n" not in r.text for r in found)
        (reply,) = session.get(service_key("ceilvo", SERVICE, "status"), timeout=PATIENCE_S)
        assert json.loads(reply.ok.payload.to_bytes())["floors"] == {"": 1}
        assert not list(session.get("ceilvo/**", timeout=1.0)), "no wildcard reaches it"
