"""`ceilvod run --simulate` as a process of its own, and what it says in the log and on the bus."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from patience import PATIENCE_S, until

from ceilvo.bench.soak.parts import Listener, PoseRow, free_port

_NOT_FOR_IT = ("NOTIFY_SOCKET", "WATCHDOG_USEC", "JOURNAL_STREAM", "STATE_DIRECTORY")
"""Of the environment: the tests may run under systemd themselves."""


class SimulatedDaemon:
    """Killed at the end if it still runs. Its log and summary go to `folder`."""

    def __init__(
        self,
        state_dir: Path,
        folder: Path,
        *settings: str,
        environment: Mapping[str, str] | None = None,
        enter: Sequence[str] = (),
        port: int | None = None,
        calibration: Path | None = None,
    ) -> None:
        """
        enter: what to put before the command; the process that it starts must become the daemon. port: of Zenoh.
        calibration: instead of the simulated truth.
        """
        port = port or free_port()
        self.log = folder / "ceilvod.log"
        words = ["run", "--simulate", "--summary", str(folder / "summary.json")]
        if calibration is not None:
            words += ["--calibration", str(calibration)]
        for setting in (
            f"service.state_dir={state_dir}",
            "service.state_period_s=0.5",
            "camera.rate_hz=10",
            f"zenoh.listen=[tcp/127.0.0.1:{port}]",
            "zenoh.multicast=false",
            "zenoh.health_period_s=0.1",
            *settings,
        ):
            words += ["--set", setting]
        clean = {k: v for k, v in os.environ.items() if k not in _NOT_FOR_IT}
        with self.log.open("ab") as log:
            self.process = subprocess.Popen(
                [*enter, sys.executable, "-m", "ceilvo.daemon.cli", *words],
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=subprocess.STDOUT,
                env=clean | dict(environment or {}),
            )
        self.listener = Listener(port)

    def __enter__(self) -> SimulatedDaemon:
        return self

    def __exit__(self, *_: object) -> None:
        self.listener.close()
        self.process.kill()
        self.process.wait()

    @property
    def poses(self) -> list[PoseRow]:
        return self.listener.heard.poses

    def health(self, name: str) -> object:
        """The newest value; None before the first."""
        heard = self.listener.heard.health
        return heard[-1][1].get(name) if heard else None

    def said(self) -> str:
        return self.log.read_text(errors="replace") if self.log.exists() else ""

    def until(self, true: Callable[[], object], what: str) -> None:
        def true_and_alive() -> object:
            assert self.process.poll() is None, f"it ended with {self.process.returncode}:\n{self.said()}"
            return true()

        try:
            until(true_and_alive, what)
        except AssertionError as e:
            e.add_note(f"its log:\n{self.said()}\nits health: {self.listener.heard.health[-1:]}")
            raise

    def until_poses(self, count: int) -> None:
        """So many more."""
        enough = len(self.poses) + count
        self.until(lambda: len(self.poses) >= enough, f"{count} poses")

    def until_saving(self, error: str) -> None:
        """Saving fails with this; "" for none."""
        self.until(lambda: self.health("store_error") == error or (error and error in str(self.health("store_error"))),
                   f"store_error {error!r}")  # fmt: skip

    def end(self) -> int:
        """Ask for an orderly end; the exit code."""
        self.process.send_signal(signal.SIGTERM)
        return self.process.wait(PATIENCE_S)
