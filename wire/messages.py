"""The messages on the wire: seven fields in a msgpack list, refused with a named reason when
anything is off.

Data flow: plant -> node (measurement), node -> node (running sums; state, for one that replaces a dead node),
node -> plant (command), every process -> recorder (telemetry, counters), plant -> all (stop).

A message is `[version, kind, run, tick, sender, setpoint, payload]`: five integers that say what it
is and where it belongs, the index of the active setpoint (theory, section 5: one set of sweep
matrices a setpoint; of a command: the setpoint of the tick in which it is applied), and the payload. A forward
sum that does not reach back to the root, because a sum before it did not come, says so in the highest bit of
the setpoint (`PARTIAL`).

The payload of the control kinds is their doubles as bytes, little-endian; that of the others is stated at
their encoder. Control messages come every tick, so they are written with integers of fixed width: all that
differs from tick to tick stands at a fixed place (`Outgoing`), and a receiver knows the first 32 bytes
beforehand (`Incoming`).
"""

from __future__ import annotations

import hashlib
import math
import struct
from collections.abc import Callable, Mapping, Sequence
from enum import IntEnum, StrEnum
from typing import Any, NamedTuple

import msgpack
import numpy as np
import numpy.typing as npt

from wire.errors import shown

VERSION = 4
PLANT = -1
"""The sender number of the plant; nodes send their index 0..n-1."""
FIELDS = 7
LONGEST_TEXT = 2000
"""Characters that a stop message carries at most, so that its status line stays within one pipe
write."""
LARGEST_TICK = 2**53
"""Ticks beyond this could not be told apart in a recording, whose numbers are doubles."""

_pack: Callable[[object], bytes] = msgpack.Packer(autoreset=True).pack
_HEADER = struct.Struct(">BBBBQBQBiBHBH")
"""A list of 7: version and kind in a byte each, run and tick as uint 64, sender as int 32, setpoint as uint 16,
and the head of a byte string with its length as uint 16."""
_MARKS = (0x97, 0xCF, 0xCF, 0xD2, 0xCD, 0xC5)
_TICK_AT = 13
_TICK = struct.Struct(">Q")
_TICK_TO_SETPOINT = struct.Struct(">QBiBH")
HEADER_BYTES = _HEADER.size
"""Of a control message; its doubles follow, aligned."""
MOST_NUMBERS = 0xFFFF // 8
"""Doubles that a control message can carry."""
PARTIAL = 0x8000
"""In the setpoint of a forward sum: a sum before it was missing, so that it is not of the whole arm."""
F8 = np.dtype("<f8")
Array = npt.NDArray[np.float64]


class Kind(IntEnum):
    """What a message carries."""

    MEASUREMENT = 1
    COMMAND = 2
    FORWARD_SUM = 3
    BACKWARD_SUM = 4
    TELEMETRY = 5
    COUNTERS = 6
    STOP = 7
    STATE = 8


_KINDS = frozenset(map(int, Kind))


class Reason(StrEnum):
    """Why a message was refused; the counters are kept by these names."""

    MALFORMED = "malformed"
    VERSION = "version"
    KIND = "kind"
    RUN = "run"
    SENDER = "sender"
    TICK = "tick"
    SETPOINT = "setpoint"
    LENGTH = "length"
    TYPE = "type"
    NOT_FINITE = "not_finite"
    STALE = "stale"
    EARLY = "early"
    DUPLICATE = "duplicate"
    LATE = "late"
    """A sum whose tick has gone on without it."""


class RejectedError(Exception):
    """A message that was refused; `reason` is counted, the text says what was expected and what
    came."""

    def __init__(self, reason: Reason, text: str) -> None:
        super().__init__(f"{reason.value}: {text}")
        self.reason = reason


class Numbers(NamedTuple):
    """A control message that passed every check."""

    tick: int
    sender: int
    setpoint: int
    values: list[float]
    partial: bool = False
    """Of a forward sum: `PARTIAL`."""


