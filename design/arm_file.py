"""The arm file: what the user writes (TOML, SI units) and what the design reads from it."""

from __future__ import annotations

import math
import warnings
from pathlib import Path

import msgspec
import numpy as np
from scipy.integrate import IntegrationWarning

from design import legendre
from design.setpoint import Setpoint, equilibrium_load, from_shape
from wire.artefact import ACTUATORS, SENSOR_SETS, Arm
from wire.errors import UsageError
from wire.files import TEXT_BYTES, read_limited

FIRST_BENDING_ROOT = 1.8751040687119611
"""First root of cos(b) cosh(b) = -1: a clamped-free beam bends at b^2 sqrt(EI / (rho A)) / L^2."""


class _Section(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    pass


class Material(_Section, frozen=True):
    """Material of the arm."""

    youngs_modulus_pa: float
    density_kg_per_m3: float


class Geometry(_Section, frozen=True):
    """A circular cross-section, uniform along the arm."""

    length_m: float
    radius_m: float


class Damping(_Section, frozen=True):
    """Viscous drag per unit mass (give exactly one of the first two), and the material's own damping."""

    first_mode_damping_ratio: float | None = None
    """Of the drag alone; Kelvin-Voigt damping comes on top."""
    drag_per_s: float | None = None
    kelvin_voigt_s: float = 0.0
    """Retardation time: stress E (strain + kelvin_voigt_s strain_t), axial and bending."""


class Actuators(_Section, frozen=True):
    """What the segments push with: `force` is "transverse" (along y of the fixed frame) or "normal" (along
    the normal of the centre line where the segment is, whatever the arm's shape)."""

    force: str = ACTUATORS[0]


class Sensors(_Section, frozen=True):
    """What a segment measures: ["v_y", "k"] or the curvature only, ["k"]."""

    measured: list[str] = msgspec.field(default_factory=lambda: list(SENSOR_SETS[0]))


class Weights(_Section, frozen=True):
    """Nondimensional weights of the H-infinity problems."""

    measurement_noise: float = 0.1
    control_effort: float = 0.1


class SetpointEntry(_Section, frozen=True):
    """One equilibrium shape: give exactly one of `curvature_per_m` and `shape`."""

    name: str
    curvature_per_m: list[float] | None = None
    """kappa_e(s) = sum c[j] (s / L)^j in 1/m, s from the root."""
    shape: list[float] | None = None
    """w_e(x) / L = sum c[j] (x / L)^j, a graph in the plane, cut at arclength L (chapter, Fig. 2)."""

    def nondimensional(self, length_m: float) -> Setpoint:
        """Curvature times L as a function of s / L."""
        if self.shape is not None:
            return from_shape(self.name, self.shape)
        series = np.asarray(self.curvature_per_m) * length_m
        nodes, _ = legendre.gauss(series.size)
        values = np.polynomial.polynomial.polyval(nodes, series)
        return Setpoint(self.name, legendre.fit(values))


class ArmFile(_Section, frozen=True):
    """A whole arm file."""

    name: str
    material: Material
    geometry: Geometry
    damping: Damping
    setpoints: list[SetpointEntry]
    weights: Weights = Weights()
    actuators: Actuators = Actuators()
    sensors: Sensors = Sensors()

    def arm(self) -> Arm:
        """Material, geometry and options as the rest of the system uses them."""
        g, m = self.geometry, self.material
        undamped = Arm(
            name=self.name,
            length_m=g.length_m,
            radius_m=g.radius_m,
            youngs_modulus_pa=m.youngs_modulus_pa,
            density_kg_per_m3=m.density_kg_per_m3,
            drag_per_s=0.0,
            kelvin_voigt_s=self.damping.kelvin_voigt_s,
            actuator=self.actuators.force,
            measured=self.sensors.measured,
        )
        if self.damping.drag_per_s is not None:
            return msgspec.structs.replace(undamped, drag_per_s=self.damping.drag_per_s)
        ratio = self.damping.first_mode_damping_ratio or 0.0
        return msgspec.structs.replace(
            undamped, drag_per_s=2.0 * ratio * FIRST_BENDING_ROOT**2 / time_unit_s(undamped)
        )

    def design_setpoints(self) -> list[Setpoint]:
        """The setpoints in nondimensional form; curvature times L as a function of s / L."""
        return [entry.nondimensional(self.geometry.length_m) for entry in self.setpoints]


def time_unit_s(arm: Arm) -> float:
    """L^2 sqrt(rho A / EI) in s, the unit of time in which bending has unit stiffness (theory, 2)."""
    ratio = arm.mass_per_length_kg_per_m / arm.bending_stiffness_n_m2
    return float(arm.length_m**2 * math.sqrt(ratio))


def axial_ratio(arm: Arm) -> float:
    """alpha = L sqrt(EA / EI), the axial wave number against bending (theory, section 2)."""
    return float(arm.length_m * math.sqrt(arm.axial_stiffness_n / arm.bending_stiffness_n_m2))


def read_arm_file(path: Path) -> ArmFile:
    """Read and check an arm file; UsageError names the file, the key and what is expected."""
    try:
        raw = read_limited(path, TEXT_BYTES)
    except OSError as error:
        raise UsageError(
            f"arm file {path}: {error.strerror or error}; give another with --arm"
        ) from None
    try:
        arm = msgspec.toml.decode(raw, type=ArmFile)
    except (msgspec.DecodeError, ValueError, OverflowError, RecursionError) as error:
        raise UsageError(f"arm file {path}: {error}{_unit_hint(str(error))}") from None
    check_arm_file(arm, str(path))
    return arm


def check_arm_file(arm: ArmFile, where: str) -> None:
    """UsageError for values that are no arm: which key, what was expected and what came."""
    positive = {
        "geometry.length_m": arm.geometry.length_m,
        "geometry.radius_m": arm.geometry.radius_m,
        "material.youngs_modulus_pa": arm.material.youngs_modulus_pa,
        "material.density_kg_per_m3": arm.material.density_kg_per_m3,
        "weights.measurement_noise": arm.weights.measurement_noise,
        "weights.control_effort": arm.weights.control_effort,
    }
    for key, value in positive.items():
        if not (math.isfinite(value) and value > 0.0):
            raise UsageError(f"arm file {where}: {key}: expected a positive number, got {value!r}")
    if arm.geometry.radius_m > 0.2 * arm.geometry.length_m:
        raise UsageError(
            f"arm file {where}: geometry.radius_m: {arm.geometry.radius_m} m is more than a fifth of the "
            f"length {arm.geometry.length_m} m; this is no slender beam (are both in metres?)"
        )
    given = [
        v for v in (arm.damping.first_mode_damping_ratio, arm.damping.drag_per_s) if v is not None
    ]
    if len(given) != 1 or not (math.isfinite(given[0]) and given[0] > 0.0):
        raise UsageError(
            f"arm file {where}: damping: expected exactly one of first_mode_damping_ratio and drag_per_s, "
            f"a positive number (an undamped arm has no certificate); got {given}"
        )
    _check_options(arm, where)
    try:
        units = [arm.arm().drag_per_s, time_unit_s(arm.arm())]
    except (ValueError, OverflowError, ZeroDivisionError):
        units = [math.nan]
    if not all(math.isfinite(v) and v > 0.0 for v in units):
        raise UsageError(
            f"arm file {where}: material, geometry, damping: expected numbers of the size of an arm's in SI "
            "units; masses, stiffnesses or times computed from these are zero or infinite"
        )
    if not arm.setpoints:
        raise UsageError(
            f"arm file {where}: setpoints: expected at least one [[setpoints]] table, got none"
        )
    names = [s.name for s in arm.setpoints]
    if len(set(names)) != len(names):
        raise UsageError(f"arm file {where}: setpoints: every name once, got {', '.join(names)}")
    for number, entry in enumerate(arm.setpoints):
        place = f"arm file {where}: setpoints[{number}] ({entry.name})"
        with np.errstate(over="ignore", invalid="ignore"):
            _check_setpoint(entry, place, arm)
        _check_equilibrium(entry, place, arm)


def _check_options(arm: ArmFile, where: str) -> None:
    """UsageError for a damping time, a force or a sensor set that there is not."""
    tau = arm.damping.kelvin_voigt_s
    if not (math.isfinite(tau) and tau >= 0.0):
        raise UsageError(
            f"arm file {where}: damping.kelvin_voigt_s: expected a time in s, zero or positive, got {tau!r}"
        )
    if arm.actuators.force not in ACTUATORS:
        raise UsageError(
            f"arm file {where}: actuators.force: expected one of {', '.join(map(repr, ACTUATORS))}, got "
            f"{arm.actuators.force!r}"
        )
    if tuple(arm.sensors.measured) not in SENSOR_SETS:
        raise UsageError(
            f"arm file {where}: sensors.measured: expected one of "
            f"{', '.join(str(list(s)) for s in SENSOR_SETS)}, got {arm.sensors.measured}"
        )


def _check_setpoint(entry: SetpointEntry, where: str, arm: ArmFile) -> None:
    given = [c for c in (entry.curvature_per_m, entry.shape) if c is not None]
    if len(given) != 1:
        raise UsageError(
            f"{where}: expected exactly one of curvature_per_m and shape, got {len(given)}"
        )
    if not given[0] or not all(math.isfinite(c) for c in given[0]):
        raise UsageError(f"{where}: expected finite polynomial coefficients, got {given[0]}")
    if not entry.name:
        raise UsageError(f"{where}.name: expected a name, got an empty one")
    if entry.shape is not None and any(entry.shape[:2]):
        raise UsageError(
            f"{where}.shape: the first two coefficients must be 0 (clamped root), got {entry.shape[:2]}"
        )
    if entry.curvature_per_m is not None:
        series = np.asarray(entry.curvature_per_m)
        scale = max(1.0, float(np.abs(series).max()))
        for what, value in (
            ("curvature", np.sum(series)),
            ("slope of the curvature", np.sum(series * np.arange(series.size))),
        ):
            if not abs(value) <= 1e-9 * scale:
                raise UsageError(
                    f"{where}.curvature_per_m: the {what} at the tip must be 0 (no moment, no shear at the "
                    f"free end), got {value:.3g}"
                )
    limit = 1.0 / arm.geometry.radius_m
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", IntegrationWarning)
            worst = float(np.max(np.abs(curvature_samples(entry, arm.geometry.length_m))))
    except (ArithmeticError, RuntimeError, ValueError, Warning, np.linalg.LinAlgError):
        raise UsageError(
            f"{where}: expected the polynomial of an arm's shape, got {given[0]}, which cannot be followed "
            "along the arm"
        ) from None
    if not worst <= limit:
        raise UsageError(
            f"{where}: curvature {worst:.1f}/m exceeds 1/radius = {limit:.1f}/m: the arm would overlap itself"
        )


def _check_equilibrium(entry: SetpointEntry, where: str, arm: ArmFile) -> None:
    """UsageError unless a load along the actuators can hold the setpoint (theory, section 5)."""
    try:
        setpoint = entry.nondimensional(arm.geometry.length_m)
        equilibrium_load(setpoint, axial_ratio(arm.arm()) ** 2, arm.actuators.force)
    except ValueError as error:
        raise UsageError(f"{where}: {error}") from None


def curvature_samples(entry: SetpointEntry, length_m: float, count: int = 101) -> list[float]:
    """kappa_e in 1/m at `count` points along the arm (for checks and pictures)."""
    s = np.linspace(0.0, 1.0, count)
    if entry.curvature_per_m is not None:
        return list(np.polynomial.polynomial.polyval(s, np.asarray(entry.curvature_per_m)))
    fitted = from_shape(entry.name, entry.shape or [0.0])
    return list(legendre.basis(s, fitted.curvature.size) @ fitted.curvature / length_m)


def _unit_hint(message: str) -> str:
    """For a key such as length_cm: the key that was meant."""
    known = {
        "length": "length_m", "radius": "radius_m", "youngs_modulus": "youngs_modulus_pa",
        "density": "density_kg_per_m3", "drag": "drag_per_s", "curvature": "curvature_per_m",
        "kelvin_voigt": "kelvin_voigt_s",
    }  # fmt: skip
    for stem, key in known.items():
        if f"`{stem}" in message and f"`{key}`" not in message:
            return f"; this quantity is given in SI units as {key}"
    return ""
