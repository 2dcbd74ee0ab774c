"""Counts of messages: the same figures whenever they are made up."""

from __future__ import annotations

from threading import Thread
from zlib import crc32

from hypothesis import given
from hypothesis import strategies as st

from wire.counters import Flow, Rejections
from wire.messages import Reason


@given(st.lists(st.one_of(st.binary(max_size=20), st.none()), max_size=20))
def test_figures_are_those_of_all_messages_in_order(steps: list[bytes | None]) -> None:
    """None: what was put aside is counted in between."""
    flow = Flow()
    for raw in steps:
        if raw is None:
            flow.settle()
        else:
            flow.add(raw)
    raws = [raw for raw in steps if raw is not None]
    report = flow.report("x")
    assert report == {
        "x_messages": len(raws),
        "x_bytes": sum(map(len, raws)),
        "x_crc32": crc32(b"".join(raws)),
    }
    assert flow.report("x") == report


def test_messages_that_come_while_others_are_counted_are_not_lost() -> None:
    flow, count = Flow(), 20_000
    thread = Thread(target=lambda: [flow.add(b"%d" % i) for i in range(count)])
    thread.start()
    while thread.is_alive():
        flow.settle()
    thread.join()
    report = flow.report("x")
    assert report["x_messages"] == count
    assert report["x_crc32"] == crc32(b"".join(b"%d" % i for i in range(count)))


def test_refusals_are_counted_by_reason() -> None:
    rejections = Rejections()
    assert rejections.report() == {"rejected_messages": 0}
    for reason in (Reason.STALE, Reason.RUN, Reason.STALE):
        rejections.add(reason)
    assert rejections.report() == {
        "rejected_run": 1,
        "rejected_stale": 2,
        "rejected_messages": 3,
    }
