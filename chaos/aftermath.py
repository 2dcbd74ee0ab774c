"""The one check after every injected fault: nothing left behind, a good recording, the right exit code?

Last step of a fault: a run was started with a mark and a private TMPDIR (chaos.processes), something was
done to it, it ended. Used so:

    remains = Remains(mark, sockets=TMPDIR, work=DIRECTORY, exit_code=4, stdout=OUT, stderr=ERR)
    expected = Expected(codes=(4,), events=(r"safety_stop: .*node 2 was ended by SIGKILL",))
    wrong: list[str] = violations(remains, expected)     # empty: all is well

It knows nothing of how the run was made: everything is read from the outside.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from analysis.recording import Recording, read_recording
from chaos.processes import outliving
from wire.errors import OctarmError

GONE_S = 3.0
"""So long after the launcher's end everything else of the run has ended as well."""
RECORDING = "recording.mcap"
LOG = "processes.log"
_BELONGS = (RECORDING, LOG, "plot.png", "node-*.json")
"""What may lie in the directory of a run."""
_BROKEN = ("Traceback (most recent call last)", "panicked at", "Segmentation fault")
_KNOWN = re.compile(
    r"\n?^thread .* panicked at \S*/zenoh/src/net/routing/dispatcher/resource\.rs:486:27:\n"
    r".*\n"  # what it says: an Option that is None
    r"(?:stack backtrace:\n(?: +(?:\d+:|at) .*\n)+)?"
    r"(?:note: .*\n)*",
    re.MULTILINE,
)
"""A race in Zenoh 1.10.2: a process that ends while another links up may lose that link's thread, about once in
some hundred ends (docs/faults.md, "What cannot be known"). What comes of it is checked all the same."""
_SHOWN = 400
"""Characters of a text that a violation repeats."""


@dataclass(frozen=True)
class Remains:
    """What identifies a run from outside, and what it said."""

    mark: str
    """Value of the environment variable chaos.processes.MARK in all its processes."""
    sockets: Path
    """Its private TMPDIR: there its socket directory was."""
    work: Path
    """Where its recording is, at any depth."""
    exit_code: int | None
    """Of the launcher, negative for a signal; None: it did not end."""
    stdout: str = ""
    stderr: str = ""


@dataclass(frozen=True)
class Expected:
    """What a fault is decided to lead to."""

    codes: tuple[int, ...] = (0,)
    """Exit codes that are right, those of signals (negative, or 128 and more) included."""
    events: tuple[str, ...] = ()
    """Regular expressions; each must be found in an event of the recording, written "name: message"."""
    said: tuple[str, ...] = ()
    """Regular expressions, each of which must be found in standard error."""
    recording: bool | None = True
    """Whether there must be a recording; None: there may be one."""
    finished: bool | None = True
    """Whether the recording must have been closed properly (index, footer, counters); None: it may."""
    ticks: int = 1
    """So many ticks at least are in the recording."""
    traceback: bool = False
    """Whether a traceback is part of what is documented."""
    gone_s: float = GONE_S
    """Within so many seconds after the call nothing of the run lives."""


def violations(remains: Remains, expected: Expected) -> list[str]:
    """What is not as it should be, in words; empty if all is well. Waits for processes at most `gone_s`."""
    return [
        *_processes(remains, expected),
        *_left_over(remains),
        *_codes(remains, expected),
        *_words(remains, expected),
        *_recording(remains, expected),
    ]


def event_lines(recording: Recording) -> list[str]:
    """Every event of a recording as "name: message", in order."""
    if "/event" not in recording.tables:
        return []
    table = recording.table("/event")
    return [
        f"{name}: {message}"
        for name, message in zip(table.column("name"), table.column("message"), strict=True)
    ]


def complaints(work: Path) -> str:
    """What the processes of the runs below a directory wrote into their logs, without Zenoh's known race."""
    logs = sorted(work.rglob(LOG))
    return "".join(_KNOWN.sub("", log.read_text(errors="replace")) for log in logs)


def _processes(remains: Remains, expected: Expected) -> Iterator[str]:
    for process in outliving(remains.mark, expected.gone_s):
        yield f"still alive after {expected.gone_s:g} s: {process}"


def _left_over(remains: Remains) -> Iterator[str]:
    for path in sorted(remains.sockets.rglob("*")):
        kind = "socket" if path.is_socket() else "directory" if path.is_dir() else "file"
        yield f"left in the run's TMPDIR: {kind} {path.relative_to(remains.sockets)}"
    for recording in sorted(remains.work.rglob(RECORDING)):
        for path in sorted(recording.parent.iterdir()):
            if not any(path.match(pattern) for pattern in _BELONGS):
                yield f"left beside the recording: {path.name}"


def _codes(remains: Remains, expected: Expected) -> Iterator[str]:
    code = remains.exit_code
    if code in expected.codes:
        return
    wanted = " or ".join(map(str, expected.codes))
    if code is None:
        yield f"the launcher did not end, expected exit code {wanted}"
    elif code < 0 or code >= 128:
        yield f"exit code {code}, that of a signal or a crash, expected {wanted}"
    else:
        yield f"exit code {code}, expected {wanted}"


def _words(remains: Remains, expected: Expected) -> Iterator[str]:
    for pattern in expected.said:
        if not re.search(pattern, remains.stderr):
            yield f"standard error has no {pattern!r}: {remains.stderr[-_SHOWN:]!r}"
    if expected.traceback:
        return
    said = {
        "standard output": remains.stdout,
        "standard error": _KNOWN.sub("", remains.stderr),
        LOG: complaints(remains.work),
    }
    for where, text in said.items():
        for sign in _BROKEN:
            if sign in text:
                yield f"{where} has a {sign!r}: {text[text.index(sign) :][:_SHOWN]!r}"


def _recording(remains: Remains, expected: Expected) -> Iterator[str]:
    found = sorted(remains.work.rglob(RECORDING))
    if len(found) > 1:
        yield f"{len(found)} recordings below {remains.work}, one was expected"
        return
    if not found:
        if expected.recording:
            yield f"no {RECORDING} below {remains.work}"
        return
    if expected.recording is False:
        yield f"there is a recording, {found[0]}, and none was expected"
        return
    try:
        recording = read_recording(found[0])
    except OctarmError as error:
        yield f"the recording cannot be read: {error}"
        return
    if expected.finished is not None and recording.complete is not expected.finished:
        how = recording.unfinished or ("complete" if recording.complete else "without counters")
        yield f"the recording should {'' if expected.finished else 'not '}be complete; it is: {how}"
    if recording.ticks < expected.ticks:
        yield f"{recording.ticks} ticks recorded, expected at least {expected.ticks}"
    lines = event_lines(recording)
    for pattern in expected.events:
        if not any(re.search(pattern, line) for line in lines):
            yield f"no event matches {pattern!r}; there are {lines}"[: 2 * _SHOWN]
