"""The main job of the room: arm file in, gains artefact out.

The gains are jobs that need nothing of each other (`design.gain`); `supervise.designing` runs them. Here is
which jobs an arm file asks for, what has to be right before they start, and the artefact of all of them.
"""

from __future__ import annotations

import importlib.metadata
import platform
from collections.abc import Mapping
from dataclasses import dataclass

import msgspec

from design.arm_file import ArmFile
from design.gain import GainDesign, Options
from design.gain_problem import ROLES, Role
from design.semidefinite import solvers
from design.setpoint_entry import setpoint_entry
from wire.artefact import GainsArtefact
from wire.errors import UsageError


@dataclass(frozen=True)
class Job:
    """One gain: the index of its setpoint in the arm file, and its role."""

    index: int
    setpoint: str
    role: Role

    def __str__(self) -> str:
        return f"setpoint {self.setpoint}, {self.role}"


def jobs(file: ArmFile) -> list[Job]:
    """Every gain of an arm file, in the order of the artefact."""
    return [
        Job(index, entry.name, role) for index, entry in enumerate(file.setpoints) for role in ROLES
    ]


def longest_first(file: ArmFile, some: list[Job]) -> list[Job]:
    """The order that keeps several processors busy to the end.

    Observers take longer than controllers, and more the higher the degree of the setpoint's polynomial frame.
    """
    degrees = [setpoint.frame_degree() for setpoint in file.design_setpoints()]
    return sorted(some, key=lambda job: (-degrees[job.index], job.role != "observer"))


def check_options(options: Options) -> None:
    """UsageError for a solver that is not there."""
    if options.solver not in solvers():
        raise UsageError(
            f"--solver {options.solver}: expected a semidefinite solver that is installed: "
            f"{', '.join(solvers())}"
        )


def versions() -> dict[str, str]:
    """Of octarm and of everything that gains are computed with."""
    names = ("octarm", "numpy", "scipy", "cvxpy", "clarabel")
    return {name: importlib.metadata.version(name) for name in names} | {
        "python": platform.python_version()
    }


def assemble(file: ArmFile, gains: Mapping[Job, GainDesign]) -> GainsArtefact:
    """The artefact of an arm file from the gains of all its `jobs`."""
    arm = file.arm()
    entries = [setpoint_entry(arm, setpoint) for setpoint in file.design_setpoints()]
    for job, gain in gains.items():
        entries[job.index] = msgspec.structs.replace(
            entries[job.index],
            **{job.role: gain.factors, f"{job.role}_certificate": gain.certificate},
        )
    return GainsArtefact(
        arm=arm,
        weights={
            "measurement_noise": file.weights.measurement_noise,
            "control_effort": file.weights.control_effort,
        },
        setpoints=entries,
        versions=versions(),
    )
