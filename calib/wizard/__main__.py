"""`python -m ceilvo.calib.wizard`, as `ceilvod web` starts it: commands come in, messages go out (wire.py)."""

from __future__ import annotations

import os
import sys
import traceback
from pathlib import Path
from typing import NoReturn

from ceilvo.calib.wizard.bench import Bench, Place
from ceilvo.calib.wizard.tuning import Tuning
from ceilvo.calib.wizard.wire import Wire
from ceilvo.config.reader import parse_config


def main() -> NoReturn:
    try:
        _work()
    except BaseException:
        traceback.print_exc()
    sys.stderr.flush()
    os._exit(1)  # the thread that reads commands cannot be woken


def _work() -> None:
    out = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # what steps print is for the journal
    wire = Wire(out, sys.stdin.buffer)
    hello = wire.command(wait=True) or {}
    named = str(hello["config_file"])
    place = Place(
        parse_config(str(hello["config"]), named or "the configuration"),
        Path(named) if named else None,
        Path(str(hello["folder"])),
        bool(hello["simulate"]),
    )
    bench, tuning = Bench(place, wire), Tuning(place, wire)
    bench.tell()
    while True:
        command = wire.command(wait=True) or {}
        if command.get("do") in ("tune", "save_camera"):
            left = tuning.obey(command)
            bench.obey({"do": "look"} if left is None else left)
        else:
            bench.obey(command)


if __name__ == "__main__":
    main()
