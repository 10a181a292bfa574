"""The doctor on the computer and on the program as it was installed."""

from __future__ import annotations

import logging
import re
from pathlib import Path

import pytest
from fake_machine import RUNNING, fake, levels, wrongs
from kept_maps import write_database
from map_writer import landmarks

from ceilvo.config import Config, Zenoh
from ceilvo.daemon import cli
from ceilvo.daemon.doctor import kernels
from ceilvo.daemon.doctor.findings import fine
from ceilvo.daemon.doctor.system import (
    INSTALLED,
    OF_DEBIAN,
    clock,
    compiled_kernel,
    daemon_state,
    disk,
    limits,
    unit_file,
)
from ceilvo.daemon.odometry import kernel
from ceilvo.daemon.relocalisation import kernel as place_kernel
from ceilvo.daemon.vision import kernel as vision_kernel
from ceilvo.drivers.host.machine import Done


def test_a_kernel_that_was_not_compiled_is_told_with_what_to_do(monkeypatch: pytest.MonkeyPatch) -> None:
    for vision, odometry, words in ((True, True, ""), (False, False, "not compiled"), (True, False, "in part")):
        monkeypatch.setattr(vision_kernel, "COMPILED", vision)
        monkeypatch.setattr(kernel, "COMPILED", odometry)
        monkeypatch.setattr(place_kernel, "COMPILED", odometry)
        (finding,) = compiled_kernel()
        if not words:
            assert finding == fine("kernel", "compiled")
        else:
            assert finding.level == "note"  # slower, but right
            assert words in finding.text and "apt install gcc python3-dev" in finding.text
            assert re.search(r"a frame takes \d", finding.text)


