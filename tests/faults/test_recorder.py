"""A recorder, or the page's process, that is killed or stopped: the arm does not wait for either."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest

from chaos.aftermath import Expected
from wire import session as zsession

if TYPE_CHECKING:
    from conftest import Start

ROOT = Path(__file__).resolve().parents[2]
FAST = (
    "--nodes",
    "20",
    "--segments-per-process",
    "10",
    "--tick",
    "0.01",
    "--realtime",
    "--no-plot",
)
"""The records of twenty segments 100 times a second fill a link that nobody reads after two seconds or so.
(Late ticks, of which nodes have no records, are rare at this period: with ten segments 200 times a second 40 %
were late on a busy machine, and it took up to 2.7 s.)"""
HELD = ("--hold-ticks", "1000")
"""Late ticks of a busy machine are not the matter here."""
_READER = """
import sys, time
from wire import session as zsession
session = zsession.open_session("client", (), (sys.argv[1],))
samples = session.declare_subscriber("records", zsession.queue(8192))
print("up", flush=True)
while True:
    while samples.try_recv() is not None:
        pass
    time.sleep(0.005)
"""


@pytest.mark.parametrize("size", [3_000, 30_000, 150_000])
def test_a_frozen_reader_costs_a_sender_no_tick(tmp_path: Path, size: int) -> None:
    """150 kB: in several fragments, as the plant's batches at 100 segments."""
    endpoint = f"unixsock-stream/{tmp_path}/s"
    session = zsession.open_session("router", (endpoint,), ())
    publisher = zsession.telemetry_publisher(session, "records")
    command = [sys.executable, "-c", _READER, endpoint]
    with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE) as reader:
        try:
            assert reader.stdout is not None
            reader.stdout.readline()
            while not zsession.matched(publisher):
                time.sleep(0.01)
            reader.send_signal(signal.SIGSTOP)
            waits = []
            for _ in range(4_000_000 // size + 100):  # more than socket and queue take
                queued, began = _queued_s(), time.monotonic()
                publisher.put(bytes(size))
                waits.append(time.monotonic() - began - (_queued_s() - queued))
                time.sleep(0.001)
        finally:
            reader.kill()
            session.close()
    # Without the times for which the machine took the core away; 50 ms, once, would be in the sum.
    long = sorted(wait for wait in waits if wait > 0.9 * zsession.DROP_AFTER_US * 1e-6)
    assert long, "nothing was ever full"
    assert long[0] < 5e-3  # 1.1 ms on a machine that has time
    assert sum(long) < 25e-3


def _queued_s() -> float:
    """For how long this thread was ready to run so far, but had no core; 0 where the kernel does not count
    it."""
    with contextlib.suppress(OSError):
        return int(Path("/proc/thread-self/schedstat").read_text().split()[1]) * 1e-9
    return 0.0


def test_recorder_that_is_stopped_for_a_while_holds_nobody_up(start: Start) -> None:
    cli = start.run(*FAST, *HELD, "--ticks", "800")
    cli.wait_for_records()
    recorder = cli.processes()["octarm-recorder"]
    os.kill(recorder, signal.SIGSTOP)
    cli.wait_for("the recorder does not answer: records may be lost, the run goes on")
    time.sleep(3.0)  # five seconds in all
    os.kill(recorder, signal.SIGCONT)
    events = (
        r"telemetry_lost: telemetry of plant: ticks \d+ to \d+ were lost",
        r"finished: all 800",
    )
    cli.ends(Expected((3,), events, (r"records were lost \(\d+ node ticks\)",)))
    recording = cli.recorded()
    assert recording.table("/plant/pace").column("tick")[-1] == 799
    assert np.isfinite(recording.estimates[-100:][~recording.late[-100:]]).all()  # it found back


def test_recorder_that_is_stopped_for_ever_is_given_up(start: Start) -> None:
    cli = start.run(*FAST, *HELD, "--ticks", "500")
    cli.wait_for_records()
    os.kill(cli.processes()["octarm-recorder"], signal.SIGSTOP)
    cli.wait_for("the recorder does not answer: records may be lost, the run goes on")
    began = time.monotonic()
    cli.ends(
        Expected((3,), said=(r"the recorder did not finish: .* may end early",), finished=False)
    )
    assert (
        time.monotonic() - began < 16.0
    )  # of these 2 s of the run, 5 s of patience, 3 s to its end


def test_recorder_that_slept_through_the_end_does_not_wait_for_what_was_dropped(
    start: Start,
) -> None:
    cli = start.run(*FAST, *HELD, "--ticks", "450")
    cli.wait_for_records()
    recorder = cli.processes()["octarm-recorder"]
    os.kill(recorder, signal.SIGSTOP)
    # The nodes leave when the recorder has finished or is given up: until then they only wait.
    plant = cli.processes()["octarm-plant"]
    limit = time.monotonic() + 40
    used, before = _processor_ticks(plant), -1
    while used != before and time.monotonic() < limit:  # until the arm rests
        time.sleep(0.5)
        used, before = _processor_ticks(plant), used
    os.kill(recorder, signal.SIGCONT)
    resumed = time.monotonic()
    cli.ends(Expected((3,), (r"finished: all 450",), (r"records were lost \(\d+ node ticks",)))
    assert time.monotonic() - resumed < 15.0  # 5 s of silence, and the summary


def _processor_ticks(pid: int) -> int:
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return int(fields[11]) + int(fields[12])


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSTOP])
def test_page_that_is_killed_or_stopped_is_not_missed(start: Start, number: signal.Signals) -> None:
    cli = start.run(*FAST, *HELD, "--ticks", "400", "--live")
    cli.wait_for_records()
    os.kill(cli.processes()["octarm-live"], number)
    killed = number is signal.SIGKILL
    said = (r"the live page was ended by SIGKILL: the run goes on unseen",) if killed else ()
    cli.ends(Expected((0, 3), (r"finished: all 400 ticks",), said))
    assert cli.recorded().table("/plant/pace").rows == 400  # nodes have none of a late tick


def test_a_second_interrupt_closes_the_file_without_the_last_words_of_a_frozen_node(
    start: Start,
) -> None:
    cli = start.run("--nodes", "2", "--ticks", "1000000", "--no-plot", "--deadline", "30")
    cli.wait_for_records()
    os.kill(cli.processes()["octarm-node1"], signal.SIGSTOP)
    cli.popen.send_signal(signal.SIGINT)
    time.sleep(0.5)  # of the two seconds that it is waited for
    cli.popen.send_signal(signal.SIGINT)
    cli.ends(Expected((130,), (r"interrupted: ",)))
