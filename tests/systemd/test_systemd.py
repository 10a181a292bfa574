"""The service: what systemd is told, what the unit promises, what the installer leaves behind."""

from __future__ import annotations

import hashlib
import os
import shutil
import socket
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest
from installer import INSTALL, MAPD_UNIT, REPO, UNIT, WEB_UNIT, as_root, run_installer, unit_settings

from ceilvo.drivers.host.systemd_notify import STATUS_MAX_CHARS, Notifier

# --- Notifier


class Manager:
    """A service manager's end of the socket."""

    def __init__(self, address: str) -> None:
        self.sock = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self.sock.bind("\0" + address[1:] if address[0] == "@" else address)
        self.sock.settimeout(2.0)
        self.address = address

    def got(self) -> list[str]:
        """All datagrams so far, without waiting."""
        self.sock.setblocking(False)
        out = []
        while True:
            try:
                out.append(self.sock.recv(4096).decode())
            except BlockingIOError:
                return out


@pytest.fixture(params=["path", "abstract"])
def manager(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Manager]:
    address = str(tmp_path / "notify") if request.param == "path" else f"@ceilvo-test-{os.getpid()}"
    m = Manager(address)
    yield m
    m.sock.close()


class FakeClock:
    def __init__(self) -> None:
        self.ns = 1_000_000_000

    def __call__(self) -> int:
        return self.ns


def test_messages_reach_the_manager_in_order(manager: Manager) -> None:
    with Notifier({"NOTIFY_SOCKET": manager.address}) as n:
        assert n.active
        n.ready("waiting for the camera")
        n.status("TRACKING 15.0 fps")
        n.stopping("saving the map")
    assert manager.got() == [
        "READY=1\nSTATUS=waiting for the camera",
        "STATUS=TRACKING 15.0 fps",
        "STOPPING=1\nSTATUS=saving the map",
    ]


def test_status_is_one_bounded_line_and_only_news(manager: Manager) -> None:
    with Notifier({"NOTIFY_SOCKET": manager.address}) as n:
        n.status("a\nREADY=1\tb")
        n.status("a READY=1  b")
        n.status("x" * 9999)
    first, second = manager.got()
    assert first == "STATUS=a READY=1 b"
    assert second == "STATUS=" + "x" * STATUS_MAX_CHARS


def test_watchdog_is_thinned_to_a_quarter_of_its_period(manager: Manager) -> None:
    clock = FakeClock()
    env = {"NOTIFY_SOCKET": manager.address, "WATCHDOG_USEC": "4000000", "WATCHDOG_PID": str(os.getpid())}
    with Notifier(env, clock) as n:
        assert n.watchdog_period_s == 4.0
        for _ in range(300):  # 10 s of frames at 30 fps
            n.watchdog()
            clock.ns += 33_333_334
    assert manager.got() == ["WATCHDOG=1"] * 10


@pytest.mark.parametrize(
    "env",
    [
        {},
        {"WATCHDOG_USEC": "0"},
        {"WATCHDOG_USEC": "soon"},
        {"WATCHDOG_USEC": "-4000000"},
        {"WATCHDOG_USEC": "4" * 5000},
        {"WATCHDOG_USEC": "\u0664000000"},
        {"WATCHDOG_USEC": "4000000", "WATCHDOG_PID": "1"},
    ],
)
def test_watchdog_meant_for_nobody_here_is_not_fed(manager: Manager, env: dict[str, str]) -> None:
    with Notifier({"NOTIFY_SOCKET": manager.address, **env}) as n:
        assert n.watchdog_period_s is None
        n.watchdog()
    assert manager.got() == []


def test_without_systemd_nothing_happens(caplog: pytest.LogCaptureFixture) -> None:
    n = Notifier({})
    n.ready()
    n.watchdog()
    n.status("x")
    n.stopping()
    n.close()
    n.close()
    assert not n.active
    assert caplog.records == []


@pytest.mark.parametrize("address", ["/nonexistent/notify", "vsock:2:1234", "@ceilvo-nobody-listens"])
def test_unusable_socket_is_one_warning_and_no_exception(address: str, caplog: pytest.LogCaptureFixture) -> None:
    with Notifier({"NOTIFY_SOCKET": address, "WATCHDOG_USEC": "1000"}) as n:
        assert not n.active
        n.ready()
        n.watchdog()
    (record,) = caplog.records
    assert address in record.getMessage()


