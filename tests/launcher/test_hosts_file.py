"""Hosts files: what is read, what is refused, and the endpoints that follow from it."""

from __future__ import annotations

import socket
from pathlib import Path

import in_process
import pytest

from supervise.endpoints import over_hosts
from supervise.hosts import Host, Hosts, read_hosts
from supervise.options import RunOptions
from wire.errors import UsageError

EXAMPLE = Path(__file__).resolve().parents[2] / "examples" / "hosts.toml"
PLANT = '[plant]\naddress = "127.0.0.1"\n'
ROOT_SIDE = '[[hosts]]\nname = "root-side"\naddress = "127.0.0.1"\nnodes = 2\n'
TIP_SIDE = '[[hosts]]\nname = "tip-side"\naddress = "10.77.0.2"\nnodes = 2\n'
SSH = 'start = "ssh tip-side"\n'


def read(tmp_path: Path, text: str, nodes: int = 4) -> Hosts:
    path = tmp_path / "hosts.toml"
    path.write_text(text)
    return read_hosts(path, nodes)


def test_hosts_follow_each_other_along_the_arm(tmp_path: Path) -> None:
    root, tip = read(tmp_path, PLANT + ROOT_SIDE + TIP_SIDE + SSH + "same_clock = true\n").hosts
    assert (list(root.indices), list(tip.indices)) == ([0, 1], [2, 3])
    assert root.local
    assert not root.own_clock
    assert not tip.local
    assert not tip.own_clock
    assert tip.base_port == 17_000
    assert " ".join(tip.zygote_command()) == (
        "ssh tip-side env -C octarm .venv/bin/python -m node --zygote --remote"
    )


def test_the_shipped_example_can_be_read() -> None:
    hosts = read_hosts(EXAMPLE, 10)
    assert [host.nodes for host in hosts.hosts] == [5, 5]
    assert [host.local for host in hosts.hosts] == [True, False]


def test_a_host_whose_nodes_the_user_starts(tmp_path: Path) -> None:
    text = PLANT + ROOT_SIDE + TIP_SIDE + 'start = "print"\npython = "python3.12"\n'
    _, tip = read(tmp_path, text).hosts
    assert tip.by_hand
    assert tip.own_clock
    assert tip.start == ()
    assert tip.hand_command("node-3.json") == "cd octarm && python3.12 -m node node-3.json"


WRONG = {
    "not TOML": ("[plant", "hosts.toml"),
    "no plant": (ROOT_SIDE, "`plant`"),
    "unknown key": (PLANT + ROOT_SIDE + 'user = "me"\n', "`user`"),
    "wrong type": (PLANT + ROOT_SIDE.replace("= 2", '= "two"'), "$.hosts[0].nodes"),
    "no host": (PLANT + "hosts = []\n", "`hosts`"),
    "too few nodes": (PLANT + ROOT_SIDE, "expected --nodes 4 nodes in all, got 2 = 2"),
    "too many nodes": (PLANT + ROOT_SIDE + TIP_SIDE.replace("= 2", "= 3") + SSH, "2 + 3 = 5"),
    "no node": (PLANT + ROOT_SIDE.replace("= 2", "= 0"), "hosts[0].nodes: expected at least 1"),
    "one name twice": (PLANT + ROOT_SIDE * 2, "hosts[1].name: there is a host 'root-side'"),
    "no name": (PLANT + ROOT_SIDE.replace("root-side", "root side"), "hosts[0].name"),
    "address with a port": (PLANT + ROOT_SIDE.replace("0.0.1", "0.0.1:80"), "hosts[0].address"),
    "no address": (PLANT + ROOT_SIDE.replace("127.0.0.1", "300.1.1.1"), "hosts[0].address"),
    "any address": (PLANT.replace("127.0.0.1", "0.0.0.0") + ROOT_SIDE, "plant.address"),
    "low port": (PLANT + ROOT_SIDE + "base_port = 80\n", "hosts[0].base_port: expected 1024.."),
    "high port": (PLANT + "port = 70000\n" + ROOT_SIDE, "plant.port: expected 1024..65535"),
    "open quote": (PLANT + ROOT_SIDE + 'start = "ssh \'x"\n', "hosts[0].start"),
    "folder for this machine": (PLANT + ROOT_SIDE + 'directory = "x"\n', "hosts[0].directory"),
    "folder with a blank": (
        PLANT + ROOT_SIDE + TIP_SIDE + SSH + 'directory = "my arm"\n',
        "hosts[1].directory",
    ),
    "python with options": (
        PLANT + ROOT_SIDE + TIP_SIDE + SSH + 'python = "python3; true"\n',
        "hosts[1].python",
    ),
}


