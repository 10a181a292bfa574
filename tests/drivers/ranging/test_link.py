"""A module at the other end of a real pty, which speaks as a DWM1001 does."""

from __future__ import annotations

import os
import threading
import tty
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import pytest
from patience import until

from ceilvo.config import Beacons
from ceilvo.drivers.ranging.link import RangingLink
from ceilvo.drivers.ranging.mailbox import Mailbox

HERE = Path(__file__).parent
LES = b"1151[5.00,8.00,2.25]=6.48 0CA8[0.00,8.00,2.25]=6.51 le_us=2576 est[6.97,5.17,-1.77,53]\r\n"
TLV = bytes.fromhex("40 01 00 41 0d") + bytes(13) + bytes.fromhex("49 15 01 51 11 50 19 00 00 64") + bytes(13)


@dataclass
class Module:
    """The other end of the line; `answers` makes what it says of what it reads."""

    answers: Callable[[bytes], bytes]
    read: bytes = b""
    master: int = -1
    port: str = ""
    thread: threading.Thread = field(init=False)

    def __post_init__(self) -> None:
        self.master, slave = os.openpty()
        tty.setraw(slave)
        self.port, self._slave = os.ttyname(slave), slave
        self.thread = threading.Thread(target=self._run, daemon=True)
        self.thread.start()

    def say(self, data: bytes) -> None:
        os.write(self.master, data)

    def _run(self) -> None:
        while True:
            try:
                got = os.read(self.master, 256)
            except OSError:
                return
            self.read += got
            answer = self.answers(got)
            if answer:
                os.write(self.master, answer)

    def close(self) -> None:
        os.close(self._slave)
        os.close(self.master)


@pytest.fixture
def closing() -> Iterator[list[Callable[[], object]]]:
    todo: list[Callable[[], object]] = []
    yield todo
    for close in reversed(todo):
        close()


def linked(closing: list[Callable[[], object]], module: Module, protocol: str) -> tuple[RangingLink, Mailbox]:
    closing.append(module.close)
    mailbox = Mailbox()
    link = RangingLink(Beacons(port=module.port, protocol=protocol, rate_hz=50.0), mailbox)
    closing.append(link.stop)
    link.start()
    return link, mailbox


def taken(mailbox: Mailbox) -> list[tuple[str, float]]:
    return [(r.anchor, r.range_m) for r in mailbox.take(2**62)]


def test_lines_that_are_on_already_are_left_on(closing: list[Callable[[], object]]) -> None:
    module = Module(lambda got: b"")
    link, mailbox = linked(closing, module, "les")
    until(lambda: link.snapshot().opened == 1)
    until(lambda: module.say(LES) or link.snapshot().rounds >= 3)
    assert taken(mailbox)[:2] == [("1151", 6.48), ("0CA8", 6.51)]
    assert module.read == b"", "the same command would switch them off"


def test_a_module_that_is_silent_is_asked_for_its_lines(closing: list[Callable[[], object]]) -> None:
    module = Module(lambda got: LES * 3 if b"les" in got else b"dwm> ")
    link, mailbox = linked(closing, module, "les")
    until(lambda: link.snapshot().rounds >= 3)
    assert module.read == b"\r\rles\r"
    assert len(taken(mailbox)) == 6 and link.snapshot().up


def test_a_line_in_pieces_and_one_that_is_damaged(closing: list[Callable[[], object]]) -> None:
    module = Module(lambda got: b"")
    link, mailbox = linked(closing, module, "les")
    until(lambda: link.snapshot().opened == 1)
    module.say(LES[:20])
    module.say(LES[20:] + LES.replace(b"=6.48", b"=6.4x8") + b"\xff\xfe\r\n" + LES)
    until(lambda: link.snapshot().rounds == 2)
    assert link.snapshot().damaged == 1 and "6.4" in link.snapshot().last_error
    assert len(taken(mailbox)) == 4


def test_binary_answers_are_asked_for(closing: list[Callable[[], object]]) -> None:
    module = Module(lambda got: TLV if got == b"\x0c\x00" else b"")
    link, mailbox = linked(closing, module, "tlv")
    until(lambda: link.snapshot().rounds >= 3)
    assert taken(mailbox)[:2] == [("1151", 6.48), ("1151", 6.48)]


def test_a_port_that_is_not_there_is_named_and_waited_for() -> None:
    link = RangingLink(Beacons(port="/dev/no_such_module", protocol="les"), Mailbox())
    link.start()
    until(lambda: link.snapshot().last_error)
    link.stop()
    error = link.snapshot().last_error
    assert "/dev/no_such_module" in error and "dialout" in error and "\n" not in error


def test_the_mailbox_gives_each_range_once_and_not_before_its_time() -> None:
    mailbox = Mailbox()
    mailbox.put((("A", 1.0), ("B", 2.0)), 100)
    mailbox.put((("A", 1.1),), 200)
    assert [r.range_m for r in mailbox.take(150)] == [1.0, 2.0]
    assert [r.range_m for r in mailbox.take(250)] == [1.1]
    assert mailbox.take(10**18) == ()
