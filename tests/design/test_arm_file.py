"""The arm file: what is read, and that every refusal names the file, the key and what was expected."""

from __future__ import annotations

import math
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy.integrate import cumulative_trapezoid, quad, trapezoid
from scipy.optimize import brentq

from design.arm_file import (
    FIRST_BENDING_ROOT,
    ArmFile,
    axial_ratio,
    curvature_samples,
    read_arm_file,
    time_unit_s,
)
from wire.errors import UsageError

EXAMPLE = Path(__file__).resolve().parents[2] / "examples" / "chapter_arm.toml"
VALID = """\
name = "mine"
[material]
youngs_modulus_pa = 4e3
density_kg_per_m3 = 1000
[geometry]
length_m = 0.7
radius_m = 0.02
[damping]
drag_per_s = 0.03
[weights]
measurement_noise = 0.2
control_effort = 0.3
[[setpoints]]
name = "bent"
curvature_per_m = [2.0, -4.0, 2.0]
[[setpoints]]
name = "graph"
shape = [0.0, 0.0, 0.3, -0.1]
"""


def written(folder: Path, text: str | bytes) -> Path:
    path = folder / "my_arm.toml"
    path.write_bytes(text.encode() if isinstance(text, str) else text)
    return path


def test_example_is_the_chapters_arm() -> None:
    file = read_arm_file(EXAMPLE)
    arm = file.arm()
    assert (arm.name, arm.length_m, arm.radius_m) == ("chapter", 1.0, 0.025)
    assert time_unit_s(arm) == pytest.approx(37.5, abs=0.05)  # theory, section 2
    assert axial_ratio(arm) == pytest.approx(80.0, rel=1e-12)
    assert arm.drag_per_s * time_unit_s(arm) == pytest.approx(0.7032, abs=1e-4)
    assert file.weights.measurement_noise == file.weights.control_effort == 0.1
    assert [s.name for s in file.setpoints] == ["1", "2", "3"]
    for entry, x_tip, degrees in zip(
        file.setpoints, (0.9645, 0.6896, 0.2568), (14.45, 45.08, 74.94), strict=True
    ):  # theory, section 1; setpoint 3 as no arm can bend to it
        s = np.linspace(0.0, 1.0, 2001)
        angle = cumulative_trapezoid(curvature_samples(entry, 1.0, s.size), s, initial=0)
        tip = trapezoid(np.cos(angle), s), trapezoid(np.sin(angle), s)
        assert tip[0] == pytest.approx(x_tip, abs=0.015 if entry.name == "3" else 1e-3)
        assert math.degrees(math.atan2(tip[1], tip[0])) == pytest.approx(
            degrees, abs=1.1 if entry.name == "3" else 0.1
        )
    assert max(curvature_samples(file.setpoints[2], 1.0)) == pytest.approx(15.7, abs=0.1)


def test_damping_ratio_is_that_of_the_first_bending_mode() -> None:
    """q_tt + drag q_t + w^2 q = 0 with the textbook frequency w of a clamped-free beam."""
    arm = read_arm_file(EXAMPLE).arm()
    root = float(brentq(lambda b: math.cos(b) * math.cosh(b) + 1.0, 1.0, 3.0, xtol=1e-14))
    assert pytest.approx(root, rel=1e-12) == FIRST_BENDING_ROOT
    area, inertia = math.pi * 0.025**2, math.pi * 0.025**4 / 4.0
    frequency = root**2 * math.sqrt(5e3 * inertia / (1.1e3 * area))
    assert frequency == pytest.approx(0.0937, abs=1e-4)  # theory, section 1
    assert arm.drag_per_s == pytest.approx(2.0 * 0.1 * frequency, rel=1e-12)