class Batch(NamedTuple):
    """Telemetry: one row a tick, beginning with `tick`; shape (rows, columns)."""

    tick: int
    sender: int
    rows: npt.NDArray[np.float64]


class Stop(NamedTuple):
    """The end of a run: `cause` is 'finished', 'interrupted' or 'safety', `tick` the first one not
    done."""

    tick: int
    cause: str
    text: str


def run_tag(run_id: str) -> int:
    """The 63-bit number that stands for a run id on the wire."""
    return int.from_bytes(hashlib.sha256(run_id.encode()).digest()[:8], "big") >> 1


def _header(kind: Kind, run: int, tick: int, sender: int, setpoint: int, numbers: int) -> bytes:
    """The first 32 bytes of a control message."""
    lst, u64, _, i32, u16, b16 = _MARKS
    return _HEADER.pack(
        lst, VERSION, kind, u64, run, u64, tick, i32, sender, u16, setpoint, b16, 8 * numbers
    )


def message_bytes(numbers: int) -> int:
    """Bytes of a control message that carries so many doubles."""
    return HEADER_BYTES + 8 * numbers


def encode_numbers(
    kind: Kind, run: int, tick: int, sender: int, setpoint: int, values: Sequence[float]
) -> bytes:
    """Encode a measurement, command, forward or backward sum; `values` are Python floats."""
    header = _header(kind, run, tick, sender, setpoint, len(values))
    return header + struct.pack(f"<{len(values)}d", *values)


class Outgoing:
    """One kind of message that a process sends every tick, in a buffer that is made once.

    `values` (numbers,) is the payload itself: what is written there is what the next `stamped` sends.
    ValueError for more numbers than a message can carry.
    """

    def __init__(self, kind: Kind, run: int, sender: int, numbers: int) -> None:
        if numbers > MOST_NUMBERS:
            raise ValueError(f"a message carries at most {MOST_NUMBERS} numbers, not {numbers}")
        self._sender = sender
        self._raw = bytearray(_header(kind, run, 0, sender, 0, numbers) + bytes(8 * numbers))
        self.values: Array = np.frombuffer(self._raw, F8, offset=HEADER_BYTES)

    def stamped(self, tick: int, setpoint: int) -> bytes:
        """The whole message of this tick, with the values as they are now."""
        raw = self._raw
        _TICK_TO_SETPOINT.pack_into(raw, _TICK_AT, tick, 0xD2, self._sender, 0xCD, setpoint)
        return bytes(raw)


class Incoming:
    """One kind of message that a process receives every tick: what it must look like, known beforehand.

    `lengths` gives for each setpoint how many doubles it carries. After `expect`, `values` is one
    comparison for the message that is due, and a full decoding for any other.
    """

    def __init__(self, kind: Kind, run: int, sender: int, lengths: Sequence[int]) -> None:
        self._kind, self._run, self._sender = kind, run, sender
        self._lengths = tuple(lengths)
        headers = [
            _header(kind, run, 0, sender, setpoint, numbers)
            for setpoint, numbers in enumerate(lengths)
        ]
        self._before_tick = headers[0][:_TICK_AT]
        self._after_tick = [header[_TICK_AT + _TICK.size :] for header in headers]
        self._sizes = list(map(message_bytes, lengths))
        self.header = b""
        """What the message that is due must begin with."""
        self.size = 0
        """How many bytes it must have."""
        self.expect(0, 0)

    def expect(self, tick: int, setpoint: int) -> None:
        """The message that is due now is that of this tick and setpoint."""
        Incoming.expect_all((self,), tick, setpoint)

    @staticmethod
    def expect_all(several: Sequence[Incoming], tick: int, setpoint: int) -> None:
        """The same for several kinds at once."""
        stamp = _TICK.pack(tick)
        for one in several:
            one.header = one._before_tick + stamp + one._after_tick[setpoint]
            one.size = one._sizes[setpoint]

    def due(self, raw: bytes) -> bool:
        """Whether these bytes are the message that is due; its numbers may still not be finite."""
        return len(raw) == self.size and raw.startswith(self.header)

    def decode(self, raw: bytes) -> Numbers:
        """Decode and check any message of this kind and sender; RejectedError as `decode_numbers`."""
        return decode_numbers(raw, self._kind, self._run, self._sender, self._lengths)


