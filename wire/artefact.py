"""The gains artefact: the one file between the offline design and every run.

It carries the arm, and per setpoint the equilibrium, the observer L and the controller K as polynomial
factors, with the certificate of each. All numbers are in SI units, so that a reader needs none of the
nondimensional quantities of `design`. The file is JSON (readable, diffable); its content is guarded by a
SHA-256 digest, a format name and a version.

Conventions, for the deviation x = (v_x, v_y, e, k) from the setpoint (m/s, m/s, 1, 1/m) as functions of the
arclength s in [0, L] (theory, section 2):

    observer    xh_t = A xh + B u + L (C xh - y),   y = (v_y, k) in (m/s, 1/m)
    controller  u = K xh,                           u = force per length in N/m, see `Arm.actuator`

Polynomials are plain Legendre series in the variable 2 s / L - 1 (`numpy.polynomial.legendre`).
"""

from __future__ import annotations

import hashlib
import math
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import numpy.typing as npt

from wire.errors import GainsRefusedError, UsageError
from wire.files import DATA_BYTES, read_limited, write_whole

FORMAT = "octarm-gains"
VERSION = 2
OLDEST_VERSION = 1
"""Version 1 had none of the arm's options; they are read from it with their defaults."""
ACTUATORS = ("transverse", "normal")
"""Directions of the commanded force: y of the fixed frame, or the normal of the deformed centre line."""
SENSOR_SETS = (("v_y", "k"), ("k",))
"""What a segment may measure: velocity and curvature, or the curvature only."""
GAIN_SHAPES = {"observer": (4, 2), "controller": (1, 4)}
"""Rows and columns of the two gains of a setpoint."""
Array = npt.NDArray[np.float64]