def test_options_arrive_and_default_to_none(tmp_path: Path) -> None:
    plain = read_arm_file(written(tmp_path, VALID)).arm()
    assert (plain.kelvin_voigt_s, plain.actuator, plain.measured) == (
        0.0,
        "transverse",
        ["v_y", "k"],
    )
    text = VALID.replace("drag_per_s = 0.03", "drag_per_s = 0.03\nkelvin_voigt_s = 0.25")
    text = '[actuators]\nforce = "normal"\n[sensors]\nmeasured = ["k"]\n'.join(
        [text[: text.index("[[setpoints]]")], text[text.index("[[setpoints]]") :]]
    )
    arm = read_arm_file(written(tmp_path, text)).arm()
    assert (arm.drag_per_s, arm.kelvin_voigt_s) == (0.03, 0.25)
    assert (arm.actuator, arm.measured) == ("normal", ["k"])


@pytest.mark.parametrize(
    ("place", "line", "culprit"),
    [
        ("[damping]", "kelvin_voigt_s = -0.1", "damping.kelvin_voigt_s"),
        ("[damping]", "kelvin_voigt_s = nan", "damping.kelvin_voigt_s"),
        ("[damping]", "kelvin_voigt = 0.1", "given in SI units as kelvin_voigt_s"),
        ("[weights]", '[actuators]\nforce = "follower"', "actuators.force"),
        ("[weights]", '[sensors]\nmeasured = ["k", "v_x"]', "sensors.measured"),
        ("[weights]", "[sensors]\nmeasured = []", "sensors.measured"),
    ],
)
def test_wrong_options_are_refused(tmp_path: Path, place: str, line: str, culprit: str) -> None:
    text = VALID.replace(place, f"{place}\n{line}" if place == "[damping]" else f"{line}\n{place}")
    path = written(tmp_path, text)
    with pytest.raises(UsageError) as error:
        read_arm_file(path)
    assert str(path) in str(error.value)
    assert culprit in str(error.value)


def test_values_arrive(tmp_path: Path) -> None:
    file = read_arm_file(written(tmp_path, VALID))
    arm = file.arm()
    assert (arm.name, arm.length_m, arm.radius_m) == ("mine", 0.7, 0.02)
    assert (arm.youngs_modulus_pa, arm.density_kg_per_m3, arm.drag_per_s) == (4e3, 1e3, 0.03)
    assert (file.weights.measurement_noise, file.weights.control_effort) == (0.2, 0.3)
    assert time_unit_s(arm) == pytest.approx(
        0.7**2 * math.sqrt(1e3 * math.pi * 0.02**2 / (4e3 * math.pi * 0.02**4 / 4.0))
    )


def test_curvature_in_powers_of_the_relative_arclength(tmp_path: Path) -> None:
    file = read_arm_file(written(tmp_path, VALID))
    s = np.linspace(0.0, 1.0, 7)
    expected = 2.0 * (1.0 - s) ** 2
    np.testing.assert_allclose(curvature_samples(file.setpoints[0], 0.7, 7), expected, atol=1e-14)
    bent = file.design_setpoints()[0]
    unit = np.sqrt(2.0 * np.arange(bent.curvature.size) + 1.0)
    got = np.polynomial.legendre.legval(2.0 * s - 1.0, bent.curvature * unit)
    np.testing.assert_allclose(got, 0.7 * expected, atol=1e-13)  # nondimensional: times length


def test_shape_becomes_the_graphs_angle(tmp_path: Path) -> None:
    file = read_arm_file(written(tmp_path, VALID))

    def slope(x: float) -> float:
        return 0.6 * x - 0.3 * x**2

    def arc(x: float) -> float:
        return float(quad(lambda t: math.hypot(1.0, slope(t)), 0.0, x)[0])

    tip = float(brentq(lambda x: arc(x) - 1.0, 0.5, 1.0))
    samples = np.asarray(curvature_samples(file.setpoints[1], 0.7, 2001)) * 0.7
    angle = float(np.trapezoid(samples, dx=1.0 / 2000.0))
    assert angle == pytest.approx(math.atan(slope(tip)), abs=5e-3)
    assert samples[-1] == pytest.approx(0.0, abs=1e-12)


