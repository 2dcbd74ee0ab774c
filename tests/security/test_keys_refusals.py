"""Keys that cannot be used are refused before a process is started, saying which and why."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from security_runs import keys_made, signed_again

if TYPE_CHECKING:
    from conftest import Start

NODES = 3


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return keys_made(tmp_path_factory.mktemp("made") / "keys", NODES)


@pytest.fixture(scope="module")
def foreign(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return keys_made(tmp_path_factory.mktemp("foreign") / "keys", NODES)


def expired(keys: Path, _: Path) -> None:
    signed_again(keys, "node-1", -2.0, -1.0)


def not_yet(keys: Path, _: Path) -> None:
    signed_again(keys, "plant", 1.0, 2.0)


def missing_node(keys: Path, _: Path) -> None:
    (keys / "node-2.pem").unlink()


def missing_authority(keys: Path, _: Path) -> None:
    (keys / "ca.pem").unlink()


def missing_key(keys: Path, _: Path) -> None:
    (keys / "recorder.key").unlink()


def open_to_the_group(keys: Path, _: Path) -> None:
    (keys / "node-1.key").chmod(0o640)


def another_key(keys: Path, _: Path) -> None:
    shutil.copy(keys / "node-2.key", keys / "node-1.key")


def another_certificate(keys: Path, _: Path) -> None:
    for end in ("pem", "key"):
        shutil.copy(keys / f"node-2.{end}", keys / f"node-1.{end}")


def another_authority(keys: Path, foreign: Path) -> None:
    for end in ("pem", "key"):
        shutil.copy(foreign / f"node-1.{end}", keys / f"node-1.{end}")


def not_a_certificate(keys: Path, _: Path) -> None:
    (keys / "plant.pem").write_text("-----BEGIN CERTIFICATE-----\nnothing\n")


def not_a_key(keys: Path, _: Path) -> None:
    (keys / "plant.key").write_text("nothing")


WRONG: list[tuple[Callable[[Path, Path], None], list[str]]] = [
    (expired, ["node-1.pem expired: it is for ", "make new keys with `octarm keys`"]),
    (not_yet, ["plant.pem is not valid yet: it is for "]),
    (missing_node, ["node-2.pem: No such file or directory; `octarm keys` makes it, with as many"]),
    (missing_authority, ["ca.pem: No such file or directory"]),
    (missing_key, ["recorder.key: No such file or directory"]),
    (open_to_the_group, ["node-1.key on ", " is open to others (mode 0640)", "chmod 600 "]),
    (another_key, ["node-1.key does not belong to ", "node-1.pem"]),
    (
        another_certificate,
        ["node-1.pem: expected the certificate of node-1, got that of CN=node-2"],
    ),
    (another_authority, ["node-1.pem is not signed by ", "ca.pem"]),
    (not_a_certificate, ["plant.pem: not a certificate"]),
    (not_a_key, ["plant.key: not a private key"]),
]


def refused(start: Start, *options: str | Path) -> str:
    """The one message of a run that was not started."""
    cli = start.run("--ticks", "5", "--no-plot", *options)
    assert cli.finish() == 2, cli.err
    assert "Traceback" not in cli.err
    assert len(cli.err.splitlines()) == 1
    assert list(cli.work.iterdir()) == []  # neither directory nor log
    return cli.err


@pytest.mark.parametrize(("spoil", "messages"), WRONG, ids=[one.__name__ for one, _ in WRONG])
def test_unusable_keys(
    start: Start,
    made: Path,
    foreign: Path,
    tmp_path: Path,
    spoil: Callable[[Path, Path], None],
    messages: list[str],
) -> None:
    keys = tmp_path / "keys"
    shutil.copytree(made, keys)
    spoil(keys, foreign)
    error = refused(start, "--nodes", str(NODES), "--keys", keys)
    assert "--keys: " in error
    for message in messages:
        assert message in error


@pytest.mark.skipif(os.geteuid() == 0, reason="root can read everything")
def test_an_unreadable_key(start: Start, made: Path, tmp_path: Path) -> None:
    keys = tmp_path / "keys"
    shutil.copytree(made, keys)
    (keys / "plant.key").chmod(0)
    assert "Permission denied" in refused(start, "--nodes", str(NODES), "--keys", keys)


def test_too_few_keys(start: Start, made: Path) -> None:
    error = refused(start, "--nodes", "8", "--keys", made)
    assert "node-3.pem: No such file or directory" in error


def test_processes_of_several_segments_need_their_own_alone(
    start: Start, made: Path, tmp_path: Path
) -> None:
    keys = tmp_path / "keys"
    shutil.copytree(made, keys)
    (keys / "node-1.pem").unlink()
    cli = start.run(
        *(
            "--nodes",
            "3",
            "--segments-per-process",
            "2",
            "--ticks",
            "20",
            "--no-plot",
            "--keys",
            keys,
        )
    )
    assert cli.finish() == 0, cli.err


def test_no_directory_of_sockets_with_keys(start: Start, made: Path, tmp_path: Path) -> None:
    error = refused(start, "--nodes", "3", "--keys", made, "--socket-dir", tmp_path / "sockets")
    assert "--socket-dir: with --keys processes meet over TLS" in error


def test_keys_without_the_address_of_a_host(start: Start, made: Path, tmp_path: Path) -> None:
    hosts = tmp_path / "hosts.toml"
    hosts.write_text(
        '[plant]\naddress = "127.0.0.1"\n[[hosts]]\nname = "here"\naddress = "127.0.0.3"\nnodes = 3\n'
    )
    error = refused(start, "--nodes", "3", "--keys", made, "--hosts", hosts)
    assert "node-0.pem is not for the address 127.0.0.3, where others dial node-0" in error
