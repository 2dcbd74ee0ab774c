"""The wire's codec and mutated messages: every decoder refuses with a reason, or gives what is in the bytes."""

from __future__ import annotations

import math
import struct
from collections.abc import Callable
from typing import Any

import msgpack
import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from mutations import bytes_of, outcome

from wire.messages import (
    LARGEST_TICK,
    PLANT,
    VERSION,
    Incoming,
    Kind,
    Reason,
    RejectedError,
    Stop,
    decode_batch,
    decode_counters,
    decode_numbers,
    decode_stop,
    encode_batch,
    encode_counters,
    encode_numbers,
    encode_stop,
    kind_of,
    run_tag,
)

RUN = run_tag("fuzz")
LENGTHS = [3, 5]
NOT_FINITE = (math.nan, math.inf, -math.inf)
CONTROL = (Kind.MEASUREMENT, Kind.COMMAND, Kind.FORWARD_SUM, Kind.BACKWARD_SUM)
ROWS = np.arange(8.0).reshape(2, 4)
COUNTERS = {"rejected_messages": 0, "command_sent_messages": 12}
STOP = Stop(12, "finished", "all 12 ticks done")


def numbers_raw(kind: Kind = Kind.COMMAND) -> bytes:
    return encode_numbers(kind, RUN, 7, 2, 0, [1.0, -2.5, 1e300])


Decode = Callable[[bytes], Any]
DECODERS: dict[str, tuple[bytes, Decode]] = {
    "numbers": (numbers_raw(), lambda raw: decode_numbers(raw, Kind.COMMAND, RUN, 2, LENGTHS)),
    "batch": (encode_batch(RUN, 7, 2, ROWS), lambda raw: decode_batch(raw, RUN, {2: 4, PLANT: 9})),
    "counters": (encode_counters(RUN, 12, 2, COUNTERS), lambda raw: decode_counters(raw, RUN)),
    "stop": (encode_stop(RUN, STOP), lambda raw: decode_stop(raw, RUN)),
}


def nested(levels: int) -> bytes:
    """msgpack's list in a list in a list."""
    return b"\x91" * levels + b"\xc0"


def with_field(raw: bytes, at: int, field: bytes) -> bytes:
    """One of the seven fields replaced with what msgpack reads there."""
    fields = [msgpack.packb(one) for one in msgpack.unpackb(raw)]
    fields[at] = field
    return b"\x97" + b"".join(fields)


@pytest.mark.parametrize("name", DECODERS)
@given(data=st.data())
def test_a_mutated_message_is_refused_or_has_the_values_that_are_in_its_bytes(
    name: str, data: st.DataObject
) -> None:
    good, decode = DECODERS[name]
    raw = data.draw(bytes_of(good))
    got, refusal = outcome(lambda: decode(raw), RejectedError)
    if got is None:
        assert refusal.partition(":")[0] in set(Reason)
        assert len(refusal) < 300
        return
    fields = msgpack.unpackb(raw)
    assert fields[0] == VERSION and fields[2] == RUN and 0 <= fields[3] <= LARGEST_TICK
    assert fields[3] in got
    if name == "numbers":
        assert struct.pack(f"<{len(got.values)}d", *got.values) == fields[6]
        assert all(map(math.isfinite, got.values))
    elif name == "batch":
        assert np.isfinite(got.rows).all()


@given(bytes_of(numbers_raw()))
def test_only_a_message_that_decodes_is_ever_due(raw: bytes) -> None:
    incoming = Incoming(Kind.COMMAND, RUN, 2, LENGTHS)
    incoming.expect(7, 0)
    if incoming.due(raw):
        assert raw[:32] == numbers_raw()[:32]


@pytest.mark.parametrize("name", DECODERS)
@pytest.mark.parametrize("at", range(7))
@pytest.mark.parametrize("levels", [2, 200, 990, 1023, 5000])
def test_lists_nested_as_deeply_as_msgpack_reads_are_refused(
    name: str, at: int, levels: int
) -> None:
    """The text of a refusal must not follow them down: at 990 levels Python's stack ends."""
    good, decode = DECODERS[name]
    raw = with_field(good, at, nested(levels))
    for decoder in (decode, kind_of) if at == 1 else (decode,):
        with pytest.raises(RejectedError):
            decoder(raw)


