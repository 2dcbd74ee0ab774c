"""`octarm keys`, looked at with the standard library's TLS and with openssl: who can speak to whom."""

from __future__ import annotations

import json
import shutil
import ssl
import subprocess
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
from security_runs import keys_made

if TYPE_CHECKING:
    from conftest import Start

HOSTS = """
[plant]
address = "192.0.2.1"
[[hosts]]
name = "root-side"
address = "192.0.2.1"
nodes = 2
[[hosts]]
name = "tip-side"
address = "tip.example"
nodes = 1
start = "ssh tip.example"
"""


@pytest.fixture(scope="module")
def keys(tmp_path_factory: pytest.TempPathFactory) -> Path:
    directory = tmp_path_factory.mktemp("keys")
    (directory / "hosts.toml").write_text(HOSTS)
    return keys_made(directory / "keys", 3, "--hosts", directory / "hosts.toml")


@pytest.fixture(scope="module")
def foreign(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return keys_made(tmp_path_factory.mktemp("foreign") / "keys", 3)


def handshake(
    server: tuple[Path, str], client: tuple[Path, str] | None, believes: Path, address: str
) -> str:
    """Both ends of a mutual handshake in memory; the common name that the server sees."""
    there = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    there.load_cert_chain(server[0] / f"{server[1]}.pem", server[0] / f"{server[1]}.key")
    there.load_verify_locations(server[0] / "ca.pem")
    there.verify_mode = ssl.CERT_REQUIRED
    here = ssl.create_default_context(cafile=str(believes / "ca.pem"))
    if client is not None:
        here.load_cert_chain(client[0] / f"{client[1]}.pem", client[0] / f"{client[1]}.key")
    to_server, to_client = ssl.MemoryBIO(), ssl.MemoryBIO()
    ends = (
        here.wrap_bio(to_client, to_server, server_hostname=address),
        there.wrap_bio(to_server, to_client, server_side=True),
    )
    done: set[int] = set()
    for _ in range(10):
        for number, end in enumerate(ends):
            if number not in done:
                try:
                    end.do_handshake()
                    done.add(number)
                except ssl.SSLWantReadError:
                    continue
    assert done == {0, 1}
    seen = ends[1].getpeercert()
    assert seen is not None
    subject: Any = seen["subject"]
    return str(dict(pair for part in subject for pair in part)["commonName"])


def test_everybody_can_speak_to_everybody_on_this_machine(keys: Path) -> None:
    for server in ("plant", "node-0", "node-2"):
        for client in ("node-1", "recorder", "live"):
            for address in ("127.0.0.1", "localhost", "::1"):
                assert handshake((keys, server), (keys, client), keys, address) == client


def test_a_certificate_is_for_its_own_host(keys: Path) -> None:
    assert handshake((keys, "plant"), (keys, "node-2"), keys, "192.0.2.1") == "node-2"
    assert handshake((keys, "node-2"), (keys, "node-1"), keys, "tip.example") == "node-1"
    for server, address in (("node-2", "192.0.2.1"), ("plant", "tip.example")):
        with pytest.raises(ssl.SSLCertVerificationError, match="mismatch"):
            handshake((keys, server), (keys, "node-1"), keys, address)


def test_another_authority_is_not_believed(keys: Path, foreign: Path) -> None:
    with pytest.raises(ssl.SSLError):
        handshake((keys, "plant"), (foreign, "node-1"), keys, "127.0.0.1")
    with pytest.raises(ssl.SSLCertVerificationError):
        handshake((foreign, "plant"), (keys, "node-1"), keys, "127.0.0.1")
    with pytest.raises(ssl.SSLError):
        handshake((keys, "plant"), None, keys, "127.0.0.1")


def test_private_keys_are_private(keys: Path) -> None:
    assert keys.stat().st_mode & 0o777 == 0o700
    private = sorted(keys.glob("*.key"))
    assert [one.stem for one in private] == sorted(one.stem for one in keys.glob("*.pem"))
    assert {one.stat().st_mode & 0o777 for one in private} == {0o600}
    assert all(b"PRIVATE" not in one.read_bytes() for one in keys.glob("*.pem"))
    assert len({one.read_bytes() for one in private}) == len(private)


@pytest.mark.skipif(shutil.which("openssl") is None, reason="no openssl program")
def test_openssl_agrees(keys: Path) -> None:
    for name in ("plant", "recorder", "live", "node-0", "node-1", "node-2"):
        for purpose in ("sslserver", "sslclient"):
            command = ["openssl", "verify", "-x509_strict", "-purpose", purpose]
            words = [*command, "-CAfile", str(keys / "ca.pem"), str(keys / f"{name}.pem")]
            assert subprocess.run(words, check=True, capture_output=True).stdout.endswith(b"OK\n")
        words = ["openssl", "x509", "-noout", "-text", "-in", str(keys / f"{name}.pem")]
        text = subprocess.run(words, check=True, capture_output=True, text=True).stdout
        assert f"Subject: CN = {name}\n" in text or f"Subject: CN={name}\n" in text
        assert "NIST CURVE: P-256" in text
        assert "CA:FALSE" in text


def test_what_goes_where_is_printed(start: Start, tmp_path: Path) -> None:
    (tmp_path / "hosts.toml").write_text(HOSTS)
    words = ("--nodes", "3", "--hosts", str(tmp_path / "hosts.toml"), "--days", "7")
    told = start("keys", "--out", "keys", *words)
    assert told.finish() == 0, told.err
    assert "to tip-side: ca.pem, and .pem and .key of node-2\n" in told.out
    assert (
        "here stay: ca.pem, and .pem and .key of plant, recorder, live, node-0, node-1\n"
        in told.out
    )
    assert "ca.key makes certificates that every process believes" in told.out
    plain = start("keys", "--out", "keys", *words, "--json")
    assert plain.finish() == 0, plain.err
    facts = json.loads(plain.out)
    assert facts["to_hosts"] == {"tip-side": ["ca.pem", "node-2.pem", "node-2.key"]}
    assert facts["certificates"]["node-2"] == ["tip.example"]
    assert sorted(facts["certificates"]) == sorted(
        one.stem for one in (plain.work / "keys").glob("*.pem") if one.stem != "ca"
    )


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--nodes", "1"), "--nodes: expected 2..1000, got 1"),
        (("--days", "0"), "--days: expected 1..3650, got 0"),
        (("--hosts", "none.toml"), "--hosts none.toml: No such file or directory"),
        (("--out", "/proc/keys"), "--out /proc/keys: "),
    ],
)
def test_wrong_options_are_refused(start: Start, options: tuple[str, ...], message: str) -> None:
    cli = start("keys", "--out", "keys", *options)
    assert cli.finish() == 2
    assert message in cli.err
    assert "Traceback" not in cli.err
    assert list(cli.work.iterdir()) == []


def test_nothing_is_written_over(start: Start, keys: Path) -> None:
    before = {one.name: one.read_bytes() for one in keys.iterdir()}
    cli = start("keys", "--out", keys, "--nodes", "3")
    assert cli.finish() == 2
    assert "there is something in it already" in cli.err
    assert {one.name: one.read_bytes() for one in keys.iterdir()} == before