def numbers_of(raw: bytes) -> Array:
    """The doubles of a message that is `due`, without copying them; read-only."""
    return np.frombuffer(raw, F8, -1, HEADER_BYTES)


def encode_batch(run: int, tick: int, sender: int, rows: npt.NDArray[np.float64]) -> bytes:
    """Encode telemetry rows of shape (rows, columns), little-endian doubles in row order."""
    payload = [rows.shape[1], rows.astype(F8, copy=False).tobytes()]
    return _pack([VERSION, int(Kind.TELEMETRY), run, tick, sender, 0, payload])


def encode_counters(run: int, tick: int, sender: int, counters: Mapping[str, int]) -> bytes:
    """Encode the final counters of a process: a list of [name, number]; `tick` is the first one not
    done."""
    payload = [[name, value] for name, value in counters.items()]
    return _pack([VERSION, int(Kind.COUNTERS), run, tick, sender, 0, payload])


def encode_stop(run: int, stop: Stop) -> bytes:
    """Encode the plant's order to stop."""
    text = stop.text[:LONGEST_TEXT]
    return _pack([VERSION, int(Kind.STOP), run, stop.tick, PLANT, 0, [stop.cause, text]])


def decode_numbers(
    raw: bytes, kind: Kind, run: int, sender: int, lengths: Sequence[int]
) -> Numbers:
    """Decode and check one control message; RejectedError names the first thing that is wrong.

    `lengths` gives for each setpoint how many doubles such a message carries (a sum's rank may
    differ).
    """
    tick, came_from, setpoint, payload = _fields(raw, kind, run)
    if came_from != sender:
        raise RejectedError(Reason.SENDER, f"expected sender {sender}, got {came_from}")
    partial = kind is Kind.FORWARD_SUM and bool(setpoint & PARTIAL)
    setpoint ^= PARTIAL if partial else 0
    if not 0 <= setpoint < len(lengths):
        raise RejectedError(Reason.SETPOINT, f"expected 0..{len(lengths) - 1}, got {setpoint}")
    if type(payload) is not bytes:
        raise RejectedError(Reason.TYPE, f"expected the bytes of doubles, got {_name(payload)}")
    expected = lengths[setpoint]
    if len(payload) != 8 * expected:
        raise RejectedError(Reason.LENGTH, f"expected {expected} doubles, got {len(payload)} bytes")
    values = list(struct.unpack(f"<{expected}d", payload))
    # One sum decides the usual case; it may overflow where every term is finite.
    if not math.isfinite(sum(values)) and not all(map(math.isfinite, values)):
        at = next(i for i, value in enumerate(values) if not math.isfinite(value))
        raise RejectedError(Reason.NOT_FINITE, f"number {at} is {values[at]}")
    return Numbers(tick, came_from, setpoint, values, partial)


def decode_batch(raw: bytes, run: int, columns: Mapping[int, int]) -> Batch:
    """Decode telemetry; `columns` gives for each known sender its number of columns."""
    tick, sender, _, payload = _fields(raw, Kind.TELEMETRY, run)
    if sender not in columns:
        raise RejectedError(Reason.SENDER, f"unknown sender {sender}")
    if type(payload) is not list or len(payload) != 2 or type(payload[1]) is not bytes:
        raise RejectedError(Reason.TYPE, "expected [columns, bytes]")
    width, data = payload
    if type(width) is not int or width != columns[sender]:
        raise RejectedError(
            Reason.LENGTH, f"expected {columns[sender]} columns, got {shown(width)}"
        )
    if not data or len(data) % (8 * width):
        raise RejectedError(Reason.LENGTH, f"{len(data)} bytes are no whole number of rows")
    rows = np.frombuffer(data, dtype=F8).reshape(-1, width)
    if not np.isfinite(rows).all():
        raise RejectedError(Reason.NOT_FINITE, f"telemetry of sender {sender} from tick {tick}")
    return Batch(tick, sender, rows)


