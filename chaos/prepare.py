"""What a run is given wrong: damaged files, taken places; laid out before it is started.

Part of a case, beside `chaos.inject`, whose faults come while the run is there.
"""

from __future__ import annotations

import re
import shutil
import socket
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from random import Random

from chaos.draw import Case, Fault, RunDraw
from supervise.hosts import this_machine
from supervise.keys import make_keys
from supervise.secured import holders
from supervise.shipped import DEFAULT_GAINS, SCENARIOS

LOOPBACK = "127.0.0.1"


@dataclass
class Prepared:
    """Options that lead the run to what is wrong, and what must stay until its end."""

    arguments: list[str]
    what: str
    code: int
    """Exit code of the refusal."""
    said: str
    """Regular expression that the refusal matches."""
    harmless: bool = False
    """The damage may be one that nobody can see, as in a comment: then the run goes as any other."""
    listening: list[socket.socket] = field(default_factory=list)

    def close(self) -> None:
        """Give taken ports back."""
        for one in self.listening:
            one.close()


def prepare(case: Case, fault: Fault, work: Path) -> Prepared:
    """Lay out a fault of the phase "before" in the directory of the run."""
    makers = {
        "gains": _gains,
        "scenario": _scenario,
        "hosts": _hosts,
        "place": _place,
        "keys": _keys,
    }
    return makers[fault.kind](case.run, fault, work)


# -- damaged files --------------------------------------------------------------------------------


def _truncated(raw: bytes, random: Random) -> bytes:
    return raw[: random.randrange(len(raw))]


def _flipped(raw: bytes, random: Random) -> bytes:
    out = bytearray(raw)
    out[random.randrange(len(out))] ^= 1 << random.randrange(8)
    return bytes(out)


_DAMAGES: dict[str, Callable[[bytes, Random], bytes]] = {
    "truncated": _truncated,
    "flipped": _flipped,
    "empty": lambda _raw, _random: b"",
    "noise": lambda _, random: random.randbytes(random.randint(1, 5000)),
}


def _damaged(file: Path, raw: bytes, future: bytes, fault: Fault) -> None:
    """Write the file as the variant has it; "missing" writes none."""
    if fault.variant == "future":
        file.write_bytes(future)
    elif fault.variant != "missing":
        file.write_bytes(_DAMAGES[fault.variant](raw, Random(fault.seed)))


def _gains(_run: RunDraw, fault: Fault, work: Path) -> Prepared:
    raw = DEFAULT_GAINS.read_bytes()
    future = re.sub(rb'"version":\s*\d+', b'"version":999', raw, count=1)
    _damaged(work / "given.gains.json", raw, future, fault)
    code = 2 if fault.variant == "missing" else 6
    arguments = ["--gains", "given.gains.json"]
    return Prepared(arguments, f"gains file {fault.variant}", code, r"gains artefact .*given")


def _scenario(run: RunDraw, fault: Fault, work: Path) -> Prepared:
    raw = (SCENARIOS / f"{run.scenario}.toml").read_bytes()
    _damaged(work / "given.toml", raw, b'format = "octarm scenario 99"\n' + raw, fault)
    return Prepared(
        ["--scenario", "given.toml"],
        f"scenario file {fault.variant}",
        2,
        r"^octarm: .*(scenario|setpoint)",
        fault.variant in ("truncated", "flipped"),
    )


def _hosts(run: RunDraw, fault: Fault, work: Path) -> Prepared:
    half = run.nodes // 2
    raw = (
        f'[plant]\naddress = "{LOOPBACK}"\n'
        f'[[hosts]]\nname = "a"\naddress = "{LOOPBACK}"\nnodes = {half}\n'
        f'[[hosts]]\nname = "b"\naddress = "{LOOPBACK}"\nnodes = {run.nodes - half}\n'
    ).encode()
    future = raw.replace(b'name = "b"', b'name = "b"\nrelay = "c"')
    _damaged(work / "given.hosts.toml", raw, future, fault)
    return Prepared(
        ["--hosts", "given.hosts.toml"],
        f"hosts file {fault.variant}",
        2,
        r"^octarm: .*hosts",
        fault.variant == "truncated",
    )


def own_keys(run: RunDraw, directory: Path) -> None:
    """Make an authority, and keys for every process of a run on this machine."""
    everybody = holders(run.firsts, None, (this_machine(run.nodes),))
    make_keys(directory, everybody, days=1)


def _keys(run: RunDraw, fault: Fault, work: Path) -> Prepared:
    name = ("plant", "recorder", f"node-{run.firsts[-1]}")[int(3 * fault.amount)]
    file = work / "keys" / f"{name}.{('pem', 'key')[fault.seed % 2]}"
    raw = file.read_bytes()
    match fault.variant:
        case "open":
            file = file.with_suffix(".key")
            file.chmod(0o644)
        case "foreign":
            own_keys(run, work / "foreign")
            for ending in (".pem", ".key"):
                shutil.copy((work / "foreign" / name).with_suffix(ending), work / "keys")
        case _:
            file.unlink()
            _damaged(file, raw, b"", fault)
            if file.exists():
                file.chmod(0o600)
    return Prepared([], f"{file.name} {fault.variant}", 2, rf"^octarm: --keys: .*{name}")


# -- taken places ---------------------------------------------------------------------------------


def _place(run: RunDraw, fault: Fault, work: Path) -> Prepared:
    what = f"{fault.variant} taken"
    if "port" in fault.variant:
        taken = socket.socket()
        taken.bind((LOOPBACK, 0))
        taken.listen()
        port: int = taken.getsockname()[1]
        if fault.variant == "live port":
            arguments, said = (
                ["--live", "--live-port", str(port)],
                f"--live-port {port}: port {port} of",
            )
        else:
            first = port - int(fault.amount * run.nodes)
            arguments = ["--transport", "tcp", "--base-port", str(first)]
            said = rf"--base-port {first}: (port \d+ of|expected)"
        return Prepared(arguments, what, 2, said, listening=[taken])
    directory = work / "taken"
    directory.mkdir()
    (directory / "plant").touch()
    option = "--out" if fault.variant == "out directory" else "--socket-dir"
    more = [] if option == "--out" else ["--transport", "unix"]
    return Prepared([*more, option, "taken"], what, 2, rf"{option} .*taken")
