"""Gains in closed form for tests: they only take out energy where they measure and act, no solver needed."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from wire.artefact import (
    Arm,
    Certificate,
    GainsArtefact,
    OperatorFactors,
    PolynomialMatrix,
    Setpoint,
    write_artefact,
)

ARM = Arm("test", 1.0, 0.025, 5e3, 1.1e3, 0.02)
CERTIFICATE = Certificate(
    outcome="certified",
    certified_gamma=0.1414,
    achieved_gamma=0.135,
    open_loop_gamma=2.33,
    optimum_gamma=0.111,
    decay_per_s=0.01,
    gain_norm=14.1,
    smallest_eigenvalue_p=1.0,
    largest_eigenvalue_lpi=0.0,
    equality_residual=0.0,
    gram_sizes=[8],
    equalities=0,
    iterations=0,
    solver="none",
    solver_status="closed form",
    seconds=0.0,
)


def constant(*rows: tuple[float, ...]) -> PolynomialMatrix:
    return PolynomialMatrix([[[value] for value in row] for row in rows])


def artefact(
    gain_per_s: float = 0.5, coupling: float = 0.01, name: str = "1", strength: float = 1.0
) -> GainsArtefact:
    """Setpoints "straight" and `name`, the latter with curvature strength (1 - s)^2 in 1/m.

    (1 - s)^2 = 1/3 P0 - 1/2 P1 + 1/6 P2 in x = 2 s - 1; the load -(EI kappa' / cos)' holds it.
    """
    mass = ARM.mass_per_length_kg_per_m
    observer = OperatorFactors(
        n0=constant((0.0, 0.0), (-gain_per_s, 0.0), (0.0, 0.0), (0.0, -gain_per_s)),
        n1a=constant((0.0,), (1e-3,), (0.0,), (0.0,)),
        n1b=constant((0.0, 1.0)),
        n2a=constant((0.0,), (1e-3,), (0.0,), (0.0,)),
        n2b=constant((0.0, -1.0)),
    )
    controller = OperatorFactors(
        n0=constant((0.0, -0.3 * mass, 0.0, 0.0)),
        n1a=constant((coupling,)),
        n1b=constant((0.0, 0.0, 0.0, 0.01)),
        n2a=constant((coupling,)),
        n2b=constant((0.0, 0.0, 0.0, 0.01)),
    )
    s = np.linspace(0.0, 1.0, 400)
    setpoints = []
    for label, bend in (("straight", 0.0), (name, strength)):
        angle = bend * (1.0 - (1.0 - s) ** 3) / 3.0
        force = ARM.bending_stiffness_n_m2 * 2.0 * bend * (1.0 - s) / np.cos(angle)
        series = np.polynomial.Legendre.fit(s, force, 12, domain=[0.0, 1.0])
        setpoints.append(
            Setpoint(
                name=label,
                curvature_per_m=[bend / 3.0, -bend / 2.0, bend / 6.0],
                strain=[0.0],
                feedforward_n_per_m=(-series.deriv()).coef.tolist(),
                tip_m=[float(np.mean(np.cos(angle))), float(np.mean(np.sin(angle)))],
                observer=observer,
                controller=controller,
                observer_certificate=CERTIFICATE,
                controller_certificate=CERTIFICATE,
            )
        )
    return GainsArtefact(ARM, {"noise": 0.1, "effort": 0.1}, setpoints, {"octarm": "test"})


def write_gains(path: Path) -> Path:
    write_artefact(artefact(), path)
    return path
