"""The doctor's checks of the computer itself and of what is installed on it: service, clock, disk, limits, kernel."""

from __future__ import annotations

import os
import re
import resource
from collections.abc import Iterator
from pathlib import Path

from ceilvo.config import Config
from ceilvo.config.zenoh_names import needs_network
from ceilvo.daemon.doctor import kernels
from ceilvo.daemon.doctor.findings import Finding, fine, note, wrong
from ceilvo.daemon.map.database.database import MapDatabase
from ceilvo.daemon.map.kept.kept_map import OLD_NAME
from ceilvo.daemon.map.kept.store import MAP_NAME, STATE_NAME
from ceilvo.daemon.map.map_file import load_map, load_state
from ceilvo.drivers.host.machine import Machine
from ceilvo.errors import FileFormatError

UNIT, INSTALLED = "ceilvod.service", "/etc/systemd/system/ceilvod.service"
PACKAGED = "/opt/ceilvo/share/ceilvo/ceilvod.service"
OF_DEBIAN = "/usr/lib/systemd/system/ceilvod.service"
"""The unit of the Debian package, which dpkg looks after; one in INSTALLED comes before it."""
_NETWORK = "share/ceilvo/network.sh"
MEMORY_BYTES = 400_000_000
"""Memory that should be free; chosen with a margin for large maps."""
STATE_BYTES = 20_000_000
"""Disk that map and pose need besides the recorder; chosen."""
OPEN_FILES = 256
"""Descriptors the process may have; chosen: far above what cameras, serial lines and Zenoh open."""


def daemon_state(machine: Machine) -> tuple[list[Finding], str]:
    """How the service does, and its process id as text, "" when it does not run."""
    shown = machine.run("systemctl", "show", UNIT, "-p", "LoadState,ActiveState,MainPID,StatusText,ExecMainStatus")
    if shown is None or shown.code:
        return [note("service", "no systemd here that can be asked")], ""
    have = dict(line.partition("=")[::2] for line in shown.text.splitlines())
    state, pid, said = have.get("ActiveState", ""), have.get("MainPID", "0"), have.get("StatusText", "")
    if have.get("LoadState") != "loaded":
        return [
            note("service", "ceilvod is not installed as a service; install its package, or sudo systemd/install.sh")
        ], ""
    if state in ("active", "activating", "reloading") and pid != "0":
        return [fine("service", f"ceilvod runs (pid {pid}): {said or state}")], pid
    if state == "failed":
        code = have.get("ExecMainStatus", "")
        hint = "configuration or calibration is wrong: see below" if code == "78" else "journalctl -u ceilvod says why"
        return [wrong("service", f"ceilvod failed with exit code {code}; {hint}")], ""
    return [note("service", f"ceilvod is {state or 'not there'}; sudo systemctl start ceilvod")], ""


def unit_file(machine: Machine, config: Config | None) -> Iterator[Finding]:
    """Installed, the one of this package, accepted by systemd, loaded, and with the network that is configured."""
    where, app = (INSTALLED, "/opt/ceilvo") if machine.text(INSTALLED) is not None else (OF_DEBIAN, "/usr/lib/ceilvo")
    installed = machine.text(where)
    if installed is None:
        return  # the service check has said so
    packaged = machine.text(PACKAGED) if where == INSTALLED else None
    good = True
    if where == INSTALLED and machine.text(OF_DEBIAN) is not None:
        good = False
        yield wrong(
            "unit",
            f"{INSTALLED} hides the package's, {OF_DEBIAN}; remove it, and put your own settings in a drop-in "
            "(systemctl edit ceilvod)",
        )
    if packaged is not None and packaged != installed:
        good = False
        yield wrong(
            "unit",
            f"{INSTALLED} differs from the package's; run {Path(PACKAGED).parent}/install.sh again and put your own "
            "settings in a drop-in (systemctl edit ceilvod)",
        )
    verified = machine.run("systemd-analyze", "verify", str(machine.path(where)))
    if verified is not None and verified.code:
        good = False
        yield wrong("unit", f"systemd-analyze verify: {_first_line(verified.text)}; install again")
    shown = machine.run("systemctl", "show", UNIT, "-p", "NeedDaemonReload,UnitFileState,IPAddressDeny")
    if shown is not None and "NeedDaemonReload=yes" in shown.text:
        good = False
        yield wrong("unit", "systemd has an older version of it loaded; sudo systemctl daemon-reload")
    denied = shown is not None and re.search(r"IPAddressDeny=.*/0", shown.text)
    if config is not None and needs_network(config.zenoh) and denied:
        good = False
        yield wrong(
            "unit",
            "zenoh.listen, zenoh.connect or zenoh.config_file need the network and the service may not use it; run "
            f"sudo {app}/{_NETWORK}",
        )
    if shown is not None and "UnitFileState=disabled" in shown.text:
        yield note("unit", "it does not start with the computer; sudo systemctl enable ceilvod")
    if good:
        yield fine("unit", where)