def test_manager_that_goes_away_is_one_warning(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    m = Manager(str(tmp_path / "notify"))
    with Notifier({"NOTIFY_SOCKET": m.address}) as n:
        n.ready()
        m.sock.close()
        n.status("one")
        n.status("two")
    (record,) = caplog.records
    assert "STATUS=one" in record.getMessage()


# --- unit


def test_unit_restarts_for_ever_but_not_on_a_wrong_configuration() -> None:
    s = unit_settings()
    assert s["Type"] == ["notify"]
    assert s["NotifyAccess"] == ["main"]
    assert s["WatchdogSec"] == ["4"]
    assert s["Restart"] == ["always"]
    assert s["RestartPreventExitStatus"] == ["78"]
    assert s["StartLimitIntervalSec"] == ["0"]
    assert s["ExecStart"] == ["/opt/ceilvo/bin/ceilvod run --config /etc/ceilvo/config.yaml"]
    assert s["User"] == ["ceilvo"]


def test_its_memory_is_promised_by_a_slice_of_the_first_rank() -> None:
    """A service's own promise holds no further than its slice's, and system.slice promises nothing."""
    unit = unit_settings()
    of_slice = unit_settings(UNIT.with_name("ceilvo.slice"))
    assert unit["Slice"] == ["ceilvo.slice"] and "-" not in unit["Slice"][0]
    assert unit["MemoryMin"] == of_slice["MemoryMin"] == ["192M"]


analyze = pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="systemd-analyze is not installed")


@analyze
@pytest.mark.parametrize("which", [UNIT, MAPD_UNIT, WEB_UNIT], ids=lambda p: p.name)
def test_unit_verifies_silently(which: Path, tmp_path: Path) -> None:
    unit = tmp_path / which.name
    unit.write_text(which.read_text().replace("/opt/ceilvo/bin/ceilvod", "/bin/true"))
    r = subprocess.run(["systemd-analyze", "verify", "--man=no", str(unit)], capture_output=True, text=True)
    assert (r.returncode, r.stdout, r.stderr) == (0, "", "")


@analyze
@pytest.mark.parametrize("which", [UNIT, MAPD_UNIT, WEB_UNIT], ids=lambda p: p.name)
def test_unit_exposure_is_low(which: Path) -> None:
    command = ["systemd-analyze", "security", "--offline=true", "--no-pager", "--threshold=11", str(which)]
    r = subprocess.run(command, capture_output=True, text=True)
    assert r.returncode == 0, r.stdout + r.stderr
    assert "Overall exposure level" in r.stdout


# --- installer


def tree(root: Path) -> dict[str, str]:
    """Path to what it is: owner, mode, and a digest of the content or the link's target."""
    out = {}
    for path in sorted(root.rglob("*")):
        s = path.lstat()
        what = str(path.readlink()) if path.is_symlink() else ""
        if not what and path.is_file():
            what = hashlib.sha256(path.read_bytes()).hexdigest()
        out[str(path.relative_to(root))] = f"{s.st_uid} {s.st_mode:o} {what}"
    return out


def files(root: Path) -> set[str]:
    return {str(p.relative_to(root)) for p in root.rglob("*") if p.is_symlink() or p.is_file()}


