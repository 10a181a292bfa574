"""A base whose driver is loaded when it is first opened, so that loading it holds nobody else up."""

from __future__ import annotations

from collections.abc import Callable

from ceilvo import config
from ceilvo.drivers.ports import Base
from ceilvo.drivers.telegrams import BaseStatus, PoseTelegram
from ceilvo.errors import BaseLinkError


class LateBase:
    """drivers.ports.Base that makes the real one in `open`, which BaseLink calls in its own thread."""

    def __init__(self, make: Callable[[], Base]) -> None:
        self._make = make
        self._base: Base | None = None

    @property
    def is_open(self) -> bool:
        return self._base is not None and self._base.is_open

    def open(self) -> None:
        if self._base is None:
            self._base = self._make()
        self._base.open()

    def exchange(self, telegram: PoseTelegram) -> BaseStatus:
        if self._base is None:
            raise BaseLinkError("base: not opened yet; open it before exchanging telegrams")
        return self._base.exchange(telegram)

    def close(self) -> None:
        if self._base is not None:
            self._base.close()


def late_modbus(settings: config.Base) -> LateBase:
    """ModbusBase. pymodbus with asyncio and ssl took a tenth of the time from a start to the first pose, and 8 MB."""

    def make() -> Base:
        from ceilvo.drivers.base.modbus import ModbusBase

        return ModbusBase(settings)

    return LateBase(make)
