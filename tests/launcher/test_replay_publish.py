"""`octarm replay --publish`: a subscriber gets what the recorder got, bit for bit and in order; the pace."""

from __future__ import annotations

import json
import signal
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
import pytest

from analysis.recording import Recording, read_recording
from analysis.replay_check import Span
from supervise.replay_publish import Publisher
from wire.channels import label
from wire.errors import OctarmError
from wire.keys import Keys
from wire.messages import PLANT, Kind, decode_batch, decode_counters, kind_of, run_tag
from wire.session import open_client, queue

if TYPE_CHECKING:
    from conftest import Cli, Start

Array = npt.NDArray[np.float64]
NODES, TICKS = 3, 40
LIMIT_S = 60.0


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory, gains: Path) -> Iterator[Path]:
    from conftest import one_run

    with one_run(
        tmp_path_factory.mktemp("run"), gains, "--nodes", str(NODES), "--ticks", str(TICKS)
    ) as path:
        yield path


@pytest.fixture(scope="module")
def recording(path: Path) -> Recording:
    return read_recording(path)


def expected_rows(recording: Recording) -> dict[int, Array]:
    """Each sender's rows, from the tables in the order of the file: a writer wrote a row's channels in turn."""
    out: dict[int, list[Array]] = {sender: [] for sender in (*range(recording.nodes), PLANT)}
    for topic, table in recording.tables.items():
        if topic in ("/event", "/scene"):
            continue
        sender = int(topic.split("/")[2]) if topic.startswith("/node/") else PLANT
        columns = [
            np.asarray(c, dtype=np.float64)
            for n, c in table.columns.items()
            if n not in ("tick", "time_s")
        ]
        out[sender].append(np.stack(columns, axis=1))
    return {sender: np.concatenate(parts, axis=1) for sender, parts in out.items()}


class Viewer:
    """A subscriber of all telemetry, as the recorder is one."""

    def __init__(self, endpoint: str, recording: Recording) -> None:
        self.run = run_tag(recording.configuration.run_id)
        self.columns = {s: rows.shape[1] for s, rows in expected_rows(recording).items()}
        limit = time.monotonic() + LIMIT_S
        self.session: Any = open_client([endpoint], lambda: time.monotonic() > limit)
        assert self.session is not None, "no publisher there"
        self.samples = self.session.declare_subscriber(Keys(self.run).all_telemetry, queue(100_000))
        self.rows: list[tuple[int, int, bytes]] = []
        """(sender, tick, row), as they came."""
        self.counters: dict[int, tuple[int, dict[str, int]]] = {}

    def take(self) -> None:
        while (sample := self.samples.try_recv()) is not None:
            raw, key = bytes(sample.payload), str(sample.key_expr)
            if kind_of(raw) is Kind.COUNTERS:
                sender, tick, counters = decode_counters(raw, self.run)
                self.counters[sender] = (tick, counters)
            else:
                batch = decode_batch(raw, self.run, self.columns)
                sender = batch.sender
                for k, row in enumerate(batch.rows, batch.tick):
                    self.rows.append((sender, k, row.tobytes()))
            assert key == Keys(self.run).telemetry(sender)

    def until(self, rows: int = 0, *, end: bool = False) -> None:
        """Take what comes until there are so many rows, or everybody's last word."""
        limit = time.monotonic() + LIMIT_S
        while len(self.rows) < rows or (end and len(self.counters) < len(self.columns)):
            assert time.monotonic() < limit, (
                f"{len(self.rows)} rows, {len(self.counters)} last words"
            )
            self.take()
            time.sleep(0.005)

    def close(self) -> None:
        del self.samples
        self.session.close()


def endpoint_of(cli: Cli) -> str:
    cli.wait_for("publishing ")
    line = next(x for x in cli.err.splitlines() if x.startswith("publishing "))
    return line.rpartition(" ")[2]


def everything(recording: Recording, ticks: range) -> list[tuple[int, int, bytes]]:
    rows = expected_rows(recording)
    senders = (*range(recording.nodes), PLANT)
    return [(s, k, rows[s][k].tobytes()) for k in ticks for s in senders]


def nothing_left(cli: Cli) -> None:
    assert cli.gone() == {}
    assert list(cli.sockets.iterdir()) == []


@pytest.mark.parametrize("rate", ["inf", "20"])
def test_a_subscriber_gets_every_row_bit_for_bit_and_in_order(
    start: Start, path: Path, recording: Recording, rate: str
) -> None:
    cli = start("replay", path, "--publish", "--rate", rate)
    viewer = Viewer(endpoint_of(cli), recording)  # it waits for one: the first tick is not missed
    try:
        viewer.until(end=True)
        assert cli.finish() == 0, cli.err
    finally:
        viewer.close()
    assert viewer.rows == everything(recording, range(TICKS))
    for sender, (tick, counters) in viewer.counters.items():
        who = "plant" if sender == PLANT else f"node/{label(sender, NODES)}"
        assert tick == TICKS
        assert counters == recording.process_counters(who)
    assert f"{TICKS} ticks, {TICKS * (NODES + 1)} rows published" in cli.out
    nothing_left(cli)


