"""A patient of the doctor on a machine where all is well, but for what a test makes wrong."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

from ceilvo.config import CalibrationFile, Camera, Config
from ceilvo.daemon.doctor.findings import Finding, Patient
from ceilvo.daemon.doctor.system import INSTALLED, PACKAGED
from ceilvo.drivers.camera.v4l2_device import LinuxDevice
from ceilvo.drivers.camera.v4l2_query import Control, Offer, Size
from ceilvo.drivers.host.machine import Done, Machine
from ceilvo.errors import CameraError

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
