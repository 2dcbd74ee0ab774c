"""Keys on several hosts: every host has its own directory, the start command carries paths and no key."""

from __future__ import annotations

import json
import shutil
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from ports import free_ports
from security_runs import ROOT, keys_made, signed_again

from analysis.recording import read_recording
from analysis.summary import summary_of

if TYPE_CHECKING:
    from conftest import Start

SSH = f"{sys.executable} {ROOT / 'tests' / 'launcher' / 'stand_in_ssh.py'} tip-side"


def hosts_file(tmp_path: Path, *more: str) -> Path:
    """Two nodes here, two behind a start command at another address of the loopback."""
    path = tmp_path / "hosts.toml"
    path.write_text(
        '[plant]\naddress = "127.0.0.1"\n'
        '[[hosts]]\nname = "root-side"\naddress = "127.0.0.1"\nnodes = 2\n'
        '[[hosts]]\nname = "tip-side"\naddress = "127.0.0.2"\nnodes = 2\n'
        f'start = """{SSH}"""\ndirectory = "{ROOT}"\npython = "{sys.executable}"\n'
        f"base_port = {free_ports(2, '127.0.0.2')}\n" + "\n".join(more)
    )
    return path


def shared_out(tmp_path: Path, hosts: Path, expired: str = "") -> tuple[Path, Path]:
    """Keys here and on the other host, each with its own files alone."""
    here, there = keys_made(tmp_path / "here", 4, "--hosts", hosts), tmp_path / "there"
    if expired:
        signed_again(here, expired, -2.0, -1.0)
    there.mkdir()
    shutil.copy(here / "ca.pem", there)
    for name in ("node-2", "node-3"):
        for end in ("pem", "key"):
            (here / f"{name}.{end}").rename(there / f"{name}.{end}")
    (here / "ca.key").unlink()
    return here, there


def test_each_host_has_its_own_keys(start: Start, tmp_path: Path) -> None:
    hosts = hosts_file(tmp_path, f'keys = "{tmp_path / "there"}"')
    here, there = shared_out(tmp_path, hosts)
    cli = start.run(
        *("--nodes", "4", "--ticks", "40", "--no-plot", "--hosts", hosts, "--keys", here)
    )
    assert cli.finish() == 0, cli.err
    recording = read_recording(cli.recording())
    summary = summary_of(recording)
    assert summary["neighbour_messages"] == 40 * 6
    assert summary["refused_peers"] == []
    # What is recorded has neither keys nor the numbers of this run.
    nodes = json.loads(recording.attachments["nodes.json"])
    assert [one["links"]["tls"] for one in nodes] == [None] * 4
    raw = cli.recording().read_bytes()
    assert not any(
        key.read_bytes()[28:60] in raw for key in (*here.glob("*.key"), *there.glob("*.key"))
    )


def test_a_key_that_the_other_host_does_not_have_is_named(start: Start, tmp_path: Path) -> None:
    hosts = hosts_file(tmp_path, f'keys = "{tmp_path / "there"}"')
    here, there = shared_out(tmp_path, hosts)
    (there / "node-3.key").unlink()
    cli = start.run(
        *("--nodes", "4", "--ticks", "40", "--no-plot", "--hosts", hosts, "--keys", here)
    )
    assert cli.finish() == 2
    assert f"node 3: --keys: cannot read {there / 'node-3.key'} on " in cli.err
    assert "No such file or directory" in cli.err
    assert "Traceback" not in cli.err
    assert cli.gone() == {}


def test_an_expired_certificate_on_the_other_host_is_named(start: Start, tmp_path: Path) -> None:
    """It cannot be looked at from here: those that it is shown to refuse it."""
    hosts = hosts_file(tmp_path, f'keys = "{tmp_path / "there"}"')
    here, _ = shared_out(tmp_path, hosts, expired="node-2")
    cli = start.run(
        *("--nodes", "4", "--ticks", "40", "--no-plot", "--hosts", hosts, "--keys", here),
        *("--start-timeout", "4"),
    )
    assert cli.finish() == 5
    lines = cli.err.splitlines()
    assert "plant refused a certificate that is not valid (certificate expired)" in lines
    assert "node 1 refused a certificate that is not valid (certificate expired)" in lines
    assert "node 1 waits for node 2" in cli.err
    assert cli.gone() == {}
