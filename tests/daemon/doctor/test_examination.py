"""The doctor on a machine where all is well, and with each thing wrong that it looks for."""

from __future__ import annotations

import ctypes
import errno
import json
import socket
import struct
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from datetime import datetime, timezone
from pathlib import Path

import numpy as np
import pytest

from ceilvo.calibration_file import write_calibration
from ceilvo.config import Base, CalibrationFile, Camera, Config, Service, Zenoh
from ceilvo.config.rendering import render_config
from ceilvo.daemon import cli
from ceilvo.daemon.doctor.camera import calibration, camera
from ceilvo.daemon.doctor.findings import Finding, Patient
from ceilvo.daemon.doctor.links import base, bus
from ceilvo.daemon.doctor.system import INSTALLED, PACKAGED, clock, daemon_state, disk, limits, unit_file
from ceilvo.drivers.camera.recorded import write_folder
from ceilvo.drivers.camera.v4l2_device import LinuxDevice
from ceilvo.drivers.camera.v4l2_query import (
    ENUM_FMT,
    ENUM_FRAMEINTERVALS,
    ENUM_FRAMESIZES,
    QUERYCAP,
    QUERYCTRL,
    Control,
    Offer,
    Size,
    query,
)
from ceilvo.drivers.host.machine import Done, Machine
from ceilvo.errors import CameraError
from ceilvo.sim.base import SimBase
from ceilvo.sim.rig import simulated_calibration, simulated_camera
from ceilvo.types import Frame

GOOD_OFFER = Offer(
    "a camera",
    "uvcvideo",
    True,
    {"YUYV": (Size((640, 480), (640, 480)), Size((1280, 720), (1280, 720))), "MJPG": (Size((640, 480), (640, 480)),)},
    30.0,
    {"exposure": Control(3, 2047, True), "gain": Control(0, 100, True)},
)
RUNNING = "LoadState=loaded\nActiveState=active\nMainPID=77\nStatusText=TRACKING x=1.00 m\nExecMainStatus=0"
MEMORY = "MemTotal: 4000000 kB\nMemAvailable:    2000000 kB\n"


@dataclass(frozen=True)
class Fake(Machine):
    """A computer where all is well; a field changed makes one thing wrong."""

    answers: dict[str, Done | None] = field(default_factory=dict)
    held: tuple[str, ...] = ()
    writable: bool = True
    free: int = 10**11

    def run(self, *command: str) -> Done | None:
        good = {
            "systemctl show": Done(0, RUNNING + "\nNeedDaemonReload=no\nUnitFileState=enabled"),
            "systemd-analyze verify": Done(0, ""),
            "timedatectl show": Done(0, "yes"),
        }
        name = " ".join(command[:2])
        return self.answers[name] if name in self.answers else good[name]

    def holders(self, node: str) -> list[str]:
        return list(self.held)

    def may_write(self, path: Path) -> bool:
        return self.writable

    def group_of(self, path: Path) -> str:
        return "video"

    def free_bytes(self, folder: Path) -> int:
        return self.free


def fake(tmp_path: Path, **changes: object) -> Fake:
    for name, text in ((INSTALLED, "[Unit]\n"), (PACKAGED, "[Unit]\n"), ("/proc/meminfo", MEMORY)):
        file = tmp_path / name.lstrip("/")
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(text)
    return Fake(root=tmp_path, **changes)  # type: ignore[arg-type]


@pytest.fixture
def node(tmp_path: Path) -> str:
    """A stable name as udev makes them; /dev/null is a device node that is always there."""
    link = tmp_path / "dev" / "v4l" / "by-id" / "usb-a-camera"
    link.parent.mkdir(parents=True)
    link.symlink_to("/dev/null")
    return str(link)


def patient(
    tmp_path: Path, node: str, offer: Offer | None = GOOD_OFFER, running: str = "", **changes: object
) -> Patient:
    config = Config(
        camera=Camera(device=node, exposure_us=10000.0, gain=10.0), calibration=CalibrationFile("calibration.yaml")
    )

    def ask(device: str, fourcc: str, width_px: int, height_px: int) -> Offer:
        if offer is None:
            raise CameraError(f"{device}: does not answer as a video device: Inappropriate ioctl for device")
        return offer

    machine = fake(tmp_path, **changes)
    return Patient(
        config, tmp_path / "config.yaml", None, running, machine, LinuxDevice(tmp_path / "dev", tmp_path / "sys"), ask
    )


