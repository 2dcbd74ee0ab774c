"""The wire codec: what is sent comes back exactly, and everything else is refused with a reason."""

from __future__ import annotations

import math
import struct
from typing import Any

import msgpack
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from wire.messages import (
    HEADER_BYTES,
    MOST_NUMBERS,
    PLANT,
    VERSION,
    Incoming,
    Kind,
    Outgoing,
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
    numbers_of,
    run_tag,
)

RUN = run_tag("a run")
finite = st.floats(allow_nan=False, allow_infinity=False)
anything = st.recursive(
    st.none()
    | st.booleans()
    | st.integers(-(2**63), 2**64 - 1)
    | st.floats()
    | st.text()
    | st.binary(),
    lambda inner: st.lists(inner, max_size=8) | st.dictionaries(st.text(), inner, max_size=4),
    max_leaves=20,
)


control = st.sampled_from([Kind.MEASUREMENT, Kind.COMMAND, Kind.FORWARD_SUM, Kind.BACKWARD_SUM])
ticks = st.integers(0, 2**53)
senders = st.integers(-1, 10_000)


def doubles(*values: float) -> bytes:
    """A payload: little-endian doubles."""
    return struct.pack(f"<{len(values)}d", *values)


def bits(values: Any) -> list[bytes]:
    return [struct.pack("<d", value) for value in values]


def message(**changes: Any) -> bytes:
    """A good forward sum from node 2 with fields replaced, as msgpack itself writes it."""
    fields: dict[str, Any] = {
        "version": VERSION,
        "kind": int(Kind.FORWARD_SUM),
        "run": RUN,
        "tick": 7,
        "sender": 2,
        "setpoint": 0,
        "payload": doubles(1.0, 2.0, 3.0),
    }
    return bytes(msgpack.packb(list((fields | changes).values())))


def refusal(raw: bytes) -> Reason:
    with pytest.raises(RejectedError) as caught:
        decode_numbers(raw, Kind.FORWARD_SUM, RUN, 2, [3, 5])
    return caught.value.reason


@given(
    values=st.lists(finite, max_size=12),
    tick=ticks,
    sender=senders,
    setpoint=st.integers(0, 2),
)
def test_numbers_come_back_bit_by_bit(
    values: list[float], tick: int, sender: int, setpoint: int
) -> None:
    raw = encode_numbers(Kind.COMMAND, RUN, tick, sender, setpoint, values)
    got = decode_numbers(raw, Kind.COMMAND, RUN, sender, [len(values)] * 3)
    assert (got.tick, got.sender, got.setpoint) == (tick, sender, setpoint)
    assert [v.hex() for v in got.values] == [v.hex() for v in values]


@given(
    st.lists(finite, min_size=3, max_size=3),
    st.integers(0, 2),
    st.sampled_from([math.nan, math.inf, -math.inf]),
)
def test_every_non_finite_number_is_refused(values: list[float], at: int, bad: float) -> None:
    values[at] = bad
    assert refusal(message(payload=doubles(*values))) is Reason.NOT_FINITE
    good = encode_numbers(Kind.FORWARD_SUM, RUN, 7, 2, 0, values)
    assert refusal(good) is Reason.NOT_FINITE


def test_large_finite_numbers_are_not_mistaken_for_infinite_ones() -> None:
    values = [1.7e308, 1.7e308, 1.7e308]
    got = decode_numbers(message(payload=doubles(*values)), Kind.FORWARD_SUM, RUN, 2, [3])
    assert got.values == values


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"version": 1}, Reason.VERSION),
        ({"version": 0}, Reason.VERSION),
        ({"version": VERSION - 1}, Reason.VERSION),
        ({"version": str(VERSION)}, Reason.VERSION),
        ({"version": True}, Reason.VERSION),
        ({"version": float(VERSION)}, Reason.VERSION),
        ({"kind": int(Kind.BACKWARD_SUM)}, Reason.KIND),
        ({"kind": 99}, Reason.KIND),
        ({"kind": 3.0}, Reason.KIND),
        ({"run": RUN + 1}, Reason.RUN),
        ({"run": None}, Reason.RUN),
        ({"tick": -1}, Reason.TICK),
        ({"tick": 2**53 + 1}, Reason.TICK),
        ({"tick": 7.0}, Reason.TICK),
        ({"tick": False}, Reason.TICK),
        ({"sender": 3}, Reason.SENDER),
        ({"sender": PLANT}, Reason.SENDER),
        ({"sender": "2"}, Reason.SENDER),
        ({"setpoint": 2}, Reason.SETPOINT),
        ({"setpoint": -1}, Reason.SETPOINT),
        ({"setpoint": 0.0}, Reason.SETPOINT),
        ({"setpoint": 1}, Reason.LENGTH),
        ({"payload": doubles(1.0, 2.0)}, Reason.LENGTH),
        ({"payload": doubles(1.0, 2.0, 3.0, 4.0)}, Reason.LENGTH),
        ({"payload": doubles(1.0, 2.0, 3.0)[:-1]}, Reason.LENGTH),
        ({"payload": b""}, Reason.LENGTH),
        ({"payload": [1.0, 2.0, 3.0]}, Reason.TYPE),
        ({"payload": []}, Reason.TYPE),
        ({"payload": "a" * 24}, Reason.TYPE),
        ({"payload": {"a": 1.0}}, Reason.TYPE),
        ({"payload": 3.0}, Reason.TYPE),
        ({"payload": None}, Reason.TYPE),
        ({"extra": 1}, Reason.MALFORMED),
    ],
)
def test_one_wrong_field_is_refused_by_its_name(changes: dict[str, Any], reason: Reason) -> None:
    assert refusal(message(**changes)) is reason


