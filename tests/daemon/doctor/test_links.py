"""The doctor on the base and the bus, with each thing wrong that it looks for."""

from __future__ import annotations

import socket
from dataclasses import replace
from pathlib import Path

import pytest
from fake_machine import fake, levels, wrongs

from ceilvo.config import Base, Config, Zenoh
from ceilvo.daemon.doctor.findings import Patient
from ceilvo.daemon.doctor.links import base, bus
from ceilvo.sim.base import SimBase


def test_a_base_that_is_held_is_left_alone(tmp_path: Path, simulated: SimBase) -> None:
    config = Config(base=Base(port=simulated.port))
    p = Patient(config, tmp_path / "c.yaml", None, machine=fake(tmp_path, held=("minicom (pid 5)",)))
    assert "in use by minicom (pid 5): only one" in wrongs(base(p))[0]
    (mine,) = base(replace(p, running="5"))
    assert mine.level == "fine"
    (unseen,) = base(replace(p, running="5", machine=fake(tmp_path)))  # other users' descriptors cannot be seen
    assert unseen.level == "fine" and "not asked" in unseen.text


@pytest.mark.parametrize(
    ("fault", "expected"), [("silent", "gave no answer"), ("wrong_version", "version"), ("bad_crc", "no Modbus answer")]
)
def test_a_base_that_does_not_answer_as_it_should(
    tmp_path: Path, simulated: SimBase, fault: str, expected: str
) -> None:
    setattr(simulated.model.faults, fault, True)
    config = Config(base=Base(port=simulated.port, timeout_s=0.3))
    (text,) = wrongs(base(Patient(config, tmp_path / "c.yaml", None, machine=fake(tmp_path))))
    assert expected in text


def test_a_base_that_is_absent_forbidden_or_off(tmp_path: Path, simulated: SimBase) -> None:
    config = Config(base=Base(port=str(tmp_path / "ttyUSB0")))
    p = Patient(config, tmp_path / "c.yaml", None, machine=fake(tmp_path))
    assert "no serial adapter is plugged in" in wrongs(base(p))[0]
    link = tmp_path / "dev" / "serial" / "by-id" / "usb-adapter"
    link.parent.mkdir(parents=True)
    link.touch()
    assert "usb-adapter" in wrongs(base(p))[0]
    p = replace(p, config=Config(base=Base(port=simulated.port)), machine=fake(tmp_path, writable=False))
    assert "usermod -aG" in wrongs(base(p))[0]
    assert levels(base(replace(p, config=Config(base=Base(enabled=False))))) == ["note"]


def test_zenoh_ports_and_routers(tmp_path: Path) -> None:
    def told(**settings: object) -> list[str]:
        config = Config(zenoh=Zenoh(**settings))  # type: ignore[arg-type]
        return wrongs(bus(Patient(config, tmp_path / "c.yaml", None, machine=fake(tmp_path))))

    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        end = f"tcp/127.0.0.1:{taken.getsockname()[1]}"
        assert told(listen=(end,))[0].startswith(f"zenoh.listen: {end} cannot be used: Address already in use")
        assert told(connect=(end,)) == []
    assert "does not answer: Connection refused" in told(connect=(end,))[0]
    assert told(listen=(end,)) == []
    assert "zenoh.connect: found 'nonsense'" in told(connect=("nonsense",))[0]
    assert "zenoh.config_file" in told(config_file=str(tmp_path / "absent.json5"))[0]
    assert told(enabled=False) == []


def test_a_port_that_the_running_daemon_has_is_no_fault(tmp_path: Path) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        config = Config(zenoh=Zenoh(listen=(f"tcp/127.0.0.1:{taken.getsockname()[1]}",)))
        p = Patient(config, tmp_path / "c.yaml", None, running="77", machine=fake(tmp_path))
        assert wrongs(bus(p)) == []