def wrongs(findings: Iterator[Finding] | list[Finding]) -> list[str]:
    return [f.text for f in findings if f.level == "wrong"]


def levels(findings: Iterator[Finding] | list[Finding]) -> list[str]:
    return [f.level for f in findings]


# -- all is well, with real parts


@pytest.fixture
def simulated() -> Iterator[SimBase]:
    with SimBase(baud=115200) as running:
        yield running


@pytest.fixture
def whole(tmp_path: Path, simulated: SimBase) -> Path:
    """A configuration whose camera is a folder of pictures and whose base is a process on a pseudo-terminal."""
    model = simulated_camera("pinhole", 96, 72)
    found = replace(simulated_calibration(model), created=datetime.now(timezone.utc).date().isoformat())
    write_calibration(tmp_path / "calibration.yaml", found)
    write_folder(tmp_path / "frames", [Frame(i, i + 1, np.zeros((72, 96), np.uint8)) for i in range(2)])
    (tmp_path / "state").mkdir()
    config = Config(
        camera=Camera(source="folder", path=str(tmp_path / "frames"), width_px=96, height_px=72),
        base=Base(port=simulated.port),
        zenoh=Zenoh(multicast=False),
        service=Service(state_dir=str(tmp_path / "state")),
    )
    (tmp_path / "config.yaml").write_text(render_config(config))
    return tmp_path / "config.yaml"


def test_all_is_well(whole: Path, simulated: SimBase, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["doctor", "--config", str(whole)]) == 0
    lines = capsys.readouterr().out.splitlines()
    found = {line[6:18].strip(): line[:5].strip() for line in lines}
    assert all(found[c] == "OK" for c in ("config", "camera", "calibration", "base", "zenoh", "limits")), lines
    assert any("answers in protocol version 1" in line for line in lines)
    assert len(simulated.telegrams) == 0, "a doctor must not tell the base a pose"


def test_what_is_wrong_is_told_with_exit_code_1(whole: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["doctor", "--config", str(whole), "--set", "base.port=/dev/ttyNO", "--json"]) == 1
    told = json.loads(capsys.readouterr().out)
    (bad,) = (f for f in told["findings"] if f["level"] == "wrong")
    assert told["ok"] is False and bad["check"] == "base"
    assert "/dev/ttyNO: no such device" in bad["text"]


def test_a_wrong_configuration_does_not_hide_the_rest(whole: Path, capsys: pytest.CaptureFixture[str]) -> None:
    whole.write_text("camera:\n  width_px: many\n  colour: true\n")
    assert cli.main(["doctor", "--config", str(whole)]) == 1
    out = capsys.readouterr().out
    assert out.count("WRONG config") == 2 and "limits" in out


# -- camera


def test_a_good_camera(tmp_path: Path, node: str) -> None:
    assert levels(camera(patient(tmp_path, node))) == ["fine", "fine", "fine"]


def offer(**changes: object) -> Offer:
    return replace(GOOD_OFFER, **changes)  # type: ignore[arg-type]


