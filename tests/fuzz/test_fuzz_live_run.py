"""Mutated messages to a run that goes on: none is accepted, none ends it, numbers and rate stay the same."""

from __future__ import annotations

import dataclasses
import signal
from collections import Counter
from typing import TYPE_CHECKING

import pytest
from intruder import Mutator, Victim, intruding

from analysis.compare import first_difference
from analysis.recording import Recording, read_recording
from wire.messages import Reason

if TYPE_CHECKING:
    from conftest import Start

QUIET = ("--no-plot", "--quiet")
NODE = 1


def refused(recording: Recording) -> Counter[str]:
    """By process, how many messages it refused."""
    names = ["plant", *(f"node/{i:02d}" for i in range(recording.nodes))]
    return Counter({n: recording.process_counters(n).get("rejected_messages", 0) for n in names})


@pytest.mark.alone
@pytest.mark.variants("unix")
@pytest.mark.parametrize("transport", ["unix", "tcp"])
def test_a_run_in_real_time_refuses_every_mutant_by_name_and_keeps_its_rate(
    start: Start, transport: str
) -> None:
    messages = 20_000 if transport == "unix" else 4_000
    cli = start.run(
        *("--nodes", "4", "--ticks", "1000000", "--transport", transport, *QUIET),
        *("--realtime", "--period", "0.02", "--hold-ticks", "100000"),
    )
    cli.wait_for_ticks()
    victim = Victim.of(cli.recording(), NODE)
    mutants = list(Mutator(victim, seed=7).make(messages))
    assert {m.reason for m in mutants} >= set(Reason) - {Reason.DUPLICATE, Reason.LATE}
    with intruding(victim) as intruder:
        seconds = intruder.send(mutants, rate_hz=4000.0)
        cli.wait_for_more()
        sent = intruder.node, intruder.plant
    cli.popen.send_signal(signal.SIGINT)
    assert cli.finish() == 130, cli.err
    assert "internal" not in cli.err
    assert cli.gone() == {}
    assert list(cli.sockets.iterdir()) == []
    recording = read_recording(cli.recording())
    assert recording.unfinished is None
    for told, name in zip(sent, (f"node/{NODE:02d}", "plant"), strict=True):
        assert told.agrees(recording.process_counters(name)) == ""
    counts = refused(recording)
    assert sum(counts.values()) == messages == counts["plant"] + counts[f"node/{NODE:02d}"]
    assert recording.ticks > seconds / 0.02  # it went on all the time
    assert recording.late.sum() <= 0.1 * recording.ticks  # a busy machine is late by itself


def without_lamps(recording: Recording) -> Recording:
    """All but the channel that tells of whom something was refused: there the two must differ."""
    lamps = "/plant/health"
    return dataclasses.replace(
        recording,
        tables={topic: table for topic, table in recording.tables.items() if topic != lamps},
        order=[topic for topic in recording.order if topic != lamps],
    )


def test_the_numbers_of_a_run_are_those_of_one_without_an_intruder(start: Start) -> None:
    same = ("--nodes", "4", "--ticks", "1500", *QUIET)
    alone = start.run(*same)
    assert alone.finish() == 0, alone.err
    disturbed = start.run(*same)
    disturbed.wait_for_ticks()
    victim = Victim.of(disturbed.recording(), NODE)
    mutants = list(Mutator(victim, seed=8).make(1500))
    with intruding(victim) as intruder:
        intruder.send(mutants, rate_hz=3000.0)
    assert disturbed.finish() == 0, disturbed.err
    one, other = read_recording(alone.recording()), read_recording(disturbed.recording())
    assert first_difference(without_lamps(one), without_lamps(other)) is None
    assert sum(refused(other).values()) > 100
    assert sum(refused(one).values()) == 0