def test_a_part_of_it_over_a_socket_of_ones_own(
    start: Start, path: Path, recording: Recording, tmp_path: Path
) -> None:
    endpoint = f"unixsock-stream/{tmp_path}/viewers"
    cli = start(
        *("replay", path, "--publish", "--rate", "inf", "--from", "7", "--to", "11"),
        *("--listen", endpoint, "--json"),
    )
    limit = time.monotonic() + LIMIT_S
    while not (tmp_path / "viewers").exists():
        assert time.monotonic() < limit
        time.sleep(0.02)
    viewer = Viewer(endpoint, recording)
    try:
        viewer.until(end=True)
        assert cli.finish() == 0, cli.err
    finally:
        viewer.close()
    assert viewer.rows == everything(recording, range(7, 12))
    assert {tick for tick, _ in viewer.counters.values()} == {12}
    assert cli.err == ""
    facts = json.loads(cli.out)
    assert (facts["ticks_published"], facts["rows_published"]) == (5, 5 * (NODES + 1))
    assert facts["endpoint"] == endpoint
    assert not list(tmp_path.glob("viewers*"))
    nothing_left(cli)


def test_a_loop_goes_round_until_ctrl_c(start: Start, path: Path, recording: Recording) -> None:
    cli = start("replay", path, "--publish", "--loop", "--rate", "100", "--from", "30")
    viewer = Viewer(endpoint_of(cli), recording)
    once = everything(recording, range(30, TICKS))
    try:
        viewer.until(3 * len(once))
        cli.popen.send_signal(signal.SIGINT)
        assert cli.finish() == 130
        viewer.until(end=True)
    finally:
        viewer.close()
    assert viewer.rows[: 3 * len(once)] == 3 * once
    assert "Traceback" not in cli.err
    nothing_left(cli)


def test_it_waits_for_a_subscriber_unless_told_not_to(start: Start, path: Path) -> None:
    waiting = start("replay", path, "--publish", "--rate", "inf")
    waiting.wait_for("waiting for a subscriber on tcp/127.0.0.1:")
    at_once = start("replay", path, "--publish", "--rate", "inf", "--at-once")
    assert at_once.finish() == 0, at_once.err
    assert waiting.popen.poll() is None
    waiting.popen.send_signal(signal.SIGINT)
    assert waiting.finish() == 130
    nothing_left(waiting)


# -- the pace ------------------------------------------------------------------------------------------------


class Fake:
    """A clock that goes on when somebody waits, and by `work_s` whenever it is looked at."""

    def __init__(self, work_s: float = 0.0) -> None:
        self.at = 100.0
        self.work_s = work_s
        self.waits: list[float] = []

    def now(self) -> float:
        self.at += self.work_s
        return self.at

    def wait(self, seconds: float, event: threading.Event) -> None:
        self.waits.append(seconds)
        self.at += seconds


def test_a_tick_lasts_as_long_as_the_rate_says(recording: Recording) -> None:
    for rate, work_s in ((0.5, 0.0), (2.0, 0.0), (2.0, 0.004), (25.0, 0.0003)):
        clock = Fake(work_s)
        with Publisher(recording, rate=rate, wait=False, clock=clock) as publisher:
            done = publisher.publish()
        assert (done.ticks, done.rows, done.rounds) == (TICKS, TICKS * (NODES + 1), 1)
        assert len(clock.waits) == TICKS
        # What a tick takes is not added to it.
        assert done.seconds == pytest.approx(TICKS * recording.tick_s / rate, rel=0.03)
        assert done.rate(recording.tick_s) == pytest.approx(rate, rel=0.03)


def test_a_rate_that_cannot_be_held_is_not_made_up_for(recording: Recording) -> None:
    said: list[str] = []
    clock = Fake(0.3)  # seconds for every look
    with Publisher(recording, rate=1.0, wait=False, clock=clock, progress=said.append) as publisher:
        publisher.publish()
        clock.work_s, clock.waits = 0.0, []
        publisher.publish()
    assert len(clock.waits) == TICKS  # back to the pace at once
    assert max(clock.waits) == pytest.approx(recording.tick_s)
    assert said and all(" of 39, " in text and " x real time" in text for text in said)


def test_another_thread_can_stop_it(recording: Recording) -> None:
    publisher = Publisher(recording, loop=True, rate=100.0, wait=False)
    with publisher:
        thread = threading.Thread(target=publisher.publish)
        thread.start()
        limit = time.monotonic() + LIMIT_S
        while publisher.done.rounds < 1:
            assert time.monotonic() < limit
            time.sleep(0.005)
        publisher.stop()
        thread.join(LIMIT_S)
        assert not thread.is_alive()
    assert publisher.done.rows == publisher.done.ticks * (NODES + 1)


def test_two_publishers_do_not_share_an_endpoint(recording: Recording) -> None:
    with Publisher(recording, span=Span(0, 1)) as one:
        with pytest.raises(OctarmError, match=r"--listen tcp/127.*nothing can listen there"):
            Publisher(recording, listen=one.endpoint)
        with Publisher(recording) as other:
            assert other.endpoint != one.endpoint