class Arm(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Material and geometry of a uniform circular arm, SI units."""

    name: str
    length_m: float
    radius_m: float
    youngs_modulus_pa: float
    density_kg_per_m3: float
    drag_per_s: float
    """Viscous drag per unit mass: v_t = ... - drag v."""
    kelvin_voigt_s: float = 0.0
    """Retardation time: the stress is E (strain + kelvin_voigt_s strain_t), axial and bending."""
    actuator: str = ACTUATORS[0]
    """One of `ACTUATORS`: what the commanded force per length (of the arm at rest) points along."""
    measured: list[str] = msgspec.field(default_factory=lambda: list(SENSOR_SETS[0]))
    """One of `SENSOR_SETS`. y = (v_y, k) has both columns all the same: of a strain-only set the gains'
    column of v_y is zero, so what stands there has no effect."""

    def __post_init__(self) -> None:
        for key in ("length_m", "radius_m", "youngs_modulus_pa", "density_kg_per_m3"):
            value = getattr(self, key)
            if not (math.isfinite(value) and value > 0.0):
                raise ValueError(f"{key} must be a positive number, got {value!r}")
        if not (math.isfinite(self.drag_per_s) and self.drag_per_s >= 0.0):
            raise ValueError(f"drag_per_s must be zero or positive, got {self.drag_per_s!r}")
        if not (math.isfinite(self.kelvin_voigt_s) and self.kelvin_voigt_s >= 0.0):
            raise ValueError(
                f"kelvin_voigt_s must be zero or positive, got {self.kelvin_voigt_s!r}"
            )
        if self.actuator not in ACTUATORS:
            raise ValueError(
                f"actuator must be one of {', '.join(ACTUATORS)}, got {self.actuator!r}"
            )
        if tuple(self.measured) not in SENSOR_SETS:
            raise ValueError(f"measured must be one of {SENSOR_SETS}, got {self.measured!r}")

    @property
    def mass_per_length_kg_per_m(self) -> float:
        """The product rho A; the chapter's erratum 'material' (theory, section 1)."""
        return self.density_kg_per_m3 * math.pi * self.radius_m**2

    @property
    def axial_stiffness_n(self) -> float:
        """The product E A."""
        return self.youngs_modulus_pa * math.pi * self.radius_m**2

    @property
    def bending_stiffness_n_m2(self) -> float:
        """The product E I of a solid circular section, I = pi r^4 / 4."""
        return self.youngs_modulus_pa * math.pi * self.radius_m**4 / 4.0


class PolynomialMatrix(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A matrix of polynomials in s: coefficients[row][column][degree], Legendre series in 2 s / L - 1."""

    coefficients: list[list[list[float]]]

    @classmethod
    def from_array(cls, coefficients: Array) -> PolynomialMatrix:
        """Build from an array of shape (rows, columns, degree + 1)."""
        return cls(coefficients=np.asarray(coefficients, dtype=np.float64).tolist())

    @property
    def array(self) -> Array:
        """The coefficients as an array of shape (rows, columns, degree + 1)."""
        out = np.asarray(self.coefficients, dtype=np.float64)
        if out.ndim != 3:  # a matrix with no columns loses its trailing axes in JSON
            out = np.zeros((len(self.coefficients), 0, 1))
        return out

    def __call__(self, s_m: npt.ArrayLike, length_m: float) -> Array:
        """Evaluate at arclengths s_m of shape (m,); returns shape (m, rows, columns)."""
        s = np.atleast_1d(np.asarray(s_m, dtype=np.float64))
        series = np.moveaxis(self.array, 2, 0)
        values = np.polynomial.legendre.legval(2.0 * s / length_m - 1.0, series)
        return np.ascontiguousarray(np.moveaxis(values, -1, 0))


class OperatorFactors(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A 3-PI operator (6) with separable kernels, the form that segments can evaluate by running sums.

    (N x)(s) = N0(s) x(s) + N1a(s) int_0^s N1b(t) x(t) dt + N2a(s) int_s^L N2b(t) x(t) dt,
    of shape (outputs, inputs); the inner dimensions of N1 and N2 are the ranks of the sums.
    """

    n0: PolynomialMatrix
    n1a: PolynomialMatrix
    n1b: PolynomialMatrix
    n2a: PolynomialMatrix
    n2b: PolynomialMatrix


class Certificate(msgspec.Struct, frozen=True, forbid_unknown_fields=True, omit_defaults=True):
    """What is known about one gain, and the evidence for it."""

    outcome: str
    """'certified', 'infeasible' or 'unreliable'; only the first is ever run."""
    certified_gamma: float
    """Upper bound of the H-infinity norm from the LPI, nondimensional."""
    achieved_gamma: float
    """H-infinity norm of the closed loop on an independent discretisation."""
    open_loop_gamma: float
    optimum_gamma: float
    """Riccati value of a fine discretisation: no gain can do better."""
    decay_per_s: float
    """Minus the rightmost real part of the closed loop's modes below 20 rad/s, independent discretisation."""
    gain_norm: float
    """L2-induced norm of the gain operator in nondimensional units."""
    smallest_eigenvalue_p: float
    largest_eigenvalue_lpi: float
    """Of the inequality that must be <= 0, on the independent discretisation."""
    equality_residual: float
    gram_sizes: list[int]
    equalities: int
    iterations: int
    solver: str
    solver_status: str
    seconds: float
    """Of the whole gain: synthesis, factorisation and verification."""
    open_loop_decay_per_s: float | None = None
    """`decay_per_s` of the arm without the gain; artefacts of octarm 0.1 do not say."""


class Setpoint(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One equilibrium shape with its gains."""

    name: str
    curvature_per_m: list[float]
    """kappa_e(s), Legendre series in 2 s / L - 1; the equilibrium curvature in 1/m."""
    strain: list[float]
    """e_e(s), the equilibrium axial strain."""
    feedforward_n_per_m: list[float]
    """f_e(s), the load that holds the shape, along `Arm.actuator` (theory, section 5)."""
    tip_m: list[float]
    observer: OperatorFactors
    controller: OperatorFactors
    observer_certificate: Certificate
    controller_certificate: Certificate


class GainsArtefact(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The content of a gains file."""

    arm: Arm
    weights: dict[str, float]
    """Design weights, nondimensional: measurement noise, control effort."""
    setpoints: list[Setpoint]
    versions: dict[str, str]
    """Versions of octarm and of the libraries that produced the gains."""

    def setpoint_index(self, name: str) -> int:
        """Position of the setpoint called `name`; UsageError lists the names that exist."""
        names = [s.name for s in self.setpoints]
        if name not in names:
            raise UsageError(
                f"setpoint {name!r} is not in the gains artefact; it has: {', '.join(names)}"
            )
        return names.index(name)


class _File(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    format: str
    version: int
    sha256: str
    content: msgspec.Raw


def digest(artefact: GainsArtefact) -> str:
    """SHA-256 of the canonical encoding of the content, in hexadecimal."""
    return hashlib.sha256(_encode(artefact)).hexdigest()


def _encode(artefact: GainsArtefact) -> bytes:
    return msgspec.json.encode(artefact, order="deterministic")


def write_artefact(artefact: GainsArtefact, path: Path) -> str:
    """Write the artefact atomically (a reader never sees half a file); returns its digest.

    Raises GainsRefusedError for an artefact that `read_artefact` would refuse, and OSError.
    """
    check(artefact, "the artefact to be written")
    content = _encode(artefact)
    sha = hashlib.sha256(content).hexdigest()
    head = f'{{"format":"{FORMAT}","version":{VERSION},"sha256":"{sha}","content":'
    path.parent.mkdir(parents=True, exist_ok=True)
    write_whole(path, head.encode() + content + b"}\n")
    return sha


def read_artefact(path: Path) -> GainsArtefact:
    """Read and check a gains file.

    Raises UsageError if it cannot be opened, GainsRefusedError if it is not a whole, finite, certified
    artefact of this version.
    """
    try:
        raw = read_limited(path, DATA_BYTES)
    except OSError as error:
        raise UsageError(
            f"gains artefact {path}: {error.strerror or error}; make one with `octarm design` or give "
            "another with --gains"
        ) from None
    return parse_artefact(raw, f"gains artefact {path}")


def parse_artefact(raw: bytes, where: str) -> GainsArtefact:
    """The artefact in the bytes of a gains file, e.g. one that is attached to a recording.

    `where` begins every message. Raises GainsRefusedError as `read_artefact` does.
    """
    remedy = "make it again with `octarm design`"
    try:
        file = msgspec.json.decode(raw, type=_File)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise GainsRefusedError(
            f"{where}: not a whole octarm gains file ({error}); {remedy}"
        ) from None
    if file.format != FORMAT:
        raise GainsRefusedError(
            f"{where}: expected format {FORMAT!r}, got {file.format!r}; {remedy}"
        )
    if file.version > VERSION:
        remedy = f"a newer octarm wrote it: update this one, or {remedy}"
    if not OLDEST_VERSION <= file.version <= VERSION:
        raise GainsRefusedError(
            f"{where}: format version {file.version}, this octarm reads {OLDEST_VERSION} to {VERSION}; {remedy}"
        )
    sha = hashlib.sha256(bytes(file.content)).hexdigest()
    if sha != file.sha256:
        raise GainsRefusedError(
            f"{where}: the content's SHA-256 is {sha[:16]}..., the file says "
            f"{file.sha256[:16]}...: it was damaged or edited; {remedy}"
        )
    try:
        artefact = msgspec.json.decode(bytes(file.content), type=GainsArtefact)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise GainsRefusedError(f"{where}: {error}; {remedy}") from None
    check(artefact, where)
    return artefact


def check(artefact: GainsArtefact, where: str) -> None:
    """Refuse an artefact with wrong shapes, non-finite numbers or an uncertified gain."""
    if not artefact.setpoints:
        raise GainsRefusedError(f"{where}: no setpoint in it; at least one is needed")
    names = [s.name for s in artefact.setpoints]
    if len(set(names)) != len(names):
        raise GainsRefusedError(f"{where}: setpoints: every name once, got {', '.join(names)}")
    for key, weight in artefact.weights.items():
        _finite(weight, f"{where}: weights[{key!r}]")
    for number, setpoint in enumerate(artefact.setpoints):
        place = f"{where}: setpoints[{number}] ({setpoint.name})"
        for key in ("curvature_per_m", "strain", "feedforward_n_per_m", "tip_m"):
            _finite(getattr(setpoint, key), f"{place}.{key}")
            if not getattr(setpoint, key):
                raise GainsRefusedError(f"{place}.{key}: expected at least one number, got none")
        if len(setpoint.tip_m) != 2:
            raise GainsRefusedError(f"{place}.tip_m: expected 2 numbers, got {len(setpoint.tip_m)}")
        for role in GAIN_SHAPES:
            check_gain(
                getattr(setpoint, role), getattr(setpoint, f"{role}_certificate"), role, place
            )


def check_gain(
    factors: OperatorFactors, certificate: Certificate, role: str, place: str = "gain"
) -> None:
    """Refuse one gain with wrong shapes, non-finite numbers or no certificate; `place` begins the message."""
    _check_operator(factors, *GAIN_SHAPES[role], f"{place}.{role}")
    if certificate.outcome != "certified":
        raise GainsRefusedError(
            f"{place}.{role}: its certificate says {certificate.outcome!r}, only 'certified' gains "
            "are run; run `octarm design` with other weights"
        )
    for key, value in msgspec.structs.asdict(certificate).items():
        if isinstance(value, float):
            _finite(value, f"{place}.{role}_certificate.{key}")


def _check_operator(factors: OperatorFactors, outputs: int, inputs: int, place: str) -> None:
    rank1 = len(factors.n1b.coefficients)
    rank2 = len(factors.n2b.coefficients)
    shapes = {
        "n0": (outputs, inputs),
        "n1a": (outputs, rank1),
        "n1b": (rank1, inputs),
        "n2a": (outputs, rank2),
        "n2b": (rank2, inputs),
    }
    for key, (rows, columns) in shapes.items():
        matrix = getattr(factors, key)
        try:
            got = matrix.array
        except ValueError:
            raise GainsRefusedError(f"{place}.{key}: ragged array of coefficients") from None
        if rows == 0 and not matrix.coefficients:  # no terms; the file keeps no other dimension
            continue
        if got.shape[:2] != (rows, columns) or got.shape[2] < 1:
            raise GainsRefusedError(
                f"{place}.{key}: expected {rows} x {columns} polynomials, got shape {got.shape}"
            )
        _finite(got, f"{place}.{key}")


def _finite(values: Any, place: str) -> None:
    array = np.asarray(values, dtype=np.float64)
    if not np.all(np.isfinite(array)):
        raise GainsRefusedError(f"{place}: a number in it is not finite")