def decode_counters(raw: bytes, run: int) -> tuple[int, int, dict[str, int]]:
    """Decode final counters; returns (sender, first tick not done, counters)."""
    tick, sender, _, payload = _fields(raw, Kind.COUNTERS, run)
    if type(payload) is not list:
        raise RejectedError(Reason.TYPE, f"expected a list of counters, got {_name(payload)}")
    out: dict[str, int] = {}
    for item in payload:
        if type(item) is not list or len(item) != 2:
            raise RejectedError(Reason.TYPE, "expected [name, number]")
        name, value = item
        if type(name) is not str or type(value) is not int or value < 0:
            raise RejectedError(Reason.TYPE, "expected [name, number]")
        out[name] = value
    return sender, tick, out


def decode_stop(raw: bytes, run: int) -> Stop:
    """Decode the order to stop; only the plant may give it."""
    tick, sender, _, payload = _fields(raw, Kind.STOP, run)
    if sender != PLANT:
        raise RejectedError(Reason.SENDER, f"expected the plant, got {sender}")
    if type(payload) is not list or [type(p) for p in payload] != [str, str]:
        raise RejectedError(Reason.TYPE, "expected [cause, text]")
    cause, text = payload
    if cause not in ("finished", "interrupted", "safety"):
        raise RejectedError(Reason.TYPE, f"unknown cause {cause[:40]!r}")
    return Stop(tick, cause, text)


def kind_of(raw: bytes) -> Kind:
    """The kind of a message without checking the rest (the recorder sorts by it)."""
    kind = _unpack(raw)[1]
    if type(kind) is not int or kind not in _KINDS:
        raise RejectedError(Reason.KIND, f"unknown kind {shown(kind)}")
    return Kind(kind)


def _unpack(raw: bytes) -> list[Any]:
    try:
        fields = msgpack.unpackb(raw)
    except (ValueError, TypeError, RecursionError, msgpack.UnpackException) as error:
        raise RejectedError(Reason.MALFORMED, f"not msgpack ({type(error).__name__})") from None
    if type(fields) is not list or len(fields) != FIELDS:
        raise RejectedError(Reason.MALFORMED, f"expected a list of {FIELDS} fields")
    return fields


def _fields(raw: bytes, kind: Kind, run: int) -> tuple[int, int, int, Any]:
    """Check the fields that every kind has; returns tick, sender, setpoint, payload."""
    version, came_kind, came_run, tick, sender, setpoint, payload = _unpack(raw)
    if type(version) is not int or version != VERSION:
        raise RejectedError(Reason.VERSION, f"expected version {VERSION}, got {shown(version)}")
    if type(came_kind) is not int or came_kind != kind:
        raise RejectedError(Reason.KIND, f"expected kind {int(kind)}, got {shown(came_kind)}")
    if type(came_run) is not int or came_run != run:
        raise RejectedError(Reason.RUN, "the message belongs to another run")
    if type(tick) is not int or not 0 <= tick <= LARGEST_TICK:
        raise RejectedError(Reason.TICK, f"expected a tick number, got {shown(tick)}")
    if type(sender) is not int:
        raise RejectedError(Reason.SENDER, f"expected a number, got {shown(sender)}")
    if type(setpoint) is not int:
        raise RejectedError(Reason.SETPOINT, f"expected an index, got {shown(setpoint)}")
    return tick, sender, setpoint, payload


def _name(value: object) -> str:
    return type(value).__name__
