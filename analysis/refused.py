"""What a run did not let in, from its recording: messages by the reason of their refusal, and peers.

Between the final counters of the recording and its summary.
"""

from __future__ import annotations

from collections import Counter
from typing import TypedDict

import msgspec

from analysis.recorded_counters import Count
from analysis.recording import Recording
from wire.channels import REFUSED, label
from wire.errors import UsageError

_PREFIX = "rejected_"


class RefusedPeer(TypedDict):
    """Who came how often to which process."""

    by: str
    what: str
    count: Count


def rejected_by_reason(recording: Recording) -> dict[str, int]:
    """Refused messages of all processes by reason (wire.messages.Reason), those that occurred."""
    found: Counter[str] = Counter()
    nodes = [f"node/{label(i, recording.nodes)}" for i in range(recording.nodes)]
    for process in (*nodes, "plant", "recorder"):
        for name, count in recording.process_counters(process).items():
            if name.startswith(_PREFIX) and name != "rejected_messages":
                found[name.removeprefix(_PREFIX)] += count
    return dict(sorted(found.items()))


def refused_peers(recording: Recording) -> list[RefusedPeer]:
    """Peers without a fitting certificate that came to a process; empty without --keys."""
    text = (recording.counters or {}).get(REFUSED, "[]")
    try:
        return msgspec.json.decode(text, type=list[RefusedPeer])
    except msgspec.DecodeError as error:
        raise UsageError(f"recording {recording.path}: {REFUSED}: {error}") from None


def peers_line(peers: list[RefusedPeer]) -> str:
    """All of them in one line."""
    return "; ".join(f"{one['by']}: {one['what']}, {one['count']}" for one in peers)
