"""`octarm deploy`, `octarm doctor` and the help."""

from __future__ import annotations

import inspect
import json
import shutil
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

import launcher
from deploy import deploy
from supervise.options import RunOptions
from wire.artefact import read_artefact

Array = npt.NDArray[np.float64]

if TYPE_CHECKING:
    from conftest import Start


def times(matrix: Array, vector: Array) -> Array:
    """The product, also where a matrix without rows or columns lost its shape in JSON."""
    if matrix.size == 0:
        return np.zeros(len(matrix))
    return np.asarray(matrix @ vector)


def test_deploy_writes_factors_that_give_the_dense_step(start: Start) -> None:
    cli = start("deploy", "--gains", start.gains, "--nodes", "5", "--out", "factors.json", "--json")
    assert cli.finish() == 0, cli.err
    facts = cli.json()
    assert facts["messages_per_tick"] == 8
    assert facts["largest_difference_to_dense"] < 1e-10
    written = json.loads((cli.work / "factors.json").read_text())
    dense = deploy(read_artefact(start.gains), 5, 0.1).dense[1]
    inputs = np.random.default_rng(4).normal(size=(5, 7))
    nodes = [node["setpoints"][1] for node in written["nodes"]]
    x = [inputs[i] - np.array(f["in_offset"]) for i, f in enumerate(nodes)]
    shaped = [{k: np.array(v) for k, v in f.items()} for f in nodes]
    c = np.zeros(0)
    forward: list[Array] = []
    for f, xi in zip(shaped, x, strict=True):
        forward.append(c)
        c = times(f["W"], c) + times(f["Q"], xi)
    d = np.zeros(0)
    backward: list[Array] = []
    for f, xi in zip(shaped[::-1], x[::-1], strict=True):
        backward.insert(0, d)
        d = times(f["V"], d) + times(f["R"], xi)
    for i, f in enumerate(shaped):
        out = f["D"] @ x[i] + f["out_offset"]
        out = out + times(f["P"], forward[i]) + times(f["U"], backward[i])
        np.testing.assert_allclose(out, dense(inputs)[i], rtol=1e-9, atol=1e-12)


def test_deploy_prints_a_table(start: Start) -> None:
    cli = start("deploy", "--gains", start.gains, "--nodes", "3")
    assert cli.finish() == 0, cli.err
    assert "straight" in cli.out
    assert "4 neighbour messages a tick" in cli.out


def test_doctor_exchanges_messages_over_zenoh(start: Start) -> None:
    cli = start("doctor", "--json")
    cli.finish()
    checks = {check["name"]: check for check in cli.json()["checks"]}
    assert {"python", "packages", "unix sockets", "loopback ports", "exchange"} <= checks.keys()
    assert ("no MP4 films" in checks["extras"]["found"]) == (shutil.which("ffmpeg") is None)
    for name in ("python", "packages", "unix sockets", "loopback ports", "exchange"):
        assert checks[name]["ok"], checks[name]
    assert cli.json()["ok"] == all(check["ok"] for check in checks.values())
    assert cli.popen.returncode == (0 if cli.json()["ok"] else 1)
    assert list(cli.sockets.iterdir()) == []


def test_help_names_verbs_and_options(start: Start) -> None:
    cli = start("--help")
    assert cli.finish() == 0
    for verb in (
        "run",
        "design",
        "deploy",
        "plot",
        "animate",
        "replay",
        "diff",
        "export",
        "study",
        "doctor",
    ):
        assert verb in cli.out
    options = start("run", "--help")
    assert options.finish() == 0
    for option in ("--nodes", "--ticks", "--seed", "--json", "--socket-dir", "--no-plot"):
        assert option in options.out


def test_the_command_line_has_the_defaults_of_the_options() -> None:
    names = {"tick": "tick_s", "start_timeout": "start_timeout_s", "deadline": "deadline_s"}
    names["period"] = "period_s"
    own = {"json", "no_plot", "quiet", "no_pin", "sched"}
    options = RunOptions()
    for name, parameter in inspect.signature(launcher.run).parameters.items():
        if name not in own:
            assert parameter.default == getattr(options, names.get(name, name)), name
