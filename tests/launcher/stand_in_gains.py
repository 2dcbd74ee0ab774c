"""Stand-ins for the design of a gain, quick; a setpoint's name says how its controller's job behaves."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
from closed_form import artefact
from threadpoolctl import threadpool_info

from design.arm_file import ArmFile
from design.command import Job
from design.gain import GainDesign, Options
from design.gain_problem import Role
from wire.errors import GainsRefusedError

NEVER_S = 600.0
ARM = """\
name = "stand-in"
[material]
youngs_modulus_pa = 5e3
density_kg_per_m3 = 1.1e3
[geometry]
length_m = 1.0
radius_m = 0.025
[damping]
drag_per_s = 0.02
[weights]
measurement_noise = 0.2
control_effort = 0.3
"""


def arm_text(*names: str) -> str:
    """An arm file with these setpoints, each of another shape."""
    return ARM + "".join(
        f'[[setpoints]]\nname = "{name}"\ncurvature_per_m = [{k}.0, -{2 * k}.0, {k}.0]\n'
        for k, name in enumerate(names, start=1)
    )


def finished(index: int, role: Role) -> GainDesign:
    """The gain of the setpoint with this index: no two have the same."""
    sample = artefact(gain_per_s=0.5 + 0.1 * index).setpoints[1]
    certificate = msgspec.structs.replace(sample.observer_certificate, gain_norm=float(index))
    return GainDesign(getattr(sample, role), certificate)


def well(
    file: ArmFile,
    index: int,
    role: Role,
    options: Options,
    progress: Callable[[str], None] = lambda _: None,
) -> GainDesign:
    name = file.setpoints[index].name
    threads = max(pool["num_threads"] for pool in threadpool_info())
    progress(f"setpoint {name}, {role}: at work, threads {threads}")
    if role == "controller" and name == "hangs":
        signal.signal(signal.SIGTERM, signal.SIG_IGN)  # as native code does
        time.sleep(NEVER_S)
    if role == "controller" and name == "dies":
        os.kill(os.getpid(), signal.SIGKILL)
    if role == "controller" and name == "refuses":
        raise GainsRefusedError(f"setpoint {name}, {role}: the LPI is infeasible")
    return finished(index, role)


class Immediate:
    """In the place of the design's pool of processes: does the jobs here, one after the other."""

    order: list[str]

    def __init__(
        self, file: Any, options: Any, work: Any, grace: float, keep: Any, tell: Any
    ) -> None:
        self.failures: dict[Job, Exception] = {}
        self._do: Callable[[Job], GainDesign] = lambda job: work(
            file, job.index, job.role, options, tell
        )
        self._keep = keep

    def run(self, todo: list[Job], at_once: int) -> None:
        type(self).order = [str(job) for job in todo]
        for job in todo:
            try:
                self._keep(job, self._do(job))
            except GainsRefusedError as error:
                self.failures[job] = error


def arm(folder: Path, *names: str) -> Path:
    """An arm file with these setpoints."""
    path = folder / "arm.toml"
    path.write_text(arm_text(*names))
    return path
