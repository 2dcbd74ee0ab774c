"""The live page on a recording: the same process as beside a run, fed by a publication.

Beside `supervise.replay_publish`, whose router it is a client of. What the page needs to know of the run comes
from the recording.
"""

from __future__ import annotations

import os
import signal
import subprocess
from collections.abc import Callable
from threading import Thread
from typing import Self

from analysis.link_times import own_clocks
from analysis.recording import Recording
from analysis.replay_check import Span
from supervise.children import Process, ending, module
from supervise.live_config import live_config
from wire.child import Deadline
from wire.config_json import dumps
from wire.errors import OctarmError
from wire.run_config import LinkConfig, LiveConfig

START_S = 20.0
GRACE_S = 3.0
_POLL_S = 0.02


def page_of(recording: Recording, span: Span, rate: float, port: int, endpoint: str) -> LiveConfig:
    """What the page's process must know to show this part of a recording, published at this rate."""
    run = recording.configuration
    return live_config(
        run,
        recording.artefact,
        recording.deployment,
        recording.references,
        links=LinkConfig((), (endpoint,), None, 5.0, epoch_ns=0, cpu=None, fifo=None),
        port=port,
        elsewhere=own_clocks(recording.facts.get("hosts"), run.nodes, []),
        period_s=run.tick_s / rate,
        replay_from=span.first,
    )


class LivePage:
    """The page's process while a recording is published. Leaving it leaves no process behind.

    `gone` is called, from another thread, with how it ended, if that is before `finish`.
    """

    def __init__(self, config: LiveConfig, gone: Callable[[str], None]) -> None:
        self._config = config
        self._gone = gone
        self._finished = False
        self.url = ""
        """Where the page is, once it is there."""

    def __enter__(self) -> Self:
        self._process = Process("live", module("live", str(os.getpid())), subprocess.DEVNULL)
        self._process.tell(dumps(self._config))
        try:
            self._await_ready()
        except BaseException:
            self._end()
            raise
        self._watcher = Thread(target=self._watch, daemon=True)
        self._watcher.start()
        self._process.order(do="start", dead=[])
        return self

    def __exit__(self, kind: type[BaseException] | None, error: object, _: object) -> None:
        if kind is None:
            self.finish("finished", "all that was asked for was published")
        else:
            self.finish("interrupted", str(error or "") or "interrupted")
        self._end()
        self._watcher.join()
        self._process.close()

    def finish(self, state: str, message: str) -> None:
        """Tell the pages how it ended; only the first word counts."""
        if not self._finished:
            self._finished = True
            self._process.order(do="finish", state=state, message=message, dead=[])

    def _await_ready(self) -> None:
        limit = Deadline(START_S)
        while not limit.passed:
            for line in self._process.lines() or ():
                match line["event"]:
                    case "listening":
                        self.url = line["url"]
                    case "failed":
                        raise OctarmError(line["message"])
                    case "ready":
                        return
            if (code := self._process.reap()) is not None:
                raise OctarmError(f"the live page {ending(code)} before it was there")
            self._process.wait(_POLL_S)
        raise OctarmError(f"the live page was not there after {START_S:g} s")

    def _watch(self) -> None:
        self._process.wait()
        if not self._finished:
            self._gone(f"the live page {ending(self._process.reap())}")

    def _end(self) -> None:
        """The process ends by itself when it has told its pages; after a grace it is made to."""
        for number in (None, signal.SIGTERM, signal.SIGKILL):
            if number is not None:
                self._process.signal(number)
            if self._process.wait(GRACE_S):
                break
        self._process.reap()