@pytest.mark.parametrize("case", WRONG)
def test_wrong_files_are_refused(
    case: str, gains: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    text, culprit = WRONG[case]
    path = tmp_path / "hosts.toml"
    path.write_text(text)
    assert in_process.octarm("run", "--gains", gains, "--nodes", "4", "--hosts", path) == 2
    err = capfd.readouterr().err
    assert str(path) in err
    assert culprit in err
    assert "Traceback" not in err


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"--hosts .*none\.toml: No such file"):
        read_hosts(tmp_path / "none.toml", 4)


def test_places_of_a_run_on_one_machine_are_refused_beside_a_file(tmp_path: Path) -> None:
    path = tmp_path / "hosts.toml"
    path.write_text(PLANT + ROOT_SIDE + TIP_SIDE + SSH)
    with pytest.raises(UsageError, match="--base-port: with --hosts"):
        RunOptions(nodes=4, hosts=path, base_port=20_000)
    with pytest.raises(UsageError, match="--socket-dir: with --hosts"):
        RunOptions(nodes=4, hosts=path, socket_dir=tmp_path)


def test_endpoints_are_the_addresses_of_the_file(tmp_path: Path) -> None:
    chosen = over_hosts(read(tmp_path, PLANT + ROOT_SIDE + TIP_SIDE + SSH))
    assert chosen.plant.startswith("tcp/127.0.0.1:")
    assert [node.rpartition(":")[0] for node in chosen.nodes] == [
        "tcp/127.0.0.1",
        "tcp/127.0.0.1",
        "tcp/10.77.0.2",
    ]
    assert chosen.nodes[2] == "tcp/10.77.0.2:17000"
    assert len({chosen.plant, *chosen.nodes}) == 4
    assert chosen.private is None


def test_an_address_of_another_machine_is_refused_for_this_one(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"plant: nothing can listen on 10\.77\.0\.1 here"):
        over_hosts(read(tmp_path, PLANT.replace("127.0.0.1", "10.77.0.1") + ROOT_SIDE, 2))
    with pytest.raises(UsageError, match=r"host tip-side: nothing can listen on 10\.77\.0\.2 here"):
        over_hosts(read(tmp_path, PLANT + TIP_SIDE, 2))


def test_a_taken_port_of_this_machine_is_named(tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
        with pytest.raises(UsageError, match=f"plant: port {port} of 127.0.0.1 cannot be used"):
            over_hosts(read(tmp_path, PLANT + f"port = {port}\n" + ROOT_SIDE, 2))
        with pytest.raises(UsageError, match=f"host root-side: port {port} of 127.0.0.1"):
            over_hosts(read(tmp_path, PLANT + ROOT_SIDE + f"base_port = {port}\n", 2))


def test_two_listeners_on_one_port_are_refused(tmp_path: Path) -> None:
    other = TIP_SIDE.replace("tip-side", "middle")
    with pytest.raises(UsageError, match=r"node 2 of host tip-side and node 0 would both listen"):
        over_hosts(read(tmp_path, PLANT + other + SSH + TIP_SIDE + SSH))


def test_numbered_addresses_of_the_new_kind() -> None:
    host = Host("a", "fd00::1", 0, 2, start=("ssh", "a"), base_port=17_000)
    chosen = over_hosts(Hosts(Path("hosts.toml"), "127.0.0.1", None, (host,)))
    assert chosen.nodes == ["tcp/[fd00::1]:17000"]


def test_a_process_of_several_segments_is_on_one_host(tmp_path: Path) -> None:
    file = tmp_path / "hosts.toml"
    file.write_text(
        '[plant]\naddress = "127.0.0.1"\n'
        '[[hosts]]\nname = "root"\naddress = "127.0.0.1"\nnodes = 3\n'
        '[[hosts]]\nname = "tip"\naddress = "127.0.0.1"\nnodes = 3\n'
    )
    assert RunOptions(nodes=6, hosts=file, segments_per_process=3).placed_on is not None
    with pytest.raises(UsageError, match="host tip begins with segment 3, in the middle of a"):
        RunOptions(nodes=6, hosts=file, segments_per_process=2)