def clock(machine: Machine) -> Iterator[Finding]:
    """Poses carry the time since 1970, which other computers compare with theirs."""
    shown = machine.run("timedatectl", "show", "-p", "NTPSynchronized", "--value")
    if shown is None or shown.code:
        yield note("clock", "nobody here can tell whether it is synchronised (no timedatectl)")
    elif shown.text.strip() == "yes":
        yield fine("clock", "synchronised")
    else:
        yield note(
            "clock",
            "not synchronised, so the poses' stamp_unix_ns means nothing to other computers; timedatectl set-ntp true",
        )


def disk(machine: Machine, state_dir: Path | None, config: Config | None) -> Iterator[Finding]:
    """The state directory is there and writable, has room, and what is in it can be read."""
    if state_dir is None:
        yield note("state", "service.state_dir is empty and there is no service: map, pose and recordings are not kept")
        return
    if not state_dir.is_dir():
        yield wrong("state", f"{state_dir}: no such folder; 'mkdir {state_dir}' and give it to the user of the daemon")
        return
    if not machine.may_write(state_dir):
        who = machine.user or "you"
        yield wrong("state", f"{state_dir}: {who} may not write there; 'chown -R {who} {state_dir}'")
        return
    free, need = machine.free_bytes(state_dir), STATE_BYTES
    wanted = need
    if config is not None and config.recorder.enabled:
        cfg = config.recorder
        there = sum(f.stat().st_size for f in (state_dir / "recorder").rglob("*.mcap"))
        wanted = cfg.reserve_bytes + max(0, cfg.ring_bytes + cfg.kept_bytes - there)
    room = f"{state_dir}: {free / 1e6:.0f} MB free"
    if free < need:
        yield wrong(
            "state", f"{room}, expected {need / 1e6:.0f} at least; map and pose cannot be saved, delete something"
        )
    elif free < wanted:
        yield note("state", f"{room}, recordings may want {wanted / 1e6:.0f}; lower recorder.ring_bytes and kept_bytes")
    else:
        yield fine("state", room)
    yield from _kept(state_dir)


def _kept(state_dir: Path) -> Iterator[Finding]:
    """Map and pose of the robot can be read; before the first start with a database, an older map."""
    path = state_dir / MAP_NAME
    try:
        if os.path.lexists(path):
            with MapDatabase(path) as db:
                poses = sum(len(k) for k in db.content().key_poses)
                held = f"{len(db.content().landmarks)} landmarks, {poses} key poses"
                yield fine("map", f"{path}: {held}, version {db.version}, hash {db.hash[:12]}")
        else:
            load_map(state_dir / OLD_NAME)
        load_state(state_dir / STATE_NAME)
    except FileFormatError as e:
        yield wrong("state", f"{e}")


def limits(machine: Machine) -> Iterator[Finding]:
    """Memory, processors, open files. Real-time rights are not needed."""
    memory = _available_bytes(machine)
    cores = len(os.sched_getaffinity(0))
    files = resource.getrlimit(resource.RLIMIT_NOFILE)[0]
    good = True
    if memory is not None and memory < MEMORY_BYTES:
        good = False
        yield wrong(
            "limits",
            f"{memory / 1e6:.0f} MB of memory to be had, expected {MEMORY_BYTES / 1e6:.0f}; end other programs",
        )
    if 0 <= files < OPEN_FILES:
        good = False
        yield wrong("limits", f"{files} open files, expected {OPEN_FILES} at least; raise LimitNOFILE or 'ulimit -n'")
    if cores < 2:
        yield note("limits", "one processor: at 30 frames per second it has little left for anything else")
    if good:
        known = "" if memory is None else f"{memory / 1e6:.0f} MB of memory, "
        yield fine("limits", f"{known}{cores} processors")


def compiled_kernel() -> Iterator[Finding]:
    """Whether the loops over edge points are compiled; without a compiler the installation does without."""
    compiled, said = kernels.which()
    yield fine("kernel", said) if compiled else note("kernel", said)


def _available_bytes(machine: Machine) -> int | None:
    match = re.search(r"^MemAvailable:\s+(\d+) kB", machine.text("/proc/meminfo") or "", re.M)
    return None if match is None else 1024 * int(match[1])


def _first_line(text: str) -> str:
    return text.splitlines()[0] if text else "no reason given"
