"""A recording fed to a real node process over Zenoh, tick by tick: does it answer as in the run?

Beside `analysis.replay`, which runs only the mathematics: here it is the process, with its encoding, its links
and its telemetry. It gets its recorded configuration with other links; the replayer is its only peer, a router
that stands for plant, neighbours and recorder. A tick is fed when the one before has been answered. A process
that was replaced has several lives: each is one process here as well.
"""

from __future__ import annotations

import contextlib
import dataclasses
import itertools
import tempfile
from collections.abc import Callable

import numpy as np

from analysis.lives import Life
from analysis.recording import Recording
from analysis.replay import Feed, Rows, name_of, nothing_yet, replay_block
from node.configured import sweeps_of
from supervise.endpoints import choose
from supervise.replay_child import StartedNode, Turns
from supervise.replay_peer import Peer
from supervise.replay_result import Array, NodeReplay
from wire import session as zsession
from wire.channels import Degraded, label
from wire.run_config import LinkConfig, NodeConfig

MESSAGES = (
    "measurement_received",
    "forward_received",
    "backward_received",
    "forward_sent",
    "backward_sent",
    "command_sent",
)
"""What a node counts; a replay of the whole run repeats the checksums too."""


def replay_process(
    feed: Feed, rows: Rows, deadline_s: float | None, progress: Callable[[str], None]
) -> NodeReplay:
    """Start the node process of a feed, give it every tick, and take what it gives; it is gone afterwards.

    `deadline_s`: longest wait for an answer; None: as in the run. StartUpTimeoutError if the process does not
    link up, OctarmError if it fails before the first tick. What goes wrong later is in the result.
    """
    alone = replay_block(feed, rows)  # how far what is recorded of each life goes
    out = NodeReplay(nothing_yet(feed, sweeps_of(feed.config), rows), np.zeros(0), {})
    out.replayed.ended = alone.ended
    for life in feed.lives.lives:
        refused = out.rejected
        why = _unlike_a_run(feed, life)
        if why is not None:
            out.replayed.ended = out.replayed.ended or why
            continue
        out.counters = {}
        if alone.ended is not None:  # nothing is known of the rest
            known = set(np.flatnonzero(np.isfinite(alone.rows[feed.config.index]).all(axis=1)))
            life = dataclasses.replace(life, ticks=tuple(k for k in life.ticks if k in known))  # noqa: PLW2901
        _replay_life(feed, life, deadline_s, progress, out)
        out.refused += refused
        if out.replayed.broke_off or (out.replayed.ended and out.replayed.ended != alone.ended):
            break
    return out


def _unlike_a_run(feed: Feed, life: Life) -> str | None:
    """Why a life cannot be given to a process, if so: what made it do what it did, was not recorded."""
    if life.joined and len(feed.segments) > 1:
        return (
            f"{name_of(feed.config)}: from tick {life.ticks[0]} on not replayed with a process, only without "
            "--node: what its neighbours had told it when it joined cannot be told from its several segments"
        )
    if feed.backward.shape[1]:
        announced = feed.backward[:, -1]
        for before, k in itertools.pairwise(life.ticks):
            bridged = feed.flags[k] & int(Degraded.BACKWARD_BRIDGED)
            if bridged and announced[k] != announced[before]:
                return (
                    f"{name_of(feed.config)}: tick {k} cannot be replayed with a process, only without --node: "
                    "its neighbour used another setpoint's gains"
                )
    return None


def _replay_life(
    feed: Feed,
    life: Life,
    deadline_s: float | None,
    progress: Callable[[str], None],
    out: NodeReplay,
) -> None:
    with contextlib.ExitStack() as stack:
        endpoints = choose(2, "unix", None, None)
        stack.callback(endpoints.close)
        errors = stack.enter_context(tempfile.TemporaryFile())
        config = _relinked(feed.config, endpoints.plant, endpoints.private)
        config = dataclasses.replace(config, joins=life.joined)
        turns = Turns()
        stack.callback(turns.close)
        session = zsession.open_session("router", [endpoints.plant], [])
        stack.callback(session.close)
        peer = stack.enter_context(Peer(config, session, turns))
        process = stack.enter_context(StartedNode(config, errors, turns))
        peer.link(process)
        pid = process.node.pid if process.node else 0
        progress(f"{name_of(config)} is linked, process {pid}")
        peer.replay(feed, life, process, deadline_s or config.links.deadline_s, out)
        out.refused -= peer.unwanted


def same_messages(recording: Recording, replay: NodeReplay) -> dict[str, bool]:
    """Per kind of message, named as the counters are, whether the process has repeated the run's checksum.

    A checksum is over all messages of a kind in order, headers and the last command included. Kinds of which
    the run had another number of messages are left out: it may have ended within a tick. All are of a recording
    before format 5, whose messages had another version in their headers.
    """
    same: dict[str, bool] = {}
    if recording.format_version < 5:
        return same
    for index, counters in replay.counters.items():
        recorded = recording.process_counters(f"node/{label(index, recording.nodes)}")
        for name in MESSAGES:
            count = counters.get(f"{name}_messages", 0)
            if count > 0 and count == recorded.get(f"{name}_messages"):
                same[name] = counters[f"{name}_crc32"] == recorded.get(f"{name}_crc32")
    return same


def _relinked(config: NodeConfig, endpoint: str, directory: str | None) -> NodeConfig:
    links = LinkConfig(
        listen=(),
        connect=(endpoint,),
        directory=directory,
        deadline_s=config.links.deadline_s,
        epoch_ns=None,
        cpu=None,
        fifo=None,
    )
    return dataclasses.replace(config, links=links)


def latency_facts(latencies_us: Array) -> dict[str, float | None]:
    """Median and 99 % of the time from feeding a tick to its command, us; None without a tick."""
    shares = {"p50": 50.0, "p99": 99.0}
    some = latencies_us.size > 0
    return {
        name: float(np.percentile(latencies_us, share)) if some else None
        for name, share in shares.items()
    }