def test_the_daemon_says_once_which_kernel_runs(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(kernel, "COMPILED", False)
    monkeypatch.setattr(cli.app, "run", lambda plan: 0)
    with caplog.at_level("INFO", "ceilvo"), monkeypatch.context() as m:
        m.setattr(logging, "basicConfig", lambda **_: None)
        assert cli.main(["run", "--simulate", "--seconds", "1"]) == 0
    (record,) = (r for r in caplog.records if r.getMessage().startswith("kernel: "))
    assert record.levelname == "WARNING" and record.getMessage() == f"kernel: {kernels.which()[1]}"


def test_the_service(tmp_path: Path) -> None:
    def told(text: str | None, code: int = 0) -> tuple[str, str, str]:
        answer = None if text is None else Done(code, text)
        (finding,), pid = daemon_state(fake(tmp_path, answers={"systemctl show": answer}))
        return finding.level, finding.text, pid

    assert told(RUNNING) == ("fine", "ceilvod runs (pid 77): TRACKING x=1.00 m", "77")
    assert told(None)[0] == told("bus error", 1)[0] == "note"
    assert "install.sh" in told("LoadState=not-found")[1]
    assert told("LoadState=loaded\nActiveState=inactive\nMainPID=0")[0] == "note"
    for code, hint in (("78", "configuration or calibration"), ("1", "journalctl")):
        level, text, pid = told(f"LoadState=loaded\nActiveState=failed\nMainPID=0\nExecMainStatus={code}")
        assert level == "wrong" and hint in text and pid == ""


def test_the_unit_file(tmp_path: Path) -> None:
    assert levels(unit_file(fake(tmp_path), None)) == ["fine"]
    shown = "systemctl show"
    bad = {
        "verify: x.service:7: Unknown key": {"systemd-analyze verify": Done(1, "x.service:7: Unknown key\nmore")},
        "daemon-reload": {shown: Done(0, "NeedDaemonReload=yes\nUnitFileState=enabled")},
    }
    for expected, answers in bad.items():
        (text,) = wrongs(unit_file(fake(tmp_path, answers=answers), None))
        assert expected in text
    disabled = fake(tmp_path, answers={shown: Done(0, "NeedDaemonReload=no\nUnitFileState=disabled")})
    assert levels(unit_file(disabled, None)) == ["note", "fine"]
    deaf = fake(tmp_path, answers={shown: Done(0, "NeedDaemonReload=no\nIPAddressDeny=::/0 0.0.0.0/0")})
    assert levels(unit_file(deaf, Config())) == ["fine"]
    fleet = Config(zenoh=Zenoh(connect=("tcp/10.0.0.9:7447",)))
    assert "the service may not use it" in wrongs(unit_file(deaf, fleet))[0]
    assert levels(unit_file(fake(tmp_path), fleet)) == ["fine"]
    machine = fake(tmp_path)
    machine.path(INSTALLED).write_text("[Unit]\n# edited\n")
    assert "differs from the package's" in wrongs(unit_file(machine, None))[0]
    machine.path(OF_DEBIAN).parent.mkdir(parents=True)
    machine.path(OF_DEBIAN).write_text("[Unit]\n")
    assert "hides the package's" in wrongs(unit_file(machine, None))[0]
    machine.path(INSTALLED).unlink()
    assert list(unit_file(machine, None)) == [fine("unit", OF_DEBIAN)]  # dpkg looks after the file itself
    machine = fake(tmp_path, answers=deaf.answers)
    machine.path(INSTALLED).unlink()
    assert "sudo /usr/lib/ceilvo/share/ceilvo/network.sh" in wrongs(unit_file(machine, fleet))[0]
    machine.path(OF_DEBIAN).unlink()
    assert list(unit_file(machine, None)) == []


def test_the_clock(tmp_path: Path) -> None:
    assert levels(clock(fake(tmp_path))) == ["fine"]
    for answer in (Done(0, "no"), None, Done(1, "no bus")):
        assert levels(clock(fake(tmp_path, answers={"timedatectl show": answer}))) == ["note"]


def test_the_state_directory(tmp_path: Path) -> None:
    folder, config = tmp_path / "state", Config()
    folder.mkdir()
    assert levels(disk(fake(tmp_path), folder, config)) == ["fine"]
    assert levels(disk(fake(tmp_path), None, config)) == ["note"]
    assert "no such folder" in wrongs(disk(fake(tmp_path), tmp_path / "absent", config))[0]
    assert "may not write" in wrongs(disk(fake(tmp_path, writable=False), folder, config))[0]
    assert "1 MB free, expected 20" in wrongs(disk(fake(tmp_path, free=10**6), folder, config))[0]
    assert levels(disk(fake(tmp_path, free=5 * 10**8), folder, config)) == ["note"]
    assert levels(disk(fake(tmp_path, free=5 * 10**8), folder, None)) == ["fine"]
    (folder / "map.json").write_text("{}")
    assert "map.json" in wrongs(disk(fake(tmp_path), folder, config))[0], "it would be imported"
    write_database(folder / "map.db", landmarks(30))
    kept = list(disk(fake(tmp_path), folder, config))[-1]
    assert (kept.level, kept.check) == ("fine", "map") and "map.db: 30 landmarks, 0 key poses, version 1" in kept.text
    (folder / "map.db").write_text("half a fi")
    assert "expected a database of maps" in wrongs(disk(fake(tmp_path), folder, config))[0]


def test_limits(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    machine = fake(tmp_path)
    assert wrongs(limits(machine)) == []
    machine.path("/proc/meminfo").write_text("MemAvailable:    100000 kB\n")
    assert "102 MB of memory" in wrongs(limits(machine))[0]
    machine = fake(tmp_path)
    monkeypatch.setattr("resource.getrlimit", lambda which: (64, 64))
    assert "64 open files" in wrongs(limits(machine))[0]
    monkeypatch.setattr("resource.getrlimit", lambda which: (1024, 1024))
    monkeypatch.setattr("os.sched_getaffinity", lambda pid: {0})
    assert levels(limits(machine)) == ["note", "fine"]
