"""Ranges over Zenoh: what is taken, what is refused in one line."""

from __future__ import annotations

import json
from typing import Any

import pytest
import zenoh
from patience import until

from ceilvo.config import Zenoh
from ceilvo.drivers.bus.zenoh_session import session_config
from ceilvo.drivers.ranging.mailbox import Mailbox
from ceilvo.drivers.ranging.topic import RangesTopic, decode_ranges
from ceilvo.errors import BusError

KEY = "here/r/ranges"
GOOD = {
    "schema": "ceilvo.ranges.1",
    "ranges": [{"anchor": "0c14", "range_m": 3.25, "age_ms": 40}, {"anchor": "0CA8", "range_m": 7, "more": 1}],
}


def test_the_golden_message() -> None:
    assert decode_ranges(json.dumps(GOOD).encode()) == ((("0C14", 3.25), 0.04), (("0CA8", 7.0), 0.0))


def changed(**row: Any) -> bytes:
    return json.dumps({**GOOD, "ranges": [{**GOOD["ranges"][0], **row}]}).encode()  # type: ignore[dict-item]


@pytest.mark.parametrize(
    ("payload", "says"),
    [
        (b"{", "not JSON"),
        (json.dumps({**GOOD, "schema": "ceilvo.ranges.2"}).encode(), "expected 'ceilvo.ranges.1'"),
        (json.dumps({"schema": "ceilvo.ranges.1"}).encode(), "expected a list"),
        (json.dumps({**GOOD, "ranges": [1]}).encode(), "ranges[0] is 1"),
        (changed(anchor=""), "anchor is ''"),
        (changed(anchor=7), "anchor is 7"),
        (changed(range_m=-1.0), "range_m is -1.0, expected 0 to 1000"),
        (changed(range_m="3"), "range_m is '3'"),
        (changed(range_m=True), "range_m is True"),
        (changed(age_ms=1e9), "age_ms is 1000000000.0"),
        (b" " * 20_000, "20000 bytes"),
    ],
)
def test_what_is_wrong_is_said_in_one_line_and_counted(payload: bytes, says: str) -> None:
    with pytest.raises(BusError) as e:
        decode_ranges(payload)
    assert says in str(e.value) and "\n" not in str(e.value)
    mailbox = Mailbox()
    topic = RangesTopic("k", mailbox)
    topic.take(payload)
    assert topic.counters() == {"messages": 0, "malformed": 1} and mailbox.take(2**62) == ()


def test_it_comes_over_the_wire_with_its_age() -> None:
    now_ns = 10**10
    mailbox = Mailbox()
    topic = RangesTopic(KEY, mailbox, lambda: now_ns)
    with zenoh.open(session_config(Zenoh(multicast=False, listen=("tcp/127.0.0.1:0",)))) as session:
        topic.declare(session)
        session.put(KEY, json.dumps(GOOD).encode())
        until(lambda: topic.counters()["messages"] == 1)
    assert [(r.anchor, r.stamp_ns, r.range_m) for r in mailbox.take(now_ns)] == [
        ("0C14", now_ns - 40_000_000, 3.25),
        ("0CA8", now_ns, 7.0),
    ]