@as_root
def test_install_twice_is_install_once_and_uninstall_keeps_only_what_is_the_robots(
    kit: Path, tmp_path: Path, python: Path
) -> None:
    root = tmp_path / "root"
    root.mkdir()
    options = ("--wheel", str(kit / "ceilvo-9.9.9-py3-none-any.whl"), "--no-deps")
    first = run_installer(kit, root, *options, python=python)
    assert first.returncode == 0, first.stderr
    assert "config.yaml written" in first.stdout
    once = tree(root)
    shebang = (root / "opt/ceilvo/bin/ceilvod").read_text().splitlines()[0]
    assert shebang.startswith("#!/opt/ceilvo/bin/python")
    assert (root / "usr/local/bin/ceilvod").readlink() == Path("/opt/ceilvo/bin/ceilvod")
    assert (root / "etc/systemd/system/ceilvod.service").read_bytes() == UNIT.read_bytes()
    assert "ceilvo:" in (root / "etc/passwd").read_text()
    assert not [p for p in (root / "opt/ceilvo").rglob("*") if p.is_file() and str(root).encode() in p.read_bytes()]

    config, calibration = root / "etc/ceilvo/config.yaml", root / "etc/ceilvo/calibration.yaml"
    assert config.read_text() == "robot: {name: robot1}\n"
    config.write_text("robot: {name: mine}\n")
    calibration.write_text("mine\n")
    (root / "var/lib/ceilvo/state").write_text("mine\n")
    second = run_installer(kit, root, *options, python=python)
    assert second.returncode == 0, second.stderr
    assert "config.yaml kept" in second.stdout
    twice = tree(root)
    mine = {"etc/ceilvo/config.yaml", "etc/ceilvo/config.yaml.new", "etc/ceilvo/calibration.yaml"}
    mine |= {"var/lib/ceilvo/state"}
    assert {p for p in once.keys() | twice.keys() if once.get(p) != twice.get(p)} == mine
    assert config.read_text() == "robot: {name: mine}\n"
    assert (root / "etc/ceilvo/config.yaml.new").read_text() == "robot: {name: robot1}\n"
    assert calibration.read_text() == "mine\n"

    gone = run_installer(root / "opt/ceilvo/share/ceilvo", root, "uninstall")
    assert gone.returncode == 0, gone.stderr
    accounts = {f"etc/{a}{b}" for a in ("passwd", "group", "shadow", "gshadow") for b in ("", "-")} | {"etc/.pwd.lock"}
    assert files(root) - accounts == mine
    assert "ceilvo" not in (root / "etc/passwd").read_text()

    assert run_installer(kit, root, "uninstall", "--purge").returncode == 0
    assert files(root) - accounts == set()


@as_root
def test_failed_upgrade_leaves_the_old_program(kit: Path, tmp_path: Path, python: Path) -> None:
    root = tmp_path / "root"
    (root / "opt/ceilvo/bin").mkdir(parents=True)
    (root / "opt/ceilvo/bin/ceilvod").write_text("old")
    broken = kit / "ceilvo-1.0-py3-none-any.whl"
    broken.write_bytes(b"not a wheel")
    r = run_installer(kit, root, "--wheel", str(broken), "--no-deps", python=python)
    assert r.returncode != 0
    assert (root / "opt/ceilvo/bin/ceilvod").read_text() == "old"
    assert not (root / "opt/ceilvo.new").exists()


@pytest.mark.parametrize(
    ("args", "message"),
    [
        (["--whel", "x"], "unknown argument '--whel'"),
        (["--wheel"], "--wheel: expected a value"),
        (["--purge"], "--purge goes with uninstall"),
        (["--root", "/nonexistent"], "--root /nonexistent: no such directory"),
    ],
)
def test_installer_refuses_what_it_does_not_understand(args: list[str], message: str) -> None:
    r = subprocess.run(["bash", str(INSTALL), *args], capture_output=True, text=True)
    assert r.returncode == 1
    assert message in r.stderr


@as_root
@pytest.mark.parametrize(
    ("args", "message"),
    [
        (["--wheel", "/nonexistent.whl"], "--wheel /nonexistent.whl: no such file"),
        (["--wheels", "/nonexistent"], "--wheels /nonexistent: no such directory"),
        (["--python", "/nonexistent/python3"], "--python /nonexistent/python3: not found"),
    ],
)
def test_installer_names_what_is_missing(args: list[str], message: str, tmp_path: Path) -> None:
    r = run_installer(REPO / "systemd", tmp_path, *args)
    assert r.returncode == 1
    assert message in r.stderr
    assert list(tmp_path.iterdir()) == []


@pytest.mark.skipif(shutil.which("shellcheck") is None, reason="shellcheck is not installed")
@pytest.mark.parametrize("script", [INSTALL, *sorted((REPO / "tests" / "robot").glob("*.sh"))], ids=lambda p: p.name)
def test_shell_scripts_are_clean(script: Path) -> None:
    r = subprocess.run(["shellcheck", str(script)], capture_output=True, text=True)
    assert r.returncode == 0, r.stdout