def test_weights_have_defaults(tmp_path: Path) -> None:
    head, tail = VALID.split("[weights]")
    file = read_arm_file(written(tmp_path, head + tail[tail.index("[[setpoints]]") :]))
    assert (file.weights.measurement_noise, file.weights.control_effort) == (0.1, 0.1)


REFUSED: dict[str, tuple[str, str, tuple[str, ...]]] = {
    "negative length": ("length_m = 0.7", "length_m = -0.7", ("geometry.length_m", "positive", "-0.7")),
    "zero radius": ("radius_m = 0.02", "radius_m = 0.0", ("geometry.radius_m", "positive", "0.0")),
    "infinite modulus": ("4e3", "inf", ("material.youngs_modulus_pa", "positive", "inf")),
    "density not a number": ("= 1000", "= nan", ("material.density_kg_per_m3", "positive", "nan")),
    "zero noise": ("noise = 0.2", "noise = 0.0", ("weights.measurement_noise", "positive")),
    "negative effort": ("effort = 0.3", "effort = -1", ("weights.control_effort", "positive", "-1")),
    "centimetres": ("length_m = 0.7", "length_cm = 70.0", ("length_cm", "$.geometry", "length_m")),
    "millimetres": ("radius_m = 0.02", "radius_mm = 20", ("radius_mm", "SI units as radius_m")),
    "kilopascal": ("youngs_modulus_pa = 4e3", "youngs_modulus_kpa = 4", ("youngs_modulus_pa",)),
    "unknown key": ("[material]", "[material]\ncolour = 1", ("colour", "$.material")),
    "unknown table": ("[material]", "[paint]\n[material]", ("paint",)),
    "missing key": ("length_m = 0.7\n", "", ("missing", "length_m", "$.geometry")),
    "text for a number": ("length_m = 0.7", 'length_m = "0.7"', ("$.geometry.length_m", "float", "str")),
    "true for a number": ("length_m = 0.7", "length_m = true", ("$.geometry.length_m", "float", "bool")),
    "number for a name": ('name = "mine"', "name = 3", ("$.name", "str", "int")),
    "number for a list": ("[2.0, -4.0, 2.0]", "2.0", ("setpoints[0].curvature_per_m", "array", "float")),
    "thick": ("radius_m = 0.02", "radius_m = 0.2", ("geometry.radius_m", "slender", "metres")),
    "both dampings": (
        "drag_per_s = 0.03", "drag_per_s = 0.03\nfirst_mode_damping_ratio = 0.1",
        ("damping", "exactly one", "[0.1, 0.03]"),
    ),
    "no damping": ("drag_per_s = 0.03\n", "", ("damping", "exactly one", "[]")),
    "undamped": ("drag_per_s = 0.03", "drag_per_s = 0.0", ("damping", "undamped", "[0.0]")),
    "negative damping": ("drag_per_s = 0.03", "first_mode_damping_ratio = -1", ("damping", "[-1")),
    "both shapes": (
        "shape = [0.0, 0.0, 0.3, -0.1]", "shape = [0.0]\ncurvature_per_m = [0.0]",
        ("setpoints[1] (graph)", "exactly one of curvature_per_m and shape", "got 2"),
    ),
    "no shape": (
        "shape = [0.0, 0.0, 0.3, -0.1]", "",
        ("setpoints[1] (graph)", "exactly one of curvature_per_m and shape", "got 0"),
    ),
    "no coefficients": ("[2.0, -4.0, 2.0]", "[]", ("setpoints[0] (bent)", "coefficients", "[]")),
    "infinite coefficient": ("[2.0, -4.0, 2.0]", "[inf, -inf]", ("setpoints[0] (bent)", "finite")),
    "coefficient not a number": ("0.3, -0.1", "nan", ("setpoints[1] (graph)", "finite", "nan")),
    "tip moment": (
        "[2.0, -4.0, 2.0]", "[2.0, -1.0]",
        ("setpoints[0] (bent).curvature_per_m", "curvature at the tip must be 0", "got 1"),
    ),
    "tip shear": (
        "[2.0, -4.0, 2.0]", "[2.0, -2.0]",
        ("setpoints[0] (bent).curvature_per_m", "slope of the curvature at the tip", "got -2"),
    ),
    "root not clamped": (
        "shape = [0.0, 0.0, 0.3", "shape = [0.0, 0.1, 0.3",
        ("setpoints[1] (graph).shape", "clamped root", "[0.0, 0.1]"),
    ),
    "too curved": (
        "[2.0, -4.0, 2.0]", "[60.0, -120.0, 60.0]",
        ("setpoints[0] (bent)", "60.0/m", "1/radius = 50.0/m"),
    ),
    "graph out of size": (
        "0.3, -0.1]", "1e300, -1e300]", ("setpoints[1] (graph)", "shape", "cannot be followed"),
    ),
    "overflowing curvature": (
        "[2.0, -4.0, 2.0]", "[1e308, 1e308, -1e308, -1e308]",
        ("setpoints[0] (bent).curvature_per_m", "at the tip must be 0"),
    ),
    "turned over": (
        "[2.0, -4.0, 2.0]", "[8.0, -16.0, 8.0]", ("setpoints[0] (bent)", "90", "degrees"),
    ),
    "one name twice": ('"graph"', '"bent"', ("setpoints", "every name once", "bent, bent")),
    "empty name": ('"graph"', '""', ("setpoints[1]", "name", "empty")),
    "out of all proportion": ("length_m = 0.7", "length_m = 1e200", ("geometry", "infinite")),
    "vanishing section": ("radius_m = 0.02", "radius_m = 1e-100", ("geometry", "zero")),
    "whole number out of range": ("length_m = 0.7", "length_m = 1" + "0" * 400, ("my_arm.toml",)),
    "not TOML": ("[material]", "[material", ("line 2",)),
    "key twice": ("length_m = 0.7", "length_m = 0.7\nlength_m = 0.7", ("line 7",)),
}  # fmt: skip


