"""The check after every fault finds each thing that can be wrong, and nothing after a run that went well."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import pytest
from conftest import Cli, Start

from chaos.aftermath import LOG, Expected, Remains, complaints, violations
from chaos.processes import marked


@pytest.fixture(scope="module")
def ended(tmp_path_factory: pytest.TempPathFactory, gains: Path) -> Iterator[Cli]:
    cli = Start(tmp_path_factory.mktemp("ended"), gains).run(
        "--nodes", "3", "--ticks", "20", "--no-plot", "--quiet"
    )
    try:
        assert cli.finish() == 0, cli.err
        yield cli
    finally:
        cli.close()


def _only(remains: Remains, expected: Expected, text: str) -> None:
    (found,) = violations(remains, expected)
    assert text in found


def test_a_run_that_went_well_has_none(ended: Cli) -> None:
    fine = Expected((0,), (r"^started: 3 nodes", r"^finished: all 20 ticks"), ticks=20)
    assert violations(ended.remains(), fine) == []


def test_a_process_that_lives_on_is_named(ended: Cli) -> None:
    command = [sys.executable, "-c", "print(1, flush=True); input()"]
    environment = {**os.environ, **marked(ended.mark)}
    pipe = subprocess.PIPE
    with subprocess.Popen(command, env=environment, stdin=pipe, stdout=pipe) as orphan:
        assert orphan.stdout is not None
        orphan.stdout.readline()
        _only(
            ended.remains(),
            Expected(gone_s=0.1),
            f"still alive after 0.1 s: python (pid {orphan.pid})",
        )
        orphan.communicate(b"\n")


def test_what_is_left_in_the_private_directory_is_named(ended: Cli) -> None:
    with socket.socket(socket.AF_UNIX) as bound:
        bound.bind(str(ended.sockets / "node0"))
        _only(ended.remains(), Expected(), "left in the run's TMPDIR: socket node0")
    (ended.sockets / "node0").unlink()


def test_what_is_left_beside_the_recording_is_named(ended: Cli) -> None:
    stray = ended.recording().with_name("recording.reserve")
    stray.touch()
    _only(ended.remains(), Expected(), "left beside the recording: recording.reserve")
    stray.unlink()


@pytest.mark.parametrize(
    ("change", "expected", "text"),
    [
        (lambda r: replace(r, exit_code=4), Expected(), "exit code 4, expected 0"),
        (lambda r: replace(r, exit_code=-11), Expected((0, 3)), "exit code -11, that of a signal"),
        (lambda r: replace(r, exit_code=None), Expected(), "the launcher did not end"),
        (lambda r: r, Expected((0, 3), ("disk_full",)), "no event matches 'disk_full'"),
        (lambda r: r, Expected(said=("the disk",)), "standard error has no 'the disk'"),
        (lambda r: r, Expected(recording=False), "none was expected"),
        (lambda r: r, Expected(finished=False), "should not be complete; it is: complete"),
        (lambda r: r, Expected(ticks=21), "20 ticks recorded, expected at least 21"),
        (
            lambda r: replace(r, stderr="Traceback (most recent call last):\n  boom"),
            Expected(),
            "standard error has a 'Traceback",
        ),
    ],
)
def test_what_is_not_as_expected_is_told(
    ended: Cli, change: Callable[[Remains], Remains], expected: Expected, text: str
) -> None:
    _only(change(ended.remains()), expected, text)


def test_a_traceback_in_the_log_of_the_processes_is_told(ended: Cli) -> None:
    log = ended.recording().with_name(LOG)
    log.write_text("Traceback (most recent call last):\n")
    _only(ended.remains(), Expected(), "processes.log has a 'Traceback")
    assert violations(ended.remains(), Expected(traceback=True)) == []
    log.unlink()


PANIC = """
thread 'app-2' (8443) panicked at /build/zenoh/src/net/routing/dispatcher/{place}:
called `Option::unwrap()` on a `None` value
stack backtrace:
   0: __rustc::rust_begin_unwind
             at /rustc/library/std/src/panicking.rs:1:2
  13: zenoh_transport::unicast::read_messages::<zenoh_buffers::zslice::ZSlice>
note: Some details are omitted, run with `RUST_BACKTRACE=full` for a verbose backtrace.
"""


def test_one_panic_of_zenoh_is_known_and_no_other(ended: Cli) -> None:
    log = ended.recording().with_name(LOG)
    known = PANIC.format(place="resource.rs:486:27")
    log.write_text(known + "welcome\n" + known)
    assert violations(ended.remains(), Expected()) == []
    assert complaints(ended.work) == "welcome\n"
    log.write_text(known + PANIC.format(place="resource.rs:487:27") + known)
    _only(ended.remains(), Expected(), "processes.log has a 'panicked at'")
    log.unlink()


def test_a_recording_that_ends_early_or_is_none_is_told(ended: Cli, tmp_path: Path) -> None:
    whole = ended.recording().read_bytes()
    remains = replace(ended.remains(), work=tmp_path)
    _only(remains, Expected(), "no recording.mcap below")
    assert violations(remains, Expected(recording=None)) == []
    (tmp_path / "recording.mcap").write_bytes(whole[: len(whole) - 100])
    _only(remains, Expected(ticks=20), "the recording should be complete; it is: ")
    (tmp_path / "recording.mcap").write_bytes(b"no recording")
    _only(remains, Expected(), "the recording cannot be read")
