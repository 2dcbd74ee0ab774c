"""The live page of a run with keys: it may read everything that it shows, and its certificate nothing more."""

from __future__ import annotations

import signal
from pathlib import Path
from typing import TYPE_CHECKING

from live_page import address, events
from security_runs import keys_made

if TYPE_CHECKING:
    from conftest import Start


def test_the_live_page_shows_a_run_with_keys(start: Start, tmp_path: Path) -> None:
    keys = keys_made(tmp_path / "keys", 3)
    realtime = ("--realtime", "--tick", "0.05", "--ticks", "10000", "--hold-ticks", "1000")
    cli = start.run("--nodes", "3", *realtime, "--no-plot", "--live", "--keys", keys)
    cli.wait_for("live at ")
    port = address(cli.err)
    assert port is not None
    alive: list[bool] = []
    for kind, content in events(port):
        if kind == "state":
            alive = content["alive"]
        elif content["tick"] > 20 and alive == [True] * 3:
            break
    cli.popen.send_signal(signal.SIGINT)
    assert cli.finish() == 130
    assert "refused" not in cli.err
    assert cli.gone() == {}
