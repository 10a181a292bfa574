"""`ceilvod` in processes of their own, forked from one that has all modules: a start takes no seconds.

Run as a program it is that one: a line of JSON for each daemon comes in, its process id goes out, then its exit code.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
from pathlib import Path
from types import TracebackType

from patience import PATIENCE_S

_NOT_FOR_IT = ("NOTIFY_SOCKET", "WATCHDOG_USEC", "JOURNAL_STREAM", "STATE_DIRECTORY")
"""Of the environment: the tests may run under systemd themselves."""


class Forks:
    """One daemon at a time, each in a process of its own. A recording in place of a camera is read without pauses."""

    def __init__(self, world_seed: int | None = None) -> None:
        """world_seed: of the world whose ceiling every simulated daemon finds drawn."""
        environment = {k: v for k, v in os.environ.items() if k not in _NOT_FOR_IT}
        self._running: int | None = None
        self._server = subprocess.Popen(
            [sys.executable, __file__, *([] if world_seed is None else [str(world_seed)])],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env=environment | {"PYTHONPATH": str(Path(__file__).parent)},
        )

    def __enter__(self) -> Forks:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        assert self._server.stdin is not None
        self._server.stdin.close()
        if self._running is not None:
            os.kill(self._running, signal.SIGKILL)
        self._server.wait()
        assert self._server.stdout is not None
        self._server.stdout.close()

    def start(self, arguments: list[str], log: Path) -> int:
        """The process id of a daemon that says all it says to a file."""
        assert self._server.stdin is not None
        log.touch()
        self._server.stdin.write(json.dumps([arguments, str(log)]) + "\n")
        self._server.stdin.flush()
        self._running = self._answer()
        return self._running

    def ended(self) -> int:
        """Wait for the end of the one that was started: its exit code, below 0 for a signal."""
        code, self._running = self._answer(), None
        return code

    def run(self, arguments: list[str], log: Path) -> int:
        """The exit code of one that ends by itself; killed where it does not."""
        pid = self.start(arguments, log)
        watch = threading.Timer(PATIENCE_S, os.kill, (pid, signal.SIGKILL))
        watch.start()
        try:
            return self.ended()
        finally:
            watch.cancel()

    def _answer(self) -> int:
        assert self._server.stdout is not None
        return int(self._server.stdout.readline())


def _serve() -> None:
    import cv2
    import drawn_once

    import ceilvo.daemon.app.simulation
    import ceilvo.drivers.bus.zenoh_bus  # noqa: F401 - the forks have both
    from ceilvo.daemon.app import process
    from ceilvo.sim.world import World, WorldSpec

    cv2.setNumThreads(1)
    process.PacedCamera = lambda camera: camera  # type: ignore[assignment,misc]
    drawn_once.share()
    for seed in sys.argv[1:]:
        _ = World(WorldSpec(seed=int(seed))).renderer
    for line in sys.stdin:
        pid = os.fork()
        if not pid:
            _be_daemon(*json.loads(line))
        print(pid, flush=True)
        print(os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]), flush=True)


def _be_daemon(arguments: list[str], log: str) -> None:
    from ceilvo.daemon import cli

    to = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_APPEND)
    for stream in (1, 2):
        os.dup2(to, stream)
    os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
    code = 1
    try:
        code = cli.main(arguments)
    except BaseException:
        import traceback

        traceback.print_exc()
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)


if __name__ == "__main__":
    _serve()