BAD_CAMERAS: dict[str, tuple[dict[str, object], str]] = {
    "no permission": ({"writable": False}, "usermod -aG video"),
    "no video device": ({"offer": None}, "does not answer as a video device"),
    "metadata node": ({"offer": offer(captures=False)}, "gives no pictures"),
    "in use": ({"held": ("cheese (pid 9)",)}, "in use by cheese (pid 9): only one can have it"),
    "in use, our daemon too": ({"held": ("cheese (pid 9)", "ceilvod (pid 77)"), "running": "77"}, "in use by cheese"),
    "format": ({"offer": offer(sizes={"MJPG": ()})}, "YUYV is not offered, found MJPG; set it to MJPG"),
    "size": (
        {"offer": offer(sizes={"YUYV": (Size((320, 240), (320, 240)),)})},
        "not offered at 640x480, found 320x240",
    ),
    "step": ({"offer": offer(sizes={"YUYV": (Size((2, 1), (999, 999), (7, 1)),)})}, "found 2x1 to 999x999"),
    "rate": ({"offer": offer(max_rate_hz=15.0)}, "camera.rate_hz: 30 is more than the 15"),
    "no exposure": ({"offer": offer(controls={"gain": Control(0, 100, True)})}, "no exposure that can be set"),
    "read-only": ({"offer": offer(controls={**GOOD_OFFER.controls, "gain": Control(0, 9, False)})}, "no gain that can"),
    "exposure": ({"offer": offer(controls={**GOOD_OFFER.controls, "exposure": Control(1, 50, True)})}, "100 to 5000"),
    "gain": ({"offer": offer(controls={**GOOD_OFFER.controls, "gain": Control(0, 9, True)})}, "range, 0 to 9"),
}


@pytest.mark.parametrize("name", BAD_CAMERAS)
def test_what_can_be_wrong_with_a_camera(tmp_path: Path, node: str, name: str) -> None:
    changes, expected = BAD_CAMERAS[name]
    (text,) = wrongs(camera(patient(tmp_path, node, **changes)))  # type: ignore[arg-type]
    assert expected in text


def test_a_camera_that_is_not_there(tmp_path: Path, node: str) -> None:
    Path(node).unlink()
    (text,) = wrongs(camera(patient(tmp_path, node)))
    assert "no such device" in text and "no camera at all" in text


def test_the_daemons_own_hold_is_fine(tmp_path: Path, node: str) -> None:
    found = list(camera(patient(tmp_path, node, running="77", held=("ceilvod (pid 77)",))))
    assert not wrongs(found) and "in use by ceilvod (pid 77)" in found[0].text


def test_automatic_exposure_is_worth_a_note(tmp_path: Path, node: str) -> None:
    p = patient(tmp_path, node)
    assert p.config is not None
    p = replace(p, config=replace(p.config, camera=replace(p.config.camera, exposure_us=None, gain=None)))
    assert levels(camera(p)) == ["fine", "fine", "note"]


def test_a_recording_that_is_not_there(tmp_path: Path) -> None:
    config = Config(camera=Camera(source="folder", path=str(tmp_path / "absent")))
    (text,) = wrongs(camera(Patient(config, tmp_path / "config.yaml", None, machine=fake(tmp_path))))
    assert "no such folder" in text


# -- calibration