@pytest.mark.parametrize("case", REFUSED)
def test_refusals(case: str, tmp_path: Path) -> None:
    old, new, parts = REFUSED[case]
    assert VALID.count(old) == 1
    path = written(tmp_path, VALID.replace(old, new))
    with pytest.raises(UsageError) as error:
        read_arm_file(path)
    message = str(error.value)
    assert message.startswith(f"arm file {path}")
    for part in parts:
        assert part in message


def test_graph_too_curved_for_its_radius(tmp_path: Path) -> None:
    text = VALID.replace("[0.0, 0.0, 0.3, -0.1]", "[0.0, 0.0, 28.8, -74.2, 71.7]")
    assert read_arm_file(written(tmp_path, text)).setpoints[1].name == "graph"
    path = written(tmp_path, text.replace("radius_m = 0.02", "radius_m = 0.1"))
    with pytest.raises(UsageError, match=r"my_arm\.toml: setpoints\[1\] \(graph\).*= 10\.0/m"):
        read_arm_file(path)


def test_no_hint_where_the_unit_is_right(tmp_path: Path) -> None:
    path = written(tmp_path, VALID.replace("length_m = 0.7\n", ""))
    with pytest.raises(UsageError) as error:
        read_arm_file(path)
    assert "SI units" not in str(error.value)


def test_no_setpoints(tmp_path: Path) -> None:
    head = VALID[: VALID.index("[[setpoints]]")]
    with pytest.raises(UsageError, match=r"my_arm\.toml.*missing required field `setpoints`"):
        read_arm_file(written(tmp_path, head))
    with pytest.raises(UsageError, match=r"my_arm\.toml: setpoints: expected at least one"):
        read_arm_file(written(tmp_path, "setpoints = []\n" + head))


def test_missing_file(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"none\.toml.*--arm"):
        read_arm_file(tmp_path / "none.toml")
    with pytest.raises(UsageError, match="directory"):
        read_arm_file(tmp_path)


# Anything at all


