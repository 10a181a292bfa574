"""Can the serial line carry the pose rate? Modbus RTU arithmetic for the base telegrams (docs/base-protocol.md)."""

from __future__ import annotations

from dataclasses import dataclass

from ceilvo.config import Base

_POSE_REGISTERS, _STATUS_REGISTERS = {1: 19, 2: 20}, {1: 10, 2: 16}
"""Of the blocks by protocol version (docs/base-protocol.md)."""

_GAP_CHARS, _GAP_FAST_S, _GAP_FAST_BAUD = 3.5, 0.00175, 19200
"""MODBUS over serial line 1.02, 2.5.1.1."""

_HOST_POLL_CHARS = 8
_HOST_POLL_MIN_S = 0.002
"""pymodbus takes an answer as complete when two polls, 4 characters or 1 ms apart, agree."""


def pose_registers(version: int) -> int:
    """Of the pose block; those of version 1 for one that is not known."""
    return _POSE_REGISTERS.get(version, _POSE_REGISTERS[1])


def status_registers(version: int) -> int:
    """Of the status block, likewise."""
    return _STATUS_REGISTERS.get(version, _STATUS_REGISTERS[1])


def _transactions(function: str, version: int) -> tuple[tuple[int, int], ...]:
    """(request bytes, response bytes) of each transaction of one telegram, address and CRC included."""
    pose, status = 2 * pose_registers(version), 2 * status_registers(version)
    return ((13 + pose, 5 + status),) if function == "fc23" else ((9 + pose, 8), (8, 5 + status))


def bits_per_char(parity: str) -> int:
    """Start, 8 data, parity, stop; without parity Modbus RTU asks for a second stop bit, so it is always 11."""
    return 1 + 8 + (parity != "N") + stop_bits(parity)


def stop_bits(parity: str) -> int:
    """2 without parity (MODBUS over serial line, 2.5.1): a device set to 8N1 understands it too."""
    return 2 if parity == "N" else 1


def frame_gap_s(baud: int, parity: str) -> float:
    """Silence of 3.5 characters between frames; 1.75 ms above 19200 baud (MODBUS over serial line, 2.5.1.1)."""
    return _GAP_FAST_S if baud > _GAP_FAST_BAUD else _GAP_CHARS * bits_per_char(parity) / baud


@dataclass(frozen=True, slots=True)
class WireBudget:
    """How long one telegram takes on the line.

    Attributes:
        char_s: time of one character.
        request_bytes, response_bytes: of all transactions of one telegram.
        transactions: 1 (FC23) or 2 (FC16, then FC04).
        gap_s, turnaround_s, host_s: per transaction: each of the two silences, the base's and the host's time.
        cycle_s: one telegram, everything included.
        answer_s: longest time from the start of a request to the end of its answer.
        status_response_s: time of the answer that carries the base's status.
        rate_hz, timeout_s: what the configuration asks for.
    """

    baud: int
    parity: str
    char_s: float
    request_bytes: int
    response_bytes: int
    transactions: int
    gap_s: float
    turnaround_s: float
    host_s: float
    cycle_s: float
    answer_s: float
    status_response_s: float
    rate_hz: float
    timeout_s: float

    @property
    def max_rate_hz(self) -> float:
        return 1.0 / self.cycle_s

    @property
    def fits(self) -> bool:
        """The line carries rate_hz."""
        return self.rate_hz <= self.max_rate_hz

    @property
    def timeout_fits(self) -> bool:
        """An answer of normal length arrives within timeout_s; otherwise every telegram would fail."""
        return self.answer_s <= self.timeout_s

    @property
    def arithmetic(self) -> str:
        """The sum in one line, for messages."""
        count = f"{self.transactions} x " if self.transactions > 1 else ""
        return (
            f"({self.request_bytes} + {self.response_bytes}) bytes x {bits_per_char(self.parity)} bits"
            f" / {self.baud} baud = {_ms((self.request_bytes + self.response_bytes) * self.char_s)}"
            f" + {count}(2 gaps of {_ms(self.gap_s)} + turnaround {_ms(self.turnaround_s)} + host {_ms(self.host_s)})"
            f" = {_ms(self.cycle_s)}, at most {self.max_rate_hz:.1f} Hz"
        )


def _ms(seconds: float) -> str:
    return f"{1e3 * seconds:.2f} ms"


def wire_budget(base: Base) -> WireBudget:
    """The budget of one pose telegram and its answer with the base's settings."""
    char_s = bits_per_char(base.parity) / base.baud
    gap_s = frame_gap_s(base.baud, base.parity)
    turnaround_s = 1e-3 * base.turnaround_ms
    host_s = max(_HOST_POLL_CHARS * char_s, _HOST_POLL_MIN_S)
    frames = _transactions(base.function, base.protocol)
    request_bytes, response_bytes = sum(f[0] for f in frames), sum(f[1] for f in frames)
    overhead_s = 2 * gap_s + turnaround_s + host_s
    return WireBudget(
        baud=base.baud,
        parity=base.parity,
        char_s=char_s,
        request_bytes=request_bytes,
        response_bytes=response_bytes,
        transactions=len(frames),
        gap_s=gap_s,
        turnaround_s=turnaround_s,
        host_s=host_s,
        cycle_s=(request_bytes + response_bytes) * char_s + len(frames) * overhead_s,
        answer_s=max(sum(f) for f in frames) * char_s + gap_s + turnaround_s + host_s,
        status_response_s=frames[-1][1] * char_s,
        rate_hz=base.rate_hz,
        timeout_s=base.timeout_s,
    )
