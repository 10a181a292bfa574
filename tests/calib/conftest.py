"""What the tests of calib share: the command, a virtual bench with few pictures, a session with a known lens."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest

from ceilvo.calib.cli import main
from ceilvo.calib.practice.virtual_bench import VirtualBench
from ceilvo.calib.session.session import Session
from ceilvo.calib.targets.board import Board
from ceilvo.calib.targets.sources import Picture
from ceilvo.sim.rig import simulated_calibration, simulated_camera

CAMERA = simulated_camera(width_px=480, height_px=360)
BOARD = Board()
Run = Callable[..., tuple[int, str, str]]


@pytest.fixture
def run(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Run:
    def call(*args: str) -> tuple[int, str, str]:
        code = main([*args, "--session", str(tmp_path / "s")])
        got = capsys.readouterr()
        return code, got.out, got.err

    return call


@pytest.fixture(scope="session")
def bench() -> VirtualBench:
    return VirtualBench(simulated_calibration(CAMERA))


def with_known_lens(folder: Path, bench: VirtualBench) -> Session:
    """A session as `calib intrinsics` leaves it, with the true lens."""
    session = Session(folder)
    lens = {"camera": asdict(bench.rig.camera), "camera_id": "ceilvo-sim", "model": "pinhole", "sigma": [0.1] * 9}
    session.save("intrinsics", lens | {"cov": np.zeros((9, 9)), "rms_px": 0.1, "verdict": "PASS"})
    return session


@pytest.fixture
def known_lens(tmp_path: Path, bench: VirtualBench) -> Session:
    return with_known_lens(tmp_path / "s", bench)


@pytest.fixture(scope="session")
def stock(bench: VirtualBench) -> dict[str, list[Picture]]:
    """Pictures of the virtual bench, drawn once."""
    return {
        "board": list(bench.board(BOARD, 8)),
        "places": list(bench.places(9)),
        "spin_and_run": list(bench.spin_and_run(24, 13, turns=1.0)),
        "stations": list(bench.stations(9, 2)),
        "drive": list(bench.drive(40, lap_fraction=0.1)),
    }


@pytest.fixture
def short(monkeypatch: pytest.MonkeyPatch, stock: dict[str, list[Picture]]) -> None:
    """The virtual bench with fewer pictures."""
    for name, pictures in stock.items():
        monkeypatch.setattr(VirtualBench, name, lambda *_, p=pictures, **__: iter(p))


@pytest.fixture(scope="session")
def projected(tmp_path_factory: pytest.TempPathFactory, bench: VirtualBench, stock: dict[str, list[Picture]]) -> Path:
    """A session with a known lens as `calib projection` leaves it, to be copied."""
    session = with_known_lens(tmp_path_factory.mktemp("projected") / "s", bench)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(VirtualBench, "places", lambda *_, **__: iter(stock["places"]))
        assert main(["projection", "--simulate", "--session", str(session.folder)]) == 0
    return session.folder