def calibrated(p: Patient, camera_id: str = "", created: str = "2100-11-01", width_px: int = 640) -> Patient:
    model = simulated_camera("pinhole", width_px, 480)
    found = replace(simulated_calibration(model), camera_id=camera_id, created=created)
    write_calibration(p.config_path.parent / "calibration.yaml", found, force=True)
    return p


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"camera_id": "another serial"}, "camera id 'usb-a-camera', expected 'another serial'"),
        ({"width_px": 800}, "640 x 480 pixels, expected 800 x 480"),
    ],
)
def test_a_calibration_that_does_not_fit(
    tmp_path: Path, node: str, changes: dict[str, object], expected: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(LinuxDevice, "identity", lambda self, node: "usb-a-camera")
    (text,) = wrongs(calibration(calibrated(patient(tmp_path, node), **changes)))  # type: ignore[arg-type]
    assert expected in text


def test_a_calibration_that_is_absent_damaged_or_old(tmp_path: Path, node: str) -> None:
    p = patient(tmp_path, node)
    assert "no such file" in wrongs(calibration(p))[0]
    calibrated(p)
    file = p.config_path.parent / "calibration.yaml"
    file.write_text(file.read_text().replace("2100-11-01", "2100-11-02"))
    assert "checksum" in wrongs(calibration(p))[0]
    (old,) = calibration(calibrated(p, created="2001-01-01"))
    assert old.level == "note" and "days old; 'calib check'" in old.text
    assert levels(calibration(calibrated(p, created=""))) == ["fine"]


# -- base and bus


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


# -- the computer


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
    assert levels(unit_file(fake(tmp_path))) == ["fine"]
    shown = "systemctl show"
    bad = {
        "verify: x.service:7: Unknown key": {"systemd-analyze verify": Done(1, "x.service:7: Unknown key\nmore")},
        "daemon-reload": {shown: Done(0, "NeedDaemonReload=yes\nUnitFileState=enabled")},
    }
    for expected, answers in bad.items():
        (text,) = wrongs(unit_file(fake(tmp_path, answers=answers)))
        assert expected in text
    disabled = fake(tmp_path, answers={shown: Done(0, "NeedDaemonReload=no\nUnitFileState=disabled")})
    assert levels(unit_file(disabled)) == ["note", "fine"]
    machine = fake(tmp_path)
    machine.path(INSTALLED).write_text("[Unit]\n# edited\n")
    assert "differs from the package's" in wrongs(unit_file(machine))[0]
    machine.path(INSTALLED).unlink()
    assert list(unit_file(machine)) == []


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
    assert "map.json" in wrongs(disk(fake(tmp_path), folder, config))[0]


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


# -- the machine and the ioctls, against what the kernel says


def test_rights_of_another_user(tmp_path: Path) -> None:
    """`nobody` is on every Linux; files are this process's own."""
    file = tmp_path / "device"
    file.touch()
    machine = Machine(user="nobody")
    for mode, may in ((0o600, False), (0o660, False), (0o666, True), (0o664, False)):
        file.chmod(mode)
        assert machine.may_write(file) is may, oct(mode)
    assert Machine().may_write(file)
    assert Machine(user="root").may_write(file)
    assert not Machine(user="no-such-user").may_write(file)


def test_who_holds_a_device(tmp_path: Path) -> None:
    for pid, opened in ((12, "/dev/video0"), (13, "/dev/video1")):
        (tmp_path / "proc" / str(pid) / "fd").mkdir(parents=True)
        (tmp_path / "proc" / str(pid) / "comm").write_text("cheese\n")
        (tmp_path / "proc" / str(pid) / "fd" / "3").symlink_to(opened)
    assert Machine(root=tmp_path).holders("/dev/video0") == ["cheese (pid 12)"]
    assert Machine(root=tmp_path).holders("/dev/video2") == []
    (tmp_path / "proc" / "13" / "fd" / "4").symlink_to("/dev/pts/3")
    assert Machine(root=tmp_path).holders("/dev/pts/3") == ["cheese (pid 13)"]
    (tmp_path / "proc" / "13" / "fd" / "5").symlink_to("/dev/ptmx")  # the other end: a simulated base
    assert Machine(root=tmp_path).holders("/dev/pts/3") == []


def test_programs(tmp_path: Path) -> None:
    assert Machine().run("echo", "a word") == Done(0, "a word")
    assert Machine().run("no-such-program-here") is None


def test_ioctl_numbers_are_the_kernels() -> None:
    """As `strace` shows them for v4l2-ctl on x86-64 and ARM."""
    assert [hex(c) for c in (QUERYCAP, ENUM_FMT, QUERYCTRL, ENUM_FRAMESIZES, ENUM_FRAMEINTERVALS)] == [
        "0x80685600",
        "0xc0405602",
        "0xc0445624",
        "0xc02c564a",
        "0xc034564b",
    ]


class Capability(ctypes.Structure):
    """struct v4l2_capability of videodev2.h, laid out by the C rules."""

    _fields_ = [
        ("driver", ctypes.c_char * 16),
        ("card", ctypes.c_char * 32),
        ("bus_info", ctypes.c_char * 32),
        ("version", ctypes.c_uint32),
        ("capabilities", ctypes.c_uint32),
        ("device_caps", ctypes.c_uint32),
        ("reserved", ctypes.c_uint32 * 3),
    ]


class FormatDescription(ctypes.Structure):
    _fields_ = [
        ("index", ctypes.c_uint32),
        ("type", ctypes.c_uint32),
        ("flags", ctypes.c_uint32),
        ("description", ctypes.c_char * 32),
        ("pixelformat", ctypes.c_uint32),
        ("mbus_code", ctypes.c_uint32),
        ("reserved", ctypes.c_uint32 * 3),
    ]


class FrameSize(ctypes.Structure):
    _fields_ = [
        ("index", ctypes.c_uint32),
        ("pixel_format", ctypes.c_uint32),
        ("type", ctypes.c_uint32),
        ("sizes", ctypes.c_uint32 * 6),
        ("reserved", ctypes.c_uint32 * 2),
    ]


class FrameInterval(ctypes.Structure):
    _fields_ = [
        ("index", ctypes.c_uint32),
        ("pixel_format", ctypes.c_uint32),
        ("width", ctypes.c_uint32),
        ("height", ctypes.c_uint32),
        ("type", ctypes.c_uint32),
        ("fractions", ctypes.c_uint32 * 6),
        ("reserved", ctypes.c_uint32 * 2),
    ]


class QueryControl(ctypes.Structure):
    _fields_ = [
        ("id", ctypes.c_uint32),
        ("type", ctypes.c_uint32),
        ("name", ctypes.c_char * 32),
        ("minimum", ctypes.c_int32),
        ("maximum", ctypes.c_int32),
        ("step", ctypes.c_int32),
        ("default_value", ctypes.c_int32),
        ("flags", ctypes.c_uint32),
        ("reserved", ctypes.c_uint32 * 2),
    ]


def fourcc(name: str) -> int:
    return int(struct.unpack("<I", name.encode())[0])


def kernel(fd: int, code: int, raw: bytearray) -> None:
    """A camera: YUYV at 640x480 (30 and 15 Hz) and MJPG at any size; exposure, and a gain that is disabled."""
    if code == QUERYCAP:
        c = Capability.from_buffer(raw)
        c.driver, c.card, c.capabilities, c.device_caps = b"uvcvideo", b"A camera: it", 0x80000000 | 0x1, 0x1
        return
    if code == QUERYCTRL:
        q = QueryControl.from_buffer(raw)
        if q.id not in (0x009A0902, 0x00980913):
            raise OSError(errno.EINVAL, "Invalid argument")
        q.minimum, q.maximum, q.flags = (3, 2047, 0) if q.id == 0x009A0902 else (0, 9, 0x1)
        return
    index = struct.unpack_from("<I", raw)[0]
    if code == ENUM_FMT and index < 2:
        f = FormatDescription.from_buffer(raw)
        assert f.type == 1
        f.pixelformat = fourcc(("YUYV", "MJPG")[index])
    elif code == ENUM_FRAMESIZES and index < 1:
        s = FrameSize.from_buffer(raw)
        yuyv = s.pixel_format == fourcc("YUYV")
        s.type, values = (1, (640, 480)) if yuyv else (3, (32, 1920, 2, 32, 1080, 4))
        s.sizes[: len(values)] = values
    elif code == ENUM_FRAMEINTERVALS and index < 2:
        i = FrameInterval.from_buffer(raw)
        assert (i.pixel_format, i.width, i.height) == (fourcc("YUYV"), 640, 480)
        i.type, i.fractions[0], i.fractions[1] = 1, 1, (30, 15)[index]
    else:
        raise OSError(errno.EINVAL, "Invalid argument")


def test_a_device_is_asked_as_the_kernel_wants_it() -> None:
    found = query("/dev/null", "YUYV", 640, 480, kernel)
    assert (found.card, found.driver, found.captures, found.max_rate_hz) == ("A camera: it", "uvcvideo", True, 30.0)
    assert found.sizes["YUYV"] == (Size((640, 480), (640, 480)),)
    assert found.sizes["MJPG"] == (Size((32, 32), (1920, 1080), (2, 4)),)
    assert found.sizes["MJPG"][0].has(640, 480) and not found.sizes["MJPG"][0].has(641, 480)
    assert found.controls == {"exposure": Control(3, 2047, True)}


def test_what_is_no_video_device_says_so(tmp_path: Path) -> None:
    for path in ("/dev/null", str(tmp_path / "absent")):
        with pytest.raises(CameraError, match=path):
            query(path, "YUYV", 640, 480)
