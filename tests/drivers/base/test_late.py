"""The driver of the base is loaded by the link's thread, not on the way to the first pose."""

from __future__ import annotations

import subprocess
import sys

import pytest

from ceilvo import config
from ceilvo.drivers.base.late import late_modbus
from ceilvo.drivers.base.protocol import no_estimate
from ceilvo.errors import BaseLinkError

LOOK = """
import sys
from ceilvo.config import Config
from ceilvo.daemon import cli
from ceilvo.drivers.base.late import late_modbus
from ceilvo.errors import BaseLinkError
base = late_modbus(Config().base)
base.close()
before = "pymodbus" in sys.modules
try:
    base.open()
except BaseLinkError as e:
    print(before, "pymodbus" in sys.modules, base.is_open, e)
"""


def test_what_the_robot_runs_loads_pymodbus_when_the_port_is_opened() -> None:
    done = subprocess.run([sys.executable, "-c", LOOK], capture_output=True, text=True, check=True)
    assert done.stdout.startswith("False True False base port /dev/ttyUSB0: cannot be opened"), done


def test_before_it_is_opened_it_exchanges_nothing() -> None:
    base = late_modbus(config.Base())
    assert not base.is_open
    with pytest.raises(BaseLinkError, match="not opened"):
        base.exchange(no_estimate(1))
