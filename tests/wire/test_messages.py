"""The wire codec: what is sent comes back exactly, and everything else is refused with a reason."""

from __future__ import annotations

import math
from typing import Any

import msgpack
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from wire.messages import (
    PLANT,
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


def message(**changes: Any) -> bytes:
    """A good forward sum from node 2 with fields replaced."""
    fields: dict[str, Any] = {
        "version": 2,
        "kind": int(Kind.FORWARD_SUM),
        "run": RUN,
        "tick": 7,
        "sender": 2,
        "setpoint": 0,
        "payload": [1.0, 2.0, 3.0],
    }
    return bytes(msgpack.packb(list((fields | changes).values())))


def refusal(raw: bytes) -> Reason:
    with pytest.raises(RejectedError) as caught:
        decode_numbers(raw, Kind.FORWARD_SUM, RUN, 2, [3, 5])
    return caught.value.reason


@given(
    values=st.lists(finite, max_size=12),
    tick=st.integers(0, 2**53),
    sender=st.integers(-1, 10_000),
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
    assert refusal(message(payload=values)) is Reason.NOT_FINITE


def test_large_finite_numbers_are_not_mistaken_for_infinite_ones() -> None:
    values = [1.7e308, 1.7e308, 1.7e308]
    got = decode_numbers(message(payload=values), Kind.FORWARD_SUM, RUN, 2, [3])
    assert got.values == values


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"version": 1}, Reason.VERSION),
        ({"version": 0}, Reason.VERSION),
        ({"version": "2"}, Reason.VERSION),
        ({"version": True}, Reason.VERSION),
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
        ({"payload": [1.0, 2.0]}, Reason.LENGTH),
        ({"payload": []}, Reason.LENGTH),
        ({"payload": [1.0, 2.0, 3]}, Reason.TYPE),
        ({"payload": [1.0, 2.0, None]}, Reason.TYPE),
        ({"payload": [1.0, 2.0, True]}, Reason.TYPE),
        ({"payload": [[1.0], 2.0, 3.0]}, Reason.TYPE),
        ({"payload": {"a": 1.0}}, Reason.TYPE),
        ({"payload": b"\0" * 24}, Reason.TYPE),
        ({"payload": None}, Reason.TYPE),
        ({"extra": 1}, Reason.MALFORMED),
    ],
)
def test_one_wrong_field_is_refused_by_its_name(changes: dict[str, Any], reason: Reason) -> None:
    assert refusal(message(**changes)) is reason


@given(st.integers(0, len(message()) - 1))
def test_truncated_messages_are_refused(length: int) -> None:
    assert refusal(message()[:length]) is Reason.MALFORMED


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
    known = isinstance(fields, list) and len(fields) == 7 and fields[1] in list(Kind)
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


@given(st.integers(0, 8 * len(message()) - 1))
def test_a_flipped_bit_never_passes_for_another_header(bit: int) -> None:
    raw = bytearray(message())
    raw[bit // 8] ^= 1 << (bit % 8)
    try:
        got = decode_numbers(bytes(raw), Kind.FORWARD_SUM, RUN, 2, [3])
    except RejectedError:
        return
    # What passes differs in tick or numbers only: links are checked by the transport, not here.
    assert (got.sender, got.setpoint, len(got.values)) == (2, 0, 3)
    assert all(map(math.isfinite, got.values))


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
