"""Small gains artefacts for the tests of deploy: no design run needed."""

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
from closed_form import CERTIFICATE

from wire.artefact import (
    Arm,
    GainsArtefact,
    OperatorFactors,
    PolynomialMatrix,
    Setpoint,
)

Array = npt.NDArray[np.float64]

ARM = Arm(
    name="test arm",
    length_m=1.25,
    radius_m=0.03,
    youngs_modulus_pa=6000.0,
    density_kg_per_m3=1050.0,
    drag_per_s=0.02,
)
# (1 - s)^2 (1.6 - 1.1 s + 0.9 s^2) with s = arclength / length: no moment and no shear at the tip, 33.8 degrees
CURVED = [0.4716666666666667, -0.745, 0.31547619047619047, -0.055, 0.012857142857142857]
STRAIGHT = [0.0]


def operator(n0: Array, n1a: Array, n1b: Array, n2a: Array, n2b: Array) -> OperatorFactors:
    return OperatorFactors(
        n0=PolynomialMatrix.from_array(n0),
        n1a=PolynomialMatrix.from_array(n1a),
        n1b=PolynomialMatrix.from_array(n1b),
        n2a=PolynomialMatrix.from_array(n2a),
        n2b=PolynomialMatrix.from_array(n2b),
    )


def random_operator(
    seed: int, outputs: int, inputs: int, rank1: int = 2, rank2: int = 2, degree: int = 3
) -> OperatorFactors:
    random = np.random.default_rng(seed)
    shapes = ((outputs, inputs), (outputs, rank1), (rank1, inputs), (outputs, rank2))
    parts = [random.standard_normal((*shape, degree + 1)) for shape in (*shapes, (rank2, inputs))]
    return operator(*parts)


def gains(
    size_per_s: float = 0.3, coupling: float = 0.03, arm: Arm = ARM, seed: int = 1, rank: int = 2
) -> tuple[OperatorFactors, OperatorFactors]:
    """Observer and controller: pointwise damping of size_per_s and small kernels with N1 != N2."""
    mass = arm.mass_per_length_kg_per_m
    bend = np.sqrt(mass / arm.bending_stiffness_n_m2)  # 1/m of curvature per m/s at equal energy
    random = np.random.default_rng(seed)
    to = np.array([1.0, 1.0, 0.01, bend])[:, None, None]
    by = np.array([1.0, 1.0 / bend])[None, :, None]

    def draw(rows: int, columns: int) -> Array:
        return np.asarray(random.uniform(-1.0, 1.0, (rows, columns, 3)), dtype=np.float64)

    multiplier = np.zeros((4, 2, 1))
    multiplier[1, 0] = multiplier[3, 1] = -size_per_s
    strength = coupling * size_per_s
    observer = operator(
        multiplier,
        strength * to * draw(4, rank),
        draw(rank, 2) * by,
        strength * to * draw(4, rank),
        draw(rank, 2) * by,
    )
    state = np.array([1.0, 1.0, 0.0, 1.0 / bend])[None, :, None]
    multiplier = np.zeros((1, 4, 1))
    multiplier[0, 1] = -size_per_s * mass
    controller = operator(
        multiplier,
        strength * mass * draw(1, rank),
        draw(rank, 4) * state,
        strength * mass * draw(1, rank),
        draw(rank, 4) * state,
    )
    return observer, controller


def make_artefact(
    shapes: Sequence[Sequence[float]] = (STRAIGHT, CURVED),
    arm: Arm = ARM,
    operators: Sequence[tuple[OperatorFactors, OperatorFactors]] | None = None,
) -> GainsArtefact:
    operators = operators or [gains(arm=arm, seed=i + 1) for i in range(len(shapes))]
    setpoints = [
        Setpoint(
            name=f"shape {i}",
            curvature_per_m=list(shape),
            strain=[1e-4 * i, 2e-4, 3e-5],
            feedforward_n_per_m=[2e-3 * i, 1e-3],
            tip_m=[1.0, 0.1],
            observer=observer,
            controller=controller,
            observer_certificate=CERTIFICATE,
            controller_certificate=CERTIFICATE,
        )
        for i, (shape, (observer, controller)) in enumerate(zip(shapes, operators, strict=True))
    ]
    return GainsArtefact(arm=arm, weights={"noise": 1.0}, setpoints=setpoints, versions={})
