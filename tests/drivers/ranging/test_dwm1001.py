"""The module's words and bytes, as the guide has them."""

from __future__ import annotations

import struct

import pytest

from ceilvo.drivers.ranging.dwm1001 import LOC_GET, lec_line, les_line, tlv_answer, tlv_size
from ceilvo.errors import RangingError

LES = "1151[5.00,8.00,2.25]=6.48 0CA8[0.00,8.00,2.25]=6.51 111C[5.00,0.00,2.25]=3.18 le_us=2576 est[6.97,5.17,-1.77,53]"
LEC = (
    "DIST,3,AN0,1151,5.00,8.00,2.25,6.44,AN1,0CA8,0.00,8.00,2.25,6.50,AN2,111C,5.00,0.00,2.25,3.24,"
    "POS,6.95,5.37,-1.97,52"
)
TLV = bytes.fromhex(
    "40 01 00"
    "41 0d 4b 00 00 00 1f 00 00 00 0f 00 00 00 64"
    "49 29 02"
    "51 11 50 19 00 00 64 88 13 00 00 40 1f 00 00 ca 08 00 00 64"
    "a8 0c 6e 19 00 00 5f 00 00 00 00 40 1f 00 00 ca 08 00 00 64"
)
"""Position (75, 31, 15) mm of quality 100, and two anchors: 1151 at 6480 mm and 0CA8 at 6510 mm, with their places."""


def test_golden_lines() -> None:
    assert les_line(LES) == (("1151", 6.48), ("0CA8", 6.51), ("111C", 3.18))
    assert lec_line(LEC) == (("1151", 6.44), ("0CA8", 6.5), ("111C", 3.24))


def test_golden_bytes() -> None:
    assert LOC_GET == b"\x0c\x00"
    assert tlv_size(TLV) == len(TLV)
    assert tlv_answer(TLV) == (("1151", 6.48), ("0CA8", 6.51))
    anchor = (
        bytes.fromhex("40 01 00 41 0d") + bytes(13) + bytes.fromhex("48 0e 01 01 02 03 04 05 06 ca de e8 03 00 00 64")
    )
    assert tlv_answer(anchor) == (("DECA060504030201", 1.0),)


@pytest.mark.parametrize(
    "line", ["", "dwm> les", "dwm>", " DWM1001 TWR Real Time Location System", "Copyright :  2016-2019", "dwm> lec"]
)
def test_what_the_shell_says_besides_is_passed_over(line: str) -> None:
    assert les_line(line) is None and lec_line(line) is None


def test_a_tag_without_anchors_says_an_empty_round() -> None:
    assert les_line("le_us=488") == ()
    assert lec_line("POS,6.95,5.37,-1.97,52") is None
    assert tlv_answer(bytes.fromhex("40 01 00 41 0d") + bytes(13) + bytes.fromhex("49 01 00")) == ()


@pytest.mark.parametrize(
    ("line", "says"),
    [
        (LES.replace("=6.48", "=-6.48"), "'-6.48'"),
        (LES.replace("6.48", "6.4.8"), "6.4.8"),
        (LES.replace("=6.48", "=99999"), "expected 0 to 1000 m"),
        ("1151[5.00,8.00,2.25] le_us=2576", "without distances"),
    ],
)
def test_a_damaged_line_is_told_in_one(line: str, says: str) -> None:
    with pytest.raises(RangingError) as e:
        les_line(line)
    assert says in str(e.value) and "\n" not in str(e.value)


@pytest.mark.parametrize("line", [LEC[:60], LEC.replace("DIST,3", "DIST,x"), LEC.replace("AN1", "XX1"), "DIST"])
def test_a_line_that_is_cut_short_is_told(line: str) -> None:
    with pytest.raises(RangingError, match=r"cut short|distance ''"):
        lec_line(line)


def test_every_cut_of_an_answer_is_waited_for_or_refused() -> None:
    for n in range(1, len(TLV)):
        assert tlv_size(TLV[:n]) in (None, len(TLV)), n
        with pytest.raises(RangingError):
            tlv_answer(TLV[:n])


@pytest.mark.parametrize(
    ("answer", "says"),
    [
        (bytes.fromhex("40 01 04"), "return code 4 (busy)"),
        (bytes.fromhex("40 01 63"), "return code 99"),
        (b"dwm> ", "expected 0x40"),
        (bytes.fromhex("40 02 00 00"), "return code of 2 bytes"),
        (bytes.fromhex("40 01 00 77 01 00"), "part 0x77"),
        (bytes.fromhex("40 01 00 49 03 02 00 00"), "expected a count and 20 for each"),
        (bytes.fromhex("40 01 00 49 15 01 51 11") + struct.pack("<I", 2_000_000) + bytes(14), "2000 m to 1151"),
    ],
)
def test_wrong_answers_are_told(answer: bytes, says: str) -> None:
    with pytest.raises(RangingError) as e:
        tlv_answer(answer)
    assert says in str(e.value)
