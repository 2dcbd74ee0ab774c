"""The hand-written Zenoh peer says what it should: another session hears it, over TCP and over TLS."""

from __future__ import annotations

import subprocess
import sys
import time
from pathlib import Path

import pytest
from bare_peer import BarePeer, client_context
from ports import free_ports
from security_runs import ROOT, keys_made

LISTENER = """
import sys, json
from wire import session
listen, tls = json.loads(sys.argv[1])
config = session._config("router", [listen], [], 10_000)
if tls:
    config["transport"]["link"] |= {"protocols": ["tls"], "tls": tls}
import zenoh
one = zenoh.open(zenoh.Config.from_json5(json.dumps(config)))
def hear(sample):
    print(str(sample.key_expr), len(bytes(sample.payload)), flush=True)
subscriber = one.declare_subscriber("a/*", zenoh.handlers.Callback(hear, indirect=False))
print("up", flush=True)
sys.stdin.read()
subscriber.undeclare()
one.close()
"""


@pytest.mark.parametrize("secured", [False, True])
def test_another_session_hears_it(tmp_path: Path, secured: bool) -> None:
    import json

    port = free_ports()
    tls, context = None, None
    if secured:
        keys = keys_made(tmp_path / "keys", 2)
        context = client_context(keys, "node-1")
        tls = {
            "root_ca_certificate": str(keys / "ca.pem"),
            "listen_certificate": str(keys / "plant.pem"),
            "listen_private_key": str(keys / "plant.key"),
            "enable_mtls": True,
        }
    endpoint = f"{'tls' if secured else 'tcp'}/127.0.0.1:{port}"
    command = [sys.executable, "-c", LISTENER, json.dumps([endpoint, tls])]
    with subprocess.Popen(
        command, cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as listener:
        assert listener.stdout is not None and listener.stdin is not None
        assert listener.stdout.readline() == "up\n"
        with BarePeer(port, context) as peer:
            peer.put("a/b", b"12345")
            peer.put("b/b", b"not asked for")
            peer.put("a/*", b"x" * 300, times=3)
            heard = [listener.stdout.readline() for _ in range(4)]
            time.sleep(0.1)
        listener.stdin.close()
        heard += listener.stdout.readlines()
    assert heard == ["a/b 5\n", *["a/* 300\n"] * 3]
