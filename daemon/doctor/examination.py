"""`ceilvod doctor`: everything between the computer and the pose that can be looked at without driving.

Each check gives findings, one line each: fine, worth knowing, or wrong with what to do. Nothing here disturbs a daemon
that runs: a device that somebody holds is not opened, a camera is asked by ioctl only, a base is only read.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterator
from pathlib import Path

from ceilvo.config import Config
from ceilvo.config.checks import notes
from ceilvo.config.reader import load_config
from ceilvo.daemon.doctor.camera import calibration, camera
from ceilvo.daemon.doctor.findings import Finding, Patient, fine, note, wrong
from ceilvo.daemon.doctor.links import base, bus
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
from ceilvo.drivers.host.machine import Machine
from ceilvo.errors import ConfigError

Check = Callable[[Patient], Iterator[Finding]]

CHECKS: tuple[Check, ...] = (
    camera,
    calibration,
    base,
    bus,
    lambda p: clock(p.machine),
    lambda p: disk(p.machine, p.state_dir, p.config),
    lambda p: unit_file(p.machine, p.config),
    lambda p: limits(p.machine),
    lambda p: compiled_kernel(),
)


def examine(path: Path, overrides: tuple[str, ...], as_json: bool, machine: Machine | None = None) -> int:
    """Print every finding; 0 when nothing is wrong, else 1."""
    machine = machine or _as_the_service()
    findings: list[Finding] = []
    config = None
    try:
        config = load_config(path, overrides)
        findings += [fine("config", f"{path}")] + [note("config", text) for text in notes(config)]
    except ConfigError as e:
        findings += [wrong("config", problem) for problem in e.problems]
    state, running = daemon_state(machine)
    findings += state
    patient = Patient(config, path, _state_dir(config, machine), running, machine)
    findings += [f for check in CHECKS for f in check(patient)]
    _print(findings, as_json)
    return int(any(f.level == "wrong" for f in findings))


def _print(findings: list[Finding], as_json: bool) -> None:
    if as_json:
        bad = any(f.level == "wrong" for f in findings)
        rows = [{"check": f.check, "level": f.level, "text": f.text} for f in findings]
        print(json.dumps({"ok": not bad, "findings": rows}, indent=2))
        return
    marks = {"fine": "OK   ", "note": "note ", "wrong": "WRONG"}
    for f in findings:
        print(f"{marks[f.level]} {f.check:12} {f.text}")


def _as_the_service() -> Machine:
    """Root may do everything, so what counts are the rights of the service's user."""
    machine = Machine()
    return Machine(user="ceilvo") if os.geteuid() == 0 and machine.has_user("ceilvo") else machine


def _state_dir(config: Config | None, machine: Machine) -> Path | None:
    if config is not None and config.service.state_dir:
        return Path(config.service.state_dir)
    installed = any(machine.path(unit).exists() for unit in (INSTALLED, OF_DEBIAN))
    return machine.path("/var/lib/ceilvo") if installed else None
