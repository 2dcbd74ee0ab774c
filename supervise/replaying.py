"""`octarm replay` from options to result: the mathematics of all nodes, one real process, or a publication.

Between the verb, which only knows options and printing, and the three ways of a replay.
"""

from __future__ import annotations

import contextlib
import dataclasses
import math
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from time import monotonic
from typing import Any

from analysis.recording import find_recording, read_recording
from analysis.replay import name_of
from analysis.replay_check import WHOLE, Comparison, Span, Story, Verdict, check, compare, story_of
from wire.errors import ExitCode, UsageError

Tell = Callable[[str], None]

_SAYS = {
    Verdict.EQUAL: "every bit that was compared is what the recorded inputs give",
    Verdict.DIFFERENT: "not what the recorded inputs give",
    Verdict.INCOMPLETE: "no difference, but not everything could be replayed",
}


@dataclass(frozen=True)
class Options:
    """What the user asked for. Raises UsageError for options that do not go together."""

    recording: Path
    node: int | None = None
    publish: bool = False
    first: str | None = None
    """A tick, or an instant of the arm with an s behind: "431", "43.1s"."""
    last: str | None = None
    deadline_s: float | None = None
    rate: float | None = None
    loop: bool = False
    at_once: bool = False
    listen: str | None = None
    live: bool = False
    live_port: int | None = None

    def __post_init__(self) -> None:
        if self.publish and self.node is not None:
            raise UsageError("--node and --publish: give one of them")
        for name in ("rate", "loop", "at_once", "listen", "live"):
            if not self.publish and getattr(self, name) not in (None, False):
                raise UsageError(
                    f"--{name.replace('_', '-')} is for --publish; add it or leave it out"
                )
        if self.live_port is not None and not self.live:
            raise UsageError("--live-port is for --live; add it or leave it out")
        if self.deadline_s is not None:
            if self.node is None:
                raise UsageError("--deadline is for --node; add it or leave it out")
            if not 0.0 < self.deadline_s < float("inf"):
                raise UsageError(
                    f"--deadline {self.deadline_s:g}: expected a positive number of seconds"
                )

    def span(self, tick_s: float) -> Span:
        """The ticks that are asked for; of instants those from the first to the last that they enclose."""
        first = _tick("--from", self.first, tick_s, math.ceil)
        return Span(first or 0, _tick("--to", self.last, tick_s, math.floor))


_ROUNDING = 1e-6
"""Of a tick: 0.3 s are three ticks of 0.1 s."""


def _tick(
    option: str, text: str | None, tick_s: float, whole: Callable[[float], int]
) -> int | None:
    """The tick that an option means; UsageError if it means none."""
    if text is None:
        return None
    try:
        if not text.endswith("s"):
            return int(text)
        ticks = float(text.removesuffix("s")) / tick_s
        return whole(ticks - _ROUNDING if whole is math.ceil else ticks + _ROUNDING)
    except (ValueError, OverflowError):
        raise UsageError(
            f"{option} {text}: expected a tick such as 431, or seconds of the arm's time such as 43.1s"
        ) from None


@dataclass(frozen=True)
class Done:
    """What came of it."""

    facts: dict[str, Any]
    text: str
    exit_code: ExitCode


def run_replay(options: Options, tell: Tell) -> Done:
    """Do what the options say; raises OctarmError."""
    if options.publish:
        return _publish(options, tell)
    began = monotonic()
    recording = read_recording(find_recording(options.recording))
    story = story_of(recording, options.span(recording.tick_s))
    if options.node is None:
        comparison, extra = check(story), dict[str, Any]()
    else:
        comparison, extra = _one_process(story, options.node, options.deadline_s, tell)
    seconds = monotonic() - began
    facts = _facts(story, comparison, seconds) | extra
    code = ExitCode.OK if comparison.verdict is Verdict.EQUAL else ExitCode.DEGRADED
    return Done(facts, _text(story, comparison, facts), code)


def _one_process(
    story: Story, node: int, deadline_s: float | None, tell: Tell
) -> tuple[Comparison, dict[str, Any]]:
    from supervise.replay_node import latency_facts, replay_process, same_messages

    feed = story.feed(story.nodes.process_of(node))
    given = replay_process(feed, story.rows, deadline_s, tell)
    comparison = compare(story, [feed], [given.replayed], process=True)
    wrong = list(comparison.wrong)
    if given.rejected:
        wrong.append(f"{name_of(feed.config)} refused {given.rejected} messages")
    same = same_messages(story.recording, given)
    if other := [name for name, equal in same.items() if not equal]:
        wrong.append(f"messages {', '.join(other)}: their checksums are not those of the run")
    comparison = dataclasses.replace(comparison, wrong=tuple(wrong))
    return comparison, {
        "node": node,
        "segments": list(feed.segments),
        "rejected_messages": given.rejected,
        "checksums_equal": sum(same.values()),
        "checksums_compared": len(same),
        "latency_us": latency_facts(given.latencies_us),
    }