GOOD = [message(), encode_numbers(Kind.FORWARD_SUM, RUN, 7, 2, 0, [1.0, 2.0, 3.0])]
"""One message in the two forms that it may have."""


@given(st.sampled_from(GOOD), st.data())
def test_truncated_messages_are_refused(raw: bytes, data: st.DataObject) -> None:
    assert refusal(raw[: data.draw(st.integers(0, len(raw) - 1))]) is Reason.MALFORMED


@given(st.sampled_from(GOOD), st.binary(min_size=1, max_size=40))
def test_messages_with_something_behind_them_are_refused(raw: bytes, more: bytes) -> None:
    assert refusal(raw + more) is Reason.MALFORMED


@given(st.binary(max_size=200) | anything.map(msgpack.packb))
def test_no_input_does_anything_but_decode_or_be_refused(raw: bytes) -> None:
    for decode in (
        lambda: decode_numbers(raw, Kind.FORWARD_SUM, RUN, 2, [3]),
        lambda: decode_batch(raw, RUN, {2: 4}),
        lambda: decode_counters(raw, RUN),
        lambda: decode_stop(raw, RUN),
    ):
        with pytest.raises(RejectedError):
            decode()


@given(st.binary(max_size=200) | anything.map(msgpack.packb))
def test_only_seven_fields_with_a_known_kind_have_one(raw: bytes) -> None:
    """`kind_of` looks at nothing else: seven zeros with a 1 in second place do have a kind."""
    try:
        fields = msgpack.unpackb(raw)
    except (ValueError, TypeError, RecursionError, msgpack.UnpackException):
        fields = None
    seven = isinstance(fields, list) and len(fields) == 7
    known = seven and type(fields[1]) is int and fields[1] in list(Kind)
    if known:
        assert kind_of(raw) is Kind(fields[1])
    else:
        with pytest.raises(RejectedError):
            kind_of(raw)


def test_a_kind_is_read_without_checking_the_rest() -> None:
    raw = b"\x97\x00\x01\x00\x00\x00\x00\x00"
    assert kind_of(raw) is Kind(1)
    with pytest.raises(RejectedError):
        decode_numbers(raw, Kind(1), RUN, 2, [3])


@given(st.lists(anything, min_size=7, max_size=7))
def test_seven_fields_of_anything_are_refused(fields: list[Any]) -> None:
    raw = msgpack.packb(fields)
    with pytest.raises(RejectedError):
        decode_numbers(raw, Kind.FORWARD_SUM, RUN, 2, [3])
    with pytest.raises(RejectedError):
        decode_counters(raw, RUN)


