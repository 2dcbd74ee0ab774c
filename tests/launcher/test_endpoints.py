"""Where a run's processes meet: private, free, short enough, and gone afterwards."""

from __future__ import annotations

import os
import random
import socket
import stat
import tempfile
from pathlib import Path

import pytest
from ports import free_ports

from supervise import endpoints
from supervise.endpoints import HIGHEST_FREE_PORT, choose
from wire.errors import UsageError


def port(endpoint: str) -> int:
    return int(endpoint.rsplit(":", 1)[1])


def test_the_default_is_a_directory_of_its_own() -> None:
    first, second = choose(5, "unix", None, None), choose(5, "unix", None, None)
    try:
        assert first.private is not None
        assert first.private != second.private
        facts = Path(first.private).stat()
        assert stat.S_IMODE(facts.st_mode) == 0o700
        assert len(first.nodes) == 4
        assert len({first.plant, *first.nodes}) == 5
        for endpoint in (first.plant, *first.nodes):
            path = endpoint.partition("/")[2]
            assert Path(path).parent == Path(first.private)
            assert len(path.encode()) <= 107
    finally:
        first.close()
        second.close()
    assert not Path(first.private).exists()
    first.close()  # a second time does nothing


@pytest.mark.parametrize("name", ["x" * 90, "with#sign"])
def test_an_unusable_temporary_directory_is_avoided(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    unusable = tmp_path / name
    unusable.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(unusable))
    chosen = choose(3, "unix", None, None)
    try:
        assert chosen.private is not None
        assert not chosen.private.startswith(str(unusable))
    finally:
        chosen.close()


def test_only_directories_of_dead_runs_are_swept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    monkeypatch.setattr(endpoints, "LONGEST_SOCKET_PATH", 4096)
    dead, fresh, foreign = (tmp_path / n for n in ("octarm-dead", "octarm-fresh", "other-dead"))
    for directory in (dead, fresh, foreign):
        directory.mkdir()
    (dead / "plant.lock").touch()
    with socket.socket(socket.AF_UNIX) as left:
        left.bind(str(dead / "plant"))
    own = tmp_path / "octarm-keys"
    own.mkdir()
    (own / "ca.key").touch()  # a user's directory, by chance with a name like those
    running = choose(2, "unix", None, None)
    assert running.private is not None
    for directory in (dead, foreign, own, Path(running.private)):
        os.utime(directory, (1.0, 1.0))
    second = choose(2, "unix", None, None)
    try:
        assert not dead.exists()
        assert fresh.exists()
        assert foreign.exists()
        assert (own / "ca.key").exists()
        assert Path(running.private).exists()
    finally:
        second.close()
        running.close()


def test_a_given_directory_is_kept_if_it_was_there(tmp_path: Path) -> None:
    mine, new = tmp_path / "mine", tmp_path / "new"
    mine.mkdir()
    for directory in (mine, new):
        chosen = choose(2, "unix", None, directory)
        (directory / "plant").touch()
        with pytest.raises(UsageError, match="in use by another run"):
            choose(2, "unix", None, directory)
        chosen.close()
    assert mine.is_dir()
    assert not new.exists()
    assert list(mine.iterdir()) == []


def test_free_ports_are_free_and_below_the_kernels() -> None:
    chosen = choose(6, "tcp", None, None)
    ports = [port(e) for e in (chosen.plant, *chosen.nodes)]
    assert ports == list(range(ports[0], ports[0] + 6))
    assert ports[-1] < HIGHEST_FREE_PORT
    for number in ports:
        with socket.socket() as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind(("127.0.0.1", number))


def test_programs_that_seed_alike_choose_different_ports() -> None:
    chosen = []
    for _ in range(2):
        random.seed(1)
        chosen.append([free_ports(4) for _ in range(3)])
    assert chosen[0] != chosen[1]


def test_every_port_of_a_base_is_checked() -> None:
    taken = free_ports(5) + 2
    with socket.create_server(("127.0.0.1", taken)):
        for offset in range(3):
            with pytest.raises(UsageError, match=f"port {taken} "):
                choose(3, "tcp", taken - offset, None)


@pytest.mark.parametrize(("base", "nodes"), [(80, 3), (0, 3), (-1, 3), (65_534, 3), (70_000, 2)])
def test_impossible_bases_are_refused(base: int, nodes: int) -> None:
    with pytest.raises(UsageError, match=f"--base-port {base}"):
        choose(nodes, "tcp", base, None)