HEADS = {
    "a list of 2**32 - 1 fields": b"\xdd\xff\xff\xff\xff",
    "a byte string of 4 GB": b"\x97\x03\xc6\xff\xff\xff\xff",
    "a map of 2**32 - 1 keys": b"\xdf\xff\xff\xff\xff",
    "a text of 4 GB": b"\xdb\xff\xff\xff\xff",
    "an extension of 4 GB": b"\xc9\xff\xff\xff\xff\x01",
    "a timestamp of no length": b"\xc7\x00\xff",
    "a timestamp with too many nanoseconds": b"\xd7\xff" + b"\xff" * 8,
    "a byte that msgpack never uses": b"\xc1",
    "nothing": b"",
}


@pytest.mark.parametrize("head", HEADS)
def test_a_length_that_claims_gigabytes_is_refused_at_once(head: str) -> None:
    for _, decode in DECODERS.values():
        for raw in (HEADS[head], b"\x97" + HEADS[head], b"\x97" + b"\x00" * 6 + HEADS[head]):
            with pytest.raises(RejectedError) as refused:
                decode(raw)
            assert refused.value.reason in (Reason.MALFORMED, Reason.VERSION)


FIELDS = ("version", "kind", "run", "tick", "sender", "setpoint", "payload")
REASONS = {
    "version": Reason.VERSION,
    "kind": Reason.KIND,
    "run": Reason.RUN,
    "tick": Reason.TICK,
    "sender": Reason.SENDER,
    "setpoint": Reason.SETPOINT,
    "payload": Reason.TYPE,
}
OF_NO_TYPE: tuple[Any, ...] = (
    None,
    True,
    1.0,
    math.nan,
    math.inf,
    -math.inf,
    "1",
    [],
    {},
    [1],
    {"a": math.nan},
)


@pytest.mark.parametrize("kind", CONTROL)
@pytest.mark.parametrize("field", FIELDS)
@pytest.mark.parametrize("value", OF_NO_TYPE, ids=repr)
def test_each_field_of_another_type_is_refused_by_its_name(
    kind: Kind, field: str, value: Any
) -> None:
    raw = with_field(numbers_raw(kind), FIELDS.index(field), msgpack.packb(value))
    with pytest.raises(RejectedError) as refused:
        decode_numbers(raw, kind, RUN, 2, LENGTHS)
    assert refused.value.reason is REASONS[field]


@pytest.mark.parametrize("kind", CONTROL)
@given(values=st.lists(st.floats(allow_nan=False, allow_infinity=False), min_size=3, max_size=3))
@pytest.mark.parametrize("at", range(3))
@pytest.mark.parametrize("bad", NOT_FINITE)
def test_a_number_that_is_not_finite_is_refused_wherever_it_stands(
    kind: Kind, values: list[float], at: int, bad: float
) -> None:
    good = encode_numbers(kind, RUN, 7, 2, 0, values)
    assert decode_numbers(good, kind, RUN, 2, LENGTHS).values == values
    values[at] = bad
    with pytest.raises(RejectedError) as refused:
        decode_numbers(encode_numbers(kind, RUN, 7, 2, 0, values), kind, RUN, 2, LENGTHS)
    assert refused.value.reason is Reason.NOT_FINITE


@given(
    st.integers(0, 7), st.sampled_from(NOT_FINITE), st.integers(0, LARGEST_TICK), st.integers(1, 4)
)
def test_telemetry_comes_back_or_is_refused_for_one_number(
    at: int, bad: float, tick: int, width: int
) -> None:
    rows = np.linspace(-1e300, 1e300, 8 * width).reshape(8, width)
    got = decode_batch(encode_batch(RUN, tick, 2, rows), RUN, {2: width})
    assert (got.tick, got.sender) == (tick, 2)
    assert got.rows.tobytes() == rows.tobytes()
    rows[at, at % width] = bad
    with pytest.raises(RejectedError) as refused:
        decode_batch(encode_batch(RUN, tick, 2, rows), RUN, {2: width})
    assert refused.value.reason is Reason.NOT_FINITE


@given(
    st.dictionaries(st.text(max_size=20), st.integers(0, 2**64 - 1), max_size=8),
    st.integers(0, 2**53),
)
def test_counters_come_back(counters: dict[str, int], tick: int) -> None:
    assert decode_counters(encode_counters(RUN, tick, 3, counters), RUN) == (3, tick, counters)


@given(
    st.text(max_size=2000),
    st.sampled_from(["finished", "interrupted", "safety"]),
    st.integers(0, 2**53),
)
@example("", "finished", 0)
def test_the_order_to_stop_comes_back(text: str, cause: str, tick: int) -> None:
    assert decode_stop(encode_stop(RUN, Stop(tick, cause, text)), RUN) == Stop(tick, cause, text)