def _publish(options: Options, tell: Tell) -> Done:
    from supervise.endpoints import check_live_port
    from supervise.replay_live import LivePage, page_of
    from supervise.replay_publish import Publisher

    check_live_port(options.live_port)
    recording = read_recording(find_recording(options.recording))
    rate = 1.0 if options.rate is None else options.rate
    publisher = Publisher(
        recording,
        rate=rate,
        span=options.span(recording.tick_s),
        loop=options.loop,
        wait=not options.at_once,
        listen=options.listen,
        progress=tell,
    )
    trouble: list[str] = []

    def gone(how: str) -> None:
        trouble.append(how)
        publisher.stop()

    with publisher, contextlib.ExitStack() as stack:
        tell(f"publishing {recording.path} on {publisher.endpoint}")
        if options.live:
            config = page_of(
                recording,
                options.span(recording.tick_s),
                rate,
                options.live_port or 0,
                publisher.endpoint,
            )
            page = stack.enter_context(LivePage(config, gone))
            # without it nobody can look, so also with --quiet and --json
            print(f"live at {page.url}", file=sys.stderr, flush=True)
        done = publisher.publish()
    held_rate = done.rate(recording.tick_s)
    facts = {
        "recording": str(recording.path),
        "run_id": recording.configuration.run_id,
        "endpoint": publisher.endpoint,
        "ticks_published": done.ticks,
        "rows_published": done.rows,
        "seconds": done.seconds,
        "rate": held_rate,
        "trouble": trouble[0] if trouble else None,
    }
    held = "" if held_rate is None else f", {held_rate:.3g} x real time"
    text = f"{done.ticks} ticks, {done.rows} rows published in {done.seconds:.1f} s{held}"
    if trouble:
        text += f"; stopped: {trouble[0]}"
    return Done(facts, text, ExitCode.DEGRADED if trouble else ExitCode.OK)


def _facts(story: Story, comparison: Comparison, seconds: float) -> dict[str, Any]:
    recording, span = story.recording, story.span
    arm_s = comparison.ticks * recording.tick_s
    return {
        "recording": str(recording.path),
        "recording_complete": recording.unfinished is None,
        "nodes": recording.nodes,
        "ticks": story.rows.ticks,
        "late_ticks": int(story.rows.late.sum()),
        "from": span.first,
        "to": story.rows.ticks - 1 if span.last is None else span.last,
        "configurations": "recorded" if story.nodes.recorded else "made again",
        **comparison.facts(),
        "seconds": seconds,
        "times_real_time": arm_s / seconds if seconds > 0.0 else None,
    }


def _text(story: Story, comparison: Comparison, facts: dict[str, Any]) -> str:
    """The facts as lines, a name and what there is to say."""
    recording = story.recording
    state = "complete" if recording.unfinished is None else "not complete"
    late = f", {facts['late_ticks']} of them late" if facts["late_ticks"] else ""
    rows = [
        ("recording", f"{recording.path} ({state})"),
        (
            "run",
            f"{recording.nodes} nodes, {facts['ticks']} ticks of {recording.tick_s:g} s{late}",
        ),
        ("replayed", _replayed(comparison, facts)),
    ]
    if not story.nodes.recorded:
        rows.append(
            ("", "the recording has no configurations of its nodes: made again from its gains")
        )
    if story.span != WHOLE:
        rows.append(("", f"compared from tick {facts['from']} to tick {facts['to']}"))
    rows.append(("compared", f"{comparison.values} values, {comparison.differing} differ"))
    if facts.get("checksums_compared"):
        same, total = facts["checksums_equal"], facts["checksums_compared"]
        rows.append(("", f"{same} of {total} checksums over all messages of a kind"))
    elif "node" in facts and story.recording.format_version < 5:
        rows.append(("", "the run's checksums are of messages of an earlier version: not compared"))
    if "latency_us" in facts and facts["latency_us"]["p50"] is not None:
        p50, p99 = facts["latency_us"]["p50"], facts["latency_us"]["p99"]
        rows.append(("latency", f"p50 {p50:.0f} us, p99 {p99:.0f} us from feeding to the command"))
    rows.append(
        ("took", f"{facts['seconds']:.2f} s, {facts['times_real_time']:.0f} times real time")
    )
    if comparison.first is not None:
        rows.append(("first", str(comparison.first)))
    rows += [("otherwise", text) for text in comparison.wrong]
    rows += [("missing", text) for text in comparison.missing]
    rows.append(("verdict", f"{comparison.verdict}: {_SAYS[comparison.verdict]}"))
    return "\n".join(f"{name:<10} {text}" for name, text in rows)


def _replayed(comparison: Comparison, facts: dict[str, Any]) -> str:
    if "node" not in facts:
        return f"{comparison.node_ticks} node-ticks with the mathematics of the nodes"
    segments = facts["segments"]
    who = f"node {segments[0]}" + (f" to {segments[-1]}" if len(segments) > 1 else "")
    return f"{comparison.node_ticks} node-ticks with the real process of {who}"