def accepted(folder: Path, raw: str | bytes) -> ArmFile | None:
    """The file if it is valid; a UsageError that names it counts as an answer, anything else is raised."""
    path = written(folder, raw)
    try:
        return read_arm_file(path)
    except UsageError as error:
        if str(path) not in str(error):
            raise
        return None


def usable(file: ArmFile) -> None:
    """What was accepted gives an arm and setpoints of finite numbers."""
    arm = file.arm()
    for value in (time_unit_s(arm), axial_ratio(arm), arm.drag_per_s, arm.bending_stiffness_n_m2):
        assert math.isfinite(value)
        assert value > 0.0
    for setpoint in file.design_setpoints():
        assert np.all(np.isfinite(setpoint.curvature))


FUZZ = settings(
    max_examples=150,
    deadline=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)


@FUZZ
@given(raw=st.binary(max_size=120) | st.text(max_size=60).map(lambda t: t.encode()))
def test_arbitrary_bytes(raw: bytes, tmp_path: Path) -> None:
    assert accepted(tmp_path, raw) is None


@pytest.mark.parametrize("raw", [b"a=" + b"[" * 20_000, b"a." * 2_000 + b"b=1", b"\xff", b"\0"])
def test_hostile_bytes(raw: bytes, tmp_path: Path) -> None:
    assert accepted(tmp_path, raw) is None


@FUZZ
@given(data=st.data())
def test_damaged_bytes(data: st.DataObject, tmp_path: Path) -> None:
    raw = bytearray(VALID.encode())
    for _ in range(data.draw(st.integers(1, 3))):
        place = data.draw(st.integers(0, len(raw) - 1))
        raw[place : place + data.draw(st.integers(0, 12))] = data.draw(
            st.binary(max_size=3) | st.sampled_from([b"9", b"-", b"e9", b"0", b".", b"[", b'"'])
        )
    file = accepted(tmp_path, bytes(raw))
    if file is not None:
        usable(file)


NUMBERS = st.floats() | st.integers() | st.floats(0.0, 10.0)
VALUES: st.SearchStrategy[Any] = (
    NUMBERS | st.booleans() | st.text(max_size=4) | st.lists(NUMBERS, max_size=5)
)


def toml(value: Any) -> str:
    """TOML of what `VALUES` draws."""
    match value:
        case bool():
            return "true" if value else "false"
        case str():
            return '"' + "".join(f"\\U{ord(c):08x}" for c in value) + '"'
        case list():
            return "[" + ", ".join(toml(v) for v in value) + "]"
        case _:
            return repr(value)


@FUZZ
@given(data=st.data())
def test_values_exchanged(data: st.DataObject, tmp_path: Path) -> None:
    lines = VALID.splitlines()
    entries = [number for number, line in enumerate(lines) if " = " in line]
    for number in data.draw(st.lists(st.sampled_from(entries), min_size=1, max_size=3)):
        key = lines[number].split(" = ")[0]
        value = data.draw(st.lists(NUMBERS, max_size=5) if key[0] == "c" else VALUES)
        lines[number] = f"{key} = {toml(value)}"
    text = "\n".join(lines)
    tomllib.loads(text)  # it is TOML: what is refused is refused for its content
    file = accepted(tmp_path, text)
    if file is not None:
        usable(file)


@FUZZ
@given(
    tail=st.lists(st.floats(-30.0, 30.0), max_size=4),
    length=st.floats(0.2, 3.0),
    stiffness=st.floats(1e2, 1e6),
)
def test_graphs_of_any_shape(
    tail: list[float], length: float, stiffness: float, tmp_path: Path
) -> None:
    text = VALID.replace("[0.0, 0.0, 0.3, -0.1]", toml([0.0, 0.0, *tail]))
    text = text.replace("length_m = 0.7", f"length_m = {length}").replace("4e3", repr(stiffness))
    file = accepted(tmp_path, text)
    if file is not None:
        usable(file)
        limit = 1.0 / 0.02
        assert max(abs(k) for k in curvature_samples(file.setpoints[1], length)) <= limit