@given(st.sampled_from(GOOD), st.data())
def test_a_flipped_bit_never_passes_for_another_header(good: bytes, data: st.DataObject) -> None:
    raw = bytearray(good)
    bit = data.draw(st.integers(0, 8 * len(raw) - 1))
    raw[bit // 8] ^= 1 << (bit % 8)
    try:
        got = decode_numbers(bytes(raw), Kind.FORWARD_SUM, RUN, 2, [3])
    except RejectedError:
        return
    # What passes differs in tick or numbers only: links are checked by the transport, not here.
    assert (got.sender, got.setpoint, len(got.values)) == (2, 0, 3)
    assert all(map(math.isfinite, got.values))


# -- messages of every tick ----------------------------------------------------------------------------------


@given(
    kind=control,
    sender=senders,
    tick=ticks,
    setpoint=st.integers(0, 2**16 - 1),
    values=st.lists(st.floats(), max_size=12),
)
def test_a_stamped_message_is_the_encoded_one_and_msgpack_of_seven_fields(
    kind: Kind, sender: int, tick: int, setpoint: int, values: list[float]
) -> None:
    outgoing = Outgoing(kind, RUN, sender, len(values))
    outgoing.values[:] = values
    raw = outgoing.stamped(tick, setpoint)
    assert raw == encode_numbers(kind, RUN, tick, sender, setpoint, outgoing.values.tolist())
    *fields, payload = msgpack.unpackb(raw)
    assert fields == [VERSION, int(kind), RUN, tick, sender, setpoint]
    assert payload == doubles(*values)


@given(st.lists(st.tuples(ticks, st.integers(0, 3), finite), min_size=2, max_size=5))
def test_messages_of_one_buffer_are_apart(messages: list[tuple[int, int, float]]) -> None:
    """What is sent later changes nothing in what has been sent."""
    outgoing = Outgoing(Kind.COMMAND, RUN, 4, 2)
    sent = []
    for tick, setpoint, value in messages:
        outgoing.values[:] = value
        sent.append(outgoing.stamped(tick, setpoint))
    for (tick, setpoint, value), raw in zip(messages, sent, strict=True):
        assert raw == encode_numbers(Kind.COMMAND, RUN, tick, 4, setpoint, [value, value])


def test_the_header_is_32_bytes_and_the_doubles_behind_it_are_aligned() -> None:
    assert HEADER_BYTES == 32
    for kind in (Kind.MEASUREMENT, Kind.COMMAND, Kind.FORWARD_SUM, Kind.BACKWARD_SUM):
        for tick, sender in ((0, PLANT), (127, 0), (128, 200), (2**53, 10_000)):
            raw = encode_numbers(kind, RUN, tick, sender, 2, [1.0, 2.0])
            assert len(raw) == 32 + 16
            assert raw[32:] == doubles(1.0, 2.0)
            values = numbers_of(raw)
            assert values.flags.aligned
            assert values.ctypes.data % 8 == 0
    assert Outgoing(Kind.COMMAND, RUN, 0, 3).values.flags.aligned


@given(st.lists(st.floats(), max_size=12))
def test_the_numbers_of_a_message_have_its_bits_and_are_read_only(values: list[float]) -> None:
    raw = encode_numbers(Kind.COMMAND, RUN, 3, 1, 0, values)
    got = numbers_of(raw)
    assert bits(got) == bits(values)
    assert not got.flags.writeable


identity = st.fixed_dictionaries(
    {
        "kind": control,
        "run": st.integers(0, 2**63 - 1),
        "tick": ticks,
        "sender": senders,
        "setpoint": st.integers(0, 2),
        "count": st.integers(1, 6),
    }
)


def encoded(who: dict[str, Any]) -> bytes:
    return encode_numbers(
        who["kind"], who["run"], who["tick"], who["sender"], who["setpoint"], [0.5] * who["count"]
    )


def receiver(who: dict[str, Any]) -> Incoming:
    """One that waits for this message; the sums of its setpoints differ in length."""
    lengths = [who["count"] + setpoint - who["setpoint"] for setpoint in range(3)]
    incoming = Incoming(who["kind"], who["run"], who["sender"], [max(0, n) for n in lengths])
    incoming.expect(who["tick"], who["setpoint"])
    return incoming


@given(
    identity,
    identity,
    st.sets(st.sampled_from(["kind", "run", "tick", "sender", "setpoint", "count"])),
)
def test_exactly_the_message_that_is_expected_is_due(
    who: dict[str, Any], other: dict[str, Any], fields: set[str]
) -> None:
    came = who | {field: other[field] for field in fields}
    assert receiver(who).due(encoded(came)) == (came == who)


@given(identity, st.integers(0, HEADER_BYTES - 1), st.integers(1, 255))
def test_no_byte_of_the_header_may_be_another(who: dict[str, Any], at: int, change: int) -> None:
    raw = bytearray(encoded(who))
    raw[at] ^= change
    assert not receiver(who).due(bytes(raw))


@given(identity, st.integers(-40, 40).filter(bool))
def test_a_message_that_is_due_has_its_length(who: dict[str, Any], more: int) -> None:
    raw = encoded(who)
    assert not receiver(who).due(raw[:more] if more < 0 else raw + bytes(more))


@given(identity, st.lists(st.floats(), min_size=6, max_size=6))
def test_any_doubles_may_be_in_a_message_that_is_due(
    who: dict[str, Any], values: list[float]
) -> None:
    """Whether they are finite is checked by those who use them, see `decode_numbers` and node.block."""
    raw = encoded(who)[:HEADER_BYTES] + doubles(*values[: who["count"]])
    assert receiver(who).due(raw)
    assert bits(numbers_of(raw)) == bits(values[: who["count"]])


@given(identity, identity)
def test_what_is_expected_changes_with_every_call(
    who: dict[str, Any], later: dict[str, Any]
) -> None:
    incoming = Incoming(who["kind"], who["run"], who["sender"], [who["count"]] * 3)
    for now in (who, who | {"tick": later["tick"], "setpoint": later["setpoint"]}, who):
        incoming.expect(now["tick"], now["setpoint"])
        for one in (who, later):
            came = who | {"tick": one["tick"], "setpoint": one["setpoint"]}
            assert incoming.due(encoded(came)) == (came == now)


@given(identity)
def test_another_encoding_of_a_message_is_not_due_but_decodes_to_the_same_numbers(
    who: dict[str, Any],
) -> None:
    """msgpack writes integers as short as they are: the same message for `decode`."""
    raw = encoded(who)
    again = bytes(msgpack.packb(msgpack.unpackb(raw)))
    incoming = receiver(who)
    assert incoming.decode(again) == incoming.decode(raw)
    assert incoming.decode(raw).values == [0.5] * who["count"]
    assert incoming.due(raw)
    assert incoming.due(again) == (raw == again)


@given(st.binary(max_size=200) | anything.map(msgpack.packb))
def test_a_receiver_decodes_or_refuses_as_decode_numbers_does(raw: bytes) -> None:
    incoming = Incoming(Kind.FORWARD_SUM, RUN, 2, [3, 5])
    assert not incoming.due(raw)
    with pytest.raises(RejectedError) as caught:
        incoming.decode(raw)
    assert caught.value.reason is refusal(raw)


@pytest.mark.parametrize("more", [1, 100])
def test_more_numbers_than_a_message_carries_are_refused(more: int) -> None:
    too_many = MOST_NUMBERS + more
    with pytest.raises(ValueError, match=f"at most {MOST_NUMBERS} numbers, not {too_many}"):
        Outgoing(Kind.MEASUREMENT, RUN, PLANT, too_many)
    with pytest.raises((ValueError, struct.error)):
        encode_numbers(Kind.MEASUREMENT, RUN, 0, PLANT, 0, [0.0] * too_many)


def test_as_many_numbers_as_a_message_carries_come_back() -> None:
    outgoing = Outgoing(Kind.MEASUREMENT, RUN, PLANT, MOST_NUMBERS)
    outgoing.values[:] = np.random.default_rng(1).standard_normal(MOST_NUMBERS)
    raw = outgoing.stamped(5, 1)
    incoming = Incoming(Kind.MEASUREMENT, RUN, PLANT, [MOST_NUMBERS] * 2)
    incoming.expect(5, 1)
    assert incoming.due(raw)
    assert np.array_equal(numbers_of(raw), outgoing.values)
    assert incoming.decode(raw).values == outgoing.values.tolist()


# -- the other kinds ------------------------------------------------------------------------------------------


@given(rows=st.integers(1, 6), columns=st.integers(1, 9), seed=st.integers(0, 99))
def test_batches_come_back(rows: int, columns: int, seed: int) -> None:
    sent = np.random.default_rng(seed).normal(size=(rows, columns))
    got = decode_batch(encode_batch(RUN, 5, 3, sent), RUN, {3: columns})
    assert (got.tick, got.sender) == (5, 3)
    assert np.array_equal(got.rows, sent)
    for wrong in ({3: columns + 1}, {4: columns}):
        with pytest.raises(RejectedError):
            decode_batch(encode_batch(RUN, 5, 3, sent), RUN, wrong)


def test_a_batch_with_a_non_finite_number_is_refused() -> None:
    with pytest.raises(RejectedError, match="not_finite"):
        decode_batch(encode_batch(RUN, 0, 1, np.array([[0.0, np.nan]])), RUN, {1: 2})


def test_counters_and_stop_come_back() -> None:
    counters = {"a": 1, "b": 2**40}
    assert decode_counters(encode_counters(RUN, 9, 4, counters), RUN) == (4, 9, counters)
    stop = Stop(12, "safety", "tick 12: node 3 …")
    assert decode_stop(encode_stop(RUN, stop), RUN) == stop
    with pytest.raises(RejectedError, match="run"):
        decode_stop(encode_stop(RUN + 1, stop), RUN)
    with pytest.raises(RejectedError, match="cause"):
        decode_stop(encode_stop(RUN, stop._replace(cause="lunch")), RUN)


def test_runs_have_tags_of_their_own() -> None:
    tags = {run_tag(f"run {i}") for i in range(1000)}
    assert len(tags) == 1000
    assert all(0 <= tag < 2**63 for tag in tags)
