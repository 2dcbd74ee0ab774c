"""Spectral matrices of PDEs against closed forms: modes, transfer functions, optima, constants of inequalities.

The figures of theory, section 7, come from other programs; where a closed form exists, that is what counts.
"""

from __future__ import annotations

import itertools
import math
import subprocess
import sys
from collections.abc import Callable

import numpy as np
import numpy.typing as npt
import pytest
from scipy.optimize import brentq

from design.pde.evidence import (
    SIZES,
    Refined,
    controller_optimum,
    feedback_loop,
    observer_loop,
    observer_optimum,
    refine,
    sampled_gain,
    stability_limit,
)
from design.pde.galerkin import discretise, norm_ratio
from design.pde.model import (
    Atom,
    Expression,
    Field,
    Input,
    InputIntegral,
    Integral,
    Kind,
    Output,
    Pde,
    Point,
    Polynomial,
    Signal,
    StateVariable,
)

Array = npt.NDArray[np.float64]
Term = tuple[Atom, float | Polynomial]
PI = math.pi


def expr(*terms: Term) -> Expression:
    """Coefficients are numbers or polynomials in s."""
    return Expression(tuple((a, c if isinstance(c, tuple) else (c,)) for a, c in terms))


def number(*terms: Term) -> Output:
    return Output(expr(*terms), distributed=False)


def function(*terms: Term) -> Output:
    return Output(expr(*terms), distributed=True)


def w(index: int = 0) -> Input:
    return Input(Kind.DISTURBANCE, index)


def u(index: int = 0) -> Input:
    return Input(Kind.CONTROL, index)


def mean(state: int = 0) -> Integral:
    return Integral(state, 0, (1.0,))


def zero(*atoms: Atom) -> tuple[Expression, ...]:
    return tuple(expr((a, 1.0)) for a in atoms)


def scalars(*names: str) -> tuple[Signal, ...]:
    return tuple(Signal(name, distributed=False) for name in names)


X = (StateVariable("x", 2),)
DD = zero(Point(0, 0, 0), Point(0, 0, 1))
DN = zero(Point(0, 0, 0), Point(0, 1, 1))
W, WW, U = scalars("w"), scalars("w1", "w2"), scalars("u")
WITH_EFFORT = (number((mean(), 1.0)), number((u(), 1.0)))


def heat(growth: float, conditions: tuple[Expression, ...], *extra: Term, **lists: object) -> Pde:
    """x_t = x_ss + growth x + extra."""
    equation = expr((Field(0, 2), 1.0), (Field(0), growth), *extra)
    return Pde(X, (equation,), conditions, **lists)  # type: ignore[arg-type]


BEAM = (StateVariable("v", 2), StateVariable("k", 2))
CLAMPED_FREE = zero(Point(0, 0, 0), Point(0, 1, 0), Point(1, 0, 1), Point(1, 1, 1))


def beam(drag: float, *extra: Term, **lists: object) -> Pde:
    """v_t = -0.1 k_ss - drag v + extra, k_t = v_ss: u_tt = -0.1 u_ssss with v = u_t, k = u_ss."""
    equations = (
        expr((Field(1, 2), -0.1), (Field(0), -drag), *extra),
        expr((Field(0, 2), 1.0)),
    )
    return Pde(BEAM, equations, CLAMPED_FREE, **lists)  # type: ignore[arg-type]


def with_variable_diffusion(growth: float) -> Pde:
    equation = expr(
        (Field(0, 2), (2.0, 0.0, -1.0, 1.0)),
        (Field(0, 1), (0.0, -2.0, 3.0)),
        (Field(0), (0.7 + growth, -1.5, 1.3, -0.5)),
    )
    return Pde(X, (equation,), DN)


def transport_pair(forth: float, back: float, speed: float = 1.0, drag: float = 0.0) -> Pde:
    """x_t = -x_s - drag x, y_t = speed y_s - drag y, x(0) = forth y(0), y(1) = back x(1)."""
    return Pde(
        (StateVariable("x", 1), StateVariable("y", 1)),
        (
            expr((Field(0, 1), -1.0), (Field(0), -drag)),
            expr((Field(1, 1), speed), (Field(1), -drag)),
        ),
        (
            expr((Point(0, 0, 0), 1.0), (Point(1, 0, 0), -forth)),
            expr((Point(1, 0, 1), 1.0), (Point(0, 0, 1), -back)),
        ),
    )


def damped_wave(k: float) -> Pde:
    """u_tt = u_ss, u(0) = 0, u_s(1) = -k u_t(1)."""
    return Pde(
        (StateVariable("u", 2), StateVariable("v", 1)),
        (expr((Field(1), 1.0)), expr((Field(0, 2), 1.0))),
        (*zero(Point(0, 0, 0), Point(1, 0, 0)), expr((Point(0, 1, 1), 1.0), (Point(1, 0, 1), k))),
    )


def cantilever_root(j: int) -> float:
    """cos(b) cosh(b) = -1."""
    middle = (j + 0.5) * PI
    return float(brentq(lambda b: math.cos(b) + 1.0 / math.cosh(b), middle - 0.6, middle + 0.6))


def near(values: npt.NDArray[np.complex128], wanted: complex) -> complex:
    return complex(values[np.argmin(np.abs(values - wanted))])


def test_shares_no_code_with_the_lpis() -> None:
    code = "import sys, design.pde.evidence; print(*(m for m in sys.modules if m[:6] == 'design'))"
    loaded = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    allowed = {"design", "design.channel", "design.legendre", "design.pde"}
    allowed |= {f"design.pde.{m}" for m in ("evidence", "galerkin", "model", "trial_space")}
    assert set(loaded.stdout.split()) == allowed


# Modes


@pytest.mark.parametrize("size", [16, 23])
@pytest.mark.parametrize(("conditions", "shift"), [(DD, 1.0), (DN, 0.5)])
def test_modes_of_the_heat_equation(
    conditions: tuple[Expression, ...], shift: float, size: int
) -> None:
    values = discretise(heat(0.0, conditions), size).eigenvalues
    for n in range(5):
        exact = -(((n + shift) * PI) ** 2)
        assert near(values, exact) == pytest.approx(exact, rel=1e-7)
    assert values.real.max() < -2.4


@pytest.mark.parametrize("size", SIZES)
def test_modes_of_a_cantilever(size: int) -> None:
    """lambda^2 + d lambda + 0.1 b^4 = 0, and at every size nothing decays slower than d / 2."""
    drag = 0.3
    system = discretise(beam(drag), size)
    for j in range(4):
        b = cantilever_root(j)
        exact = complex(-0.5 * drag, math.sqrt(0.1 * b**4 - 0.25 * drag**2))
        assert near(system.eigenvalues, exact) == pytest.approx(exact, rel=1e-8)
    assert system.abscissa() == pytest.approx(-0.5 * drag, rel=1e-6)


@pytest.mark.parametrize("size", SIZES)
def test_modes_of_a_clamped_plate_strip(size: int) -> None:
    """x_t = -x_ssss, x and x_s zero at both ends: -b^4 with cos(b) cosh(b) = 1."""
    clamped = zero(Point(0, 0, 0), Point(0, 0, 1), Point(0, 1, 0), Point(0, 1, 1))
    pde = Pde((StateVariable("x", 4),), (expr((Field(0, 4), -1.0)),), clamped)
    b = brentq(lambda x: math.cos(x) - 1.0 / math.cosh(x), 4.0, 5.5)
    system = discretise(pde, size)
    assert system.abscissa() == pytest.approx(-(b**4), rel=1e-10)
    assert np.abs(system.eigenvalues.imag).max() <= 1e-9 * np.abs(system.eigenvalues).max()


@pytest.mark.parametrize("size", [8, *SIZES])
def test_transport_has_no_slow_modes(size: int) -> None:
    """x_t = -x_s, x(0) = 0 has no modes at all."""
    pde = Pde((StateVariable("x", 1),), (expr((Field(0, 1), -1.0)),), DD[:1])
    assert discretise(pde, size).abscissa() < -5.0


@pytest.mark.parametrize("size", [8, *SIZES])
@pytest.mark.parametrize(
    ("forth", "back", "speed"), [(0.5, 0.5, 1.0), (2.0, 0.3, 1.0), (5.0, 0.1, 1.0), (2.0, 0.3, 4.0)]
)
def test_modes_of_a_hyperbolic_pair(forth: float, back: float, speed: float, size: int) -> None:
    """exp(lambda (1 + 1 / speed)) = forth back: all modes decay alike, whatever the weights."""
    system = discretise(transport_pair(forth, back, speed), size)
    lap = 1.0 + 1.0 / speed
    assert system.abscissa() == pytest.approx(math.log(forth * back) / lap, rel=1e-6)
    second = complex(math.log(forth * back), 2.0 * PI) / lap
    assert near(system.eigenvalues, second) == pytest.approx(second, rel=1e-5)
    assert system.method == "tau"


def test_galerkin_lets_the_fast_modes_of_such_a_pair_grow() -> None:
    """Why the tau method is the one that is used: in plain L2 the reflection by 2 gains energy."""
    pde = transport_pair(2.0, 0.3)
    galerkin = [discretise(pde, size, "galerkin") for size in SIZES]
    slow = 0.5 * math.log(0.6)
    assert all(near(s.eigenvalues, slow) == pytest.approx(slow, rel=1e-8) for s in galerkin)
    assert all(s.abscissa() > 20.0 for s in galerkin)


@pytest.mark.parametrize("size", [8, *SIZES])
@pytest.mark.parametrize("k", [0.2, 0.5, 2.0])
def test_modes_of_a_wave_with_a_damper_at_its_end(k: float, size: int) -> None:
    """All at Re lambda = log |(1 - k) / (1 + k)| / 2; displacement and velocity share a condition."""
    exact = 0.5 * math.log(abs((1.0 - k) / (1.0 + k)))
    assert discretise(damped_wave(k), size).abscissa() == pytest.approx(exact, rel=1e-5)


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize(
    "pde",
    [
        beam(0.0),
        damped_wave(0.0),
        transport_pair(1.0, 1.0),
        transport_pair(4.0, 0.25, 3.0),
        Pde(  # the wave equation with a velocity that has no derivative
            (StateVariable("u", 2), StateVariable("v", 0)),
            (expr((Field(1), 1.0)), expr((Field(0, 2), 1.0))),
            DN,
        ),
        Pde(  # the beam in displacement and velocity
            (StateVariable("u", 4), StateVariable("v", 0)),
            (expr((Field(1), 1.0)), expr((Field(0, 4), -1.0))),
            zero(Point(0, 0, 0), Point(0, 1, 0), Point(0, 2, 1), Point(0, 3, 1)),
        ),
        Pde(  # a string of stiffness 1 - 0.9 s: v_t = (a e)_s, e_t = v_s
            (StateVariable("v", 1), StateVariable("e", 1)),
            (expr((Field(1, 1), (1.0, -0.9)), (Field(1), -0.9)), expr((Field(0, 1), 1.0))),
            zero(Point(0, 0, 0), Point(1, 0, 1)),
        ),
    ],
    ids=["beam", "wave", "ring", "ring of two media", "wave u v", "beam u v", "string"],
)
def test_conservative_stays_so(pde: Pde, size: int) -> None:
    system = discretise(pde, size)
    assert not system.grows()
    assert np.abs(system.eigenvalues.real).max() <= 1e-9 * np.abs(system.eigenvalues).max()
    assert system.gain() == math.inf  # nothing decays


def test_slow_growth_is_growth() -> None:
    assert discretise(beam(-1e-6), 35).grows()
    assert discretise(heat(PI**2 + 1e-6, DD), 35).grows()
    assert not discretise(heat(PI**2 - 1e-6, DD), 35).grows()


@pytest.mark.parametrize("size", [15, 16])
def test_periodic_transport(size: int) -> None:
    """For even sizes the last Legendre function is periodic itself: one degree more is taken."""
    ring = (expr((Point(0, 0, 0), 1.0), (Point(0, 0, 1), -1.0)),)
    system = discretise(Pde((StateVariable("x", 1),), (expr((Field(0, 1), -1.0)),), ring), size)
    assert system.method == "tau"
    assert (system.size, system.rows) == (size, 16 if size == 15 else 18)
    for n in (0, 1, 2):
        exact = complex(0.0, 2.0 * PI * n)
        assert near(system.eigenvalues, exact) == pytest.approx(exact, abs=1e-4)
    assert not system.grows()


def test_growth_that_is_not_the_equations() -> None:
    """Reflection by 1.2, drag 1: all modes have Re lambda = log(1.2) / 2 - 1, yet fast ones seem to grow."""
    damped = transport_pair(1.2, 1.0, drag=1.0)
    for size in SIZES:
        system = discretise(damped, size)
        exact = 0.5 * math.log(1.2) - 1.0
        assert near(system.eigenvalues, exact) == pytest.approx(exact, rel=1e-8)
        assert system.grows()
        assert system.undecided()
    for truly in (transport_pair(1.2, 1.0), heat(PI**2 + 0.1, DD)):
        system = discretise(truly, 15)
        assert system.grows()
        assert not system.undecided()
    assert not discretise(heat(0.0, DD), 15).undecided()


def test_ode_with_delay() -> None:
    """X_t = -X - 2 X(t - 1): lambda = -1 - 2 exp(-lambda); the delay is a transport equation."""
    pde = Pde(
        (StateVariable("x", 1), StateVariable("X", None)),
        (expr((Field(0, 1), -1.0)), expr((Field(1), -1.0), (Point(0, 0, 1), -2.0))),
        (expr((Point(0, 0, 0), 1.0), (Field(1), -1.0)),),
    )
    value = near(discretise(pde, 15).eigenvalues, complex(-0.1, 2.0))
    assert value == pytest.approx(-1.0 - 2.0 * np.exp(-value), rel=1e-9)


def test_ode_and_rod() -> None:
    """X_t = -X + x_s(0), x(0) = X, x_s(1) = 0: (1 - m^2) cos(m) = m sin(m), lambda = -m^2."""
    pde = Pde(
        (StateVariable("X", None), StateVariable("x", 2)),
        (expr((Field(0), -1.0), (Point(1, 1, 0), 1.0)), expr((Field(1, 2), 1.0))),
        (expr((Point(1, 0, 0), 1.0), (Field(0), -1.0)), *zero(Point(1, 1, 1))),
    )
    m = brentq(lambda x: (1.0 - x**2) * math.cos(x) - x * math.sin(x), 0.3, 1.0)
    assert discretise(pde, 15).abscissa() == pytest.approx(-(m**2), rel=1e-10)


def test_condition_with_an_integral() -> None:
    """x(0) = int x, x_s(1) = 0: x = cos(m (1 - s)) with tan(m) = m; the constant is a mode too."""
    nonlocal_end = (expr((Point(0, 0, 0), 1.0), (mean(), -1.0)), *zero(Point(0, 1, 1)))
    values = discretise(heat(0.0, nonlocal_end), 19).eigenvalues
    m = brentq(lambda x: x * math.cos(x) - math.sin(x), 4.0, 4.6)
    assert near(values, 0.0) == pytest.approx(0.0, abs=1e-8)
    assert near(values, -(m**2)) == pytest.approx(-(m**2), rel=1e-9)


# Limits of stability


@pytest.mark.parametrize(
    ("problem", "exact"),
    [
        (lambda p: heat(p, DD), PI**2),
        (lambda p: heat(p, DN), PI**2 / 4.0),
        (with_variable_diffusion, 4.653784),
        (lambda p: heat(-p, DD), -(PI**2)),  # from growth to decay
        (beam, 0.0),
    ],
    ids=["S1", "S2", "S3", "falling", "beam"],
)
def test_stability_limit(problem: Callable[[float], Pde], exact: float) -> None:
    found = stability_limit(problem, -12.0, 20.0)
    assert found.converged
    assert found.value == pytest.approx(exact, abs=1e-6)


def test_no_limit_in_the_range() -> None:
    with pytest.raises(ValueError, match="grow at both 11 and 20"):
        stability_limit(lambda p: heat(p, DD), 11.0, 20.0)
    with pytest.raises(ValueError, match="do not grow at both"):
        stability_limit(lambda p: heat(p, DD), 0.0, 9.0)


# Gains


@pytest.mark.parametrize("size", [12, 23])
@pytest.mark.parametrize("method", ["tau", "galerkin"])
@pytest.mark.parametrize(
    ("pde", "exact"),
    [
        (
            Pde(
                (StateVariable("x", 1),), (expr((Field(0, 1), -1.0), (w(), 1.0)),), DD[:1],
                disturbances=W, regulated=(number((mean(), 1.0)),),
            ),
            0.5,
        ),
        (
            heat(0.0, DN, (w(), (0.0, 1.0)), disturbances=W, regulated=(number((mean(), 1.0)),)),
            5.0 / 24.0,
        ),
        (
            heat(0.99 * PI**2, DD, (w(), 1.0), disturbances=W, regulated=(number((mean(), 1.0)),)),
            8.2141230,
        ),
        (
            beam(0.1, (w(), 1.0), disturbances=W, regulated=(number((mean(), 1.0)),)),
            6.1307749,
        ),
    ],
    ids=["G20", "G22", "G24", "G29"],
)  # fmt: skip
def test_open_loop_gain(pde: Pde, exact: float, method: str, size: int) -> None:
    assert discretise(pde, size, method).gain() == pytest.approx(exact, rel=2e-8)  # type: ignore[arg-type]


FIELD = (Signal("w", distributed=True),)


PROFILE = InputIntegral(Kind.DISTURBANCE, 0, (0.0, 1.0))
"""int s w(s) ds."""


@pytest.mark.parametrize(
    ("source", "output", "exact"),
    [
        ((w(), 1.0), function((Field(0), 1.0)), PI**-2),  # the first mode
        ((w(), 1.0), number((mean(), 1.0)), 1.0 / math.sqrt(120.0)),  # |s (1 - s) / 2|
        ((w(), (0.0, 1.0)), number((mean(), 1.0)), 1.0 / math.sqrt(420.0)),  # |s^2 (1 - s) / 2|
        ((w(), 1.0), number((Point(0, 1, 0), 1.0)), 1.0 / math.sqrt(3.0)),  # |1 - s|
        ((w(), 0.0), number((PROFILE, 2.0)), 2.0 / math.sqrt(3.0)),
        ((PROFILE, 1.0), number((mean(), 1.0)), 1.0 / (12.0 * math.sqrt(3.0))),
        ((w(), 0.0), function((w(), (0.0, 1.0))), 1.0),  # |s w| <= |w|, the supremum
    ],
)
def test_distributed_signals(source: Term, output: Output, exact: float) -> None:
    """x_t = x_ss + source, DD: the peak is at frequency 0."""
    pde = heat(0.0, DD, source, disturbances=FIELD, regulated=(output,))
    tolerance = 1e-2 if output.distributed and source[1] == 0.0 else 1e-8
    assert discretise(pde, 25).gain() == pytest.approx(exact, rel=tolerance)


def test_scalar_signals_come_first() -> None:
    """x_t = -x + w0(s) + 2 w1, z = (x(s), int x), with nothing but a function of s as state."""
    signals = (Signal("w0", distributed=True), Signal("w1", distributed=False))
    equation = expr((Field(0), -1.0), (w(0), 1.0), (w(1), 2.0))
    outputs = (function((Field(0), 1.0)), number((mean(), 1.0)))
    pde = Pde((StateVariable("x", 0),), (equation,), disturbances=signals, regulated=outputs)
    system = discretise(pde, 6)
    effect, seen = system.state @ system.B1, system.C1 @ system.state.T
    assert effect == pytest.approx(np.hstack([2.0 * np.eye(6)[:, :1], np.eye(6)]), abs=1e-13)
    assert seen == pytest.approx(np.vstack([np.eye(6)[:1], np.eye(6)]), abs=1e-13)


def test_state_is_orthonormal() -> None:
    pde = beam(0.1, (w(), 1.0), disturbances=W)
    system = discretise(pde, 35)
    # rounding of 70 functions up to degree 34: 1.04e-12 with the slowest of OpenBLAS's kernels
    assert system.state.T @ system.state == pytest.approx(np.eye(70), abs=1e-11)
    # a uniform force enters v and not k, as `force` and as a disturbance
    uniform = sampled_gain(
        system, np.zeros((0, 1)), lambda s: np.stack([np.ones_like(s), 0.0 * s])[:, None]
    )
    assert system.force @ uniform == pytest.approx(system.B1, abs=1e-8)


# Closed loops, against transfer functions


def h_infinity(response: Callable[[float], Array]) -> float:
    """Largest singular value over a dense grid of frequencies."""
    omega = np.concatenate([np.linspace(1e-6, 20.0, 8001), np.geomspace(20.0, 1e3, 500)])
    return max(float(np.linalg.norm(response(float(o)), 2)) for o in omega)


def test_observer_of_a_transport_equation() -> None:
    """x_t = -x_s + w1, x(0) = 0, y = x(1) + w2, z = int x + 0.3 w1, L = -0.8 exp(-s)."""
    pde = Pde(
        (StateVariable("x", 1),), (expr((Field(0, 1), -1.0), (w(0), 1.0)),), DD[:1],
        disturbances=WW,
        regulated=(number((mean(), 1.0), (w(0), 0.3)),),
        measured=(number((Point(0, 0, 1), 1.0), (w(1), 1.0)),),
    )  # fmt: skip
    t, weights = np.polynomial.legendre.leggauss(80)
    t, weights = 0.5 * (t + 1.0), 0.5 * weights
    L = -0.8 * np.exp(-t)

    def response(omega: float) -> Array:
        """Of e_t = -e_s + L (e(1) - w2) - w1 to (w1, w2), by variation of constants."""
        at_end = np.exp(-1j * omega * (1.0 - t)) * weights
        in_mean = (1.0 - np.exp(-1j * omega * (1.0 - t))) / (1j * omega) * weights
        loop = 1.0 - at_end @ L
        end = np.array([-at_end.sum(), -(at_end @ L)]) / loop
        return np.asarray(
            in_mean @ L * (end - [0.0, 1.0]) - in_mean.sum() * np.array([1.0, 0.0]) - [0.3, 0.0]
        )[None]

    for size in (16, 23):
        system = discretise(pde, size)
        gain = sampled_gain(system, np.zeros((0, 1)), lambda s: -0.8 * np.exp(-s)[None, None])
        channel = observer_loop(system, gain)
        for omega in (0.1, 1.7, 6.0):
            exact = float(np.linalg.norm(response(omega)))
            assert channel.norm_at(omega) == pytest.approx(exact, rel=1e-9)
        assert channel.hinf_norm() == pytest.approx(h_infinity(response), rel=1e-5)


def test_feedback_of_an_ode_and_its_past() -> None:
    """X_t = 0.4 X + u + w, u = -1.5 X - int (1 + s) X(t - s) ds, z = (X, u + 0.2 w)."""
    pde = Pde(
        (StateVariable("x", 1), StateVariable("X", None)),
        (expr((Field(0, 1), -1.0)), expr((Field(1), 0.4), (u(), 1.0), (w(), 1.0))),
        (expr((Point(0, 0, 0), 1.0), (Field(1), -1.0)),),
        disturbances=W,
        controls=U,
        regulated=(number((Field(1), 1.0)), number((u(), 1.0), (w(), 0.2))),
    )

    s, weights = np.polynomial.legendre.leggauss(60)
    s, weights = 0.5 * (s + 1.0), 0.5 * weights

    def response(omega: float) -> Array:
        k = -1.5 - weights @ ((1.0 + s) * np.exp(-1j * omega * s))
        state = 1.0 / (1j * omega - 0.4 - k)
        return np.array([[state], [k * state + 0.2]])

    system = discretise(pde, 23)
    gain = sampled_gain(system, np.array([[-1.5]]), lambda s: -(1.0 + s)[None, None])
    channel = feedback_loop(system, gain.T)
    for omega in (0.1, 1.7, 6.0):
        assert channel.norm_at(omega) == pytest.approx(np.linalg.norm(response(omega)), rel=1e-9)
    assert channel.hinf_norm() == pytest.approx(h_infinity(response), rel=1e-5)
    # without feedback X grows; with the sign of the gain reversed too
    zero_gain = np.zeros_like(gain.T)
    assert feedback_loop(system, zero_gain).hinf_norm() == math.inf
    assert feedback_loop(system, -gain.T).hinf_norm() == math.inf


def test_observer_of_a_field() -> None:
    """x_t = x_ss + w1(s), DD, y = x + w2(s), z = x, L = -l: each mode has sqrt(1 + l^2) / (n^2 pi^2 + l)."""
    signals = (Signal("w1", distributed=True), Signal("w2", distributed=True))
    pde = heat(
        0.0, DD, (w(0), 1.0),
        disturbances=signals,
        regulated=(function((Field(0), 1.0)),),
        measured=(function((Field(0), 1.0), (w(1), 1.0)),),
    )  # fmt: skip
    system = discretise(pde, 15)
    gain = -2.0 * np.eye(system.rows, system.size)
    exact = math.sqrt(5.0) / (PI**2 + 2.0)
    assert observer_loop(system, gain).hinf_norm() == pytest.approx(exact, rel=1e-6)
    best = observer_optimum(system).value
    assert best == pytest.approx(1.0 / math.sqrt(1.0 + PI**4), rel=1e-6)


# Optima


def observed_heat(growth: float) -> Pde:
    return heat(
        growth, DN, (w(0), 1.0),
        disturbances=WW,
        regulated=(number((mean(), 1.0)),),
        measured=(number((Point(0, 0, 1), 1.0), (w(1), 1.0)),),
    )  # fmt: skip


OBSERVED_BEAM = beam(
    0.1, (w(0), 1.0),
    disturbances=WW,
    regulated=(number((mean(), 1.0)),),
    measured=(number((Point(0, 0, 1), 1.0), (w(1), 1.0)),),
)  # fmt: skip


@pytest.mark.parametrize(
    ("pde", "exact"),
    [
        (observed_heat(4.0), 0.636866),
        # at frequency 0 no filter does better than this, and this one does as well
        (observed_heat(0.0), 2.0 / (3.0 * math.sqrt(5.0))),
        (OBSERVED_BEAM, 0.390951),
    ],
    ids=["N1", "N2", "N6"],
)
def test_observer_optimum(pde: Pde, exact: float) -> None:
    found = refine(lambda size: observer_optimum(discretise(pde, size)).value or 0.0)
    assert found.converged
    assert found.value == pytest.approx(exact, abs=6e-7)


@pytest.mark.parametrize(
    ("pde", "exact"),
    [
        (
            heat(10.0, DD, (w(), (0.0, 1.0, -1.0)), (u(), (0.0, 1.0, -1.0)),
                 disturbances=W, controls=U, regulated=WITH_EFFORT),
            1.0,
        ),
        (
            heat(5.0, DN, (w(), (0.0, 2.0, -1.0)), (u(), (0.0, 1.0)),
                 disturbances=W, controls=U, regulated=WITH_EFFORT),
            1.273241,
        ),
        (
            beam(0.1, (w(), (0.0, 0.0, 1.0)), (u(), (0.0, 0.0, 1.0)),
                 disturbances=W, controls=U, regulated=WITH_EFFORT),
            0.961260,
        ),
        (
            beam(0.1, (w(), 1.0), (u(), (0.0, 1.0)),
                 disturbances=W, controls=U, regulated=WITH_EFFORT),
            1.751990,
        ),
    ],
    ids=["C29", "NC1b", "NC3", "NC4"],
)  # fmt: skip
def test_controller_optimum(pde: Pde, exact: float) -> None:
    found = refine(lambda size: controller_optimum(discretise(pde, size)).value or 0.0)
    assert found.converged
    assert found.value == pytest.approx(exact, abs=1e-6)


def test_both_methods_have_the_same_optimum() -> None:
    for pde in (observed_heat(4.0), OBSERVED_BEAM):
        one, other = (observer_optimum(discretise(pde, 23, m)).value for m in ("tau", "galerkin"))
        assert one == pytest.approx(other, rel=2e-7)


def test_no_gain_beats_the_optimum() -> None:
    """And some come close to it, so that the bound means something."""
    system = discretise(observed_heat(4.0), 12)
    best = observer_optimum(system).value
    assert best is not None
    reached = [
        observer_loop(
            system,
            sampled_gain(system, np.zeros((0, 1)), lambda s: np.polyval(ab, s)[None, None]),  # noqa: B023
        ).hinf_norm()
        for ab in itertools.product(np.linspace(-24.0, 0.0, 7), np.linspace(-40.0, 0.0, 7))
    ]
    assert min(reached) >= best * (1.0 - 1e-6)
    assert min(reached) <= best * 1.1


def test_optima_without_a_riccati_equation() -> None:
    free = heat(
        0.0, DN, (w(), 1.0), (u(), 1.0), disturbances=W, controls=U, regulated=WITH_EFFORT[:1]
    )
    exact = heat(
        0.0, DN, (w(), 1.0),
        disturbances=W, regulated=WITH_EFFORT[:1], measured=(number((Point(0, 0, 1), 1.0)),),
    )  # fmt: skip
    found = controller_optimum(discretise(free, 9))
    assert found.value is None
    assert "cost" in found.reason
    found = observer_optimum(discretise(exact, 9))
    assert found.value is None
    assert "noise" in found.reason
    assert controller_optimum(discretise(exact, 9)).reason == "there is no control"


# Inequalities


@pytest.mark.parametrize(
    ("order", "conditions", "over", "under", "exact"),
    [
        (1, DD[:1], [function((Field(0), 1.0))], [function((Field(0, 1), 1.0))], 2.0 / PI),
        (1, DD, [function((Field(0), 1.0))], [function((Field(0, 1), 1.0))], 1.0 / PI),
        (2, DD, [function((Field(0), 1.0))], [function((Field(0, 1), 1.0))], 1.0 / PI),
        (2, DD, [function((Field(0), 1.0))], [function((Field(0, 2), 1.0))], PI**-2),
        (2, DD, [function((Field(0), 1.0)), function((Field(0, 1), 1.0))],
         [function((Field(0, 1), 1.0))], math.sqrt(1.0 + PI**-2)),
        (1, DD[:1], [number((Point(0, 0, 1), 1.0))], [function((Field(0, 1), 1.0))], 1.0),
        (1, DD[:1], [number((mean(), 1.0))], [function((Field(0, 1), 1.0))], 1.0 / math.sqrt(3.0)),
        (4, zero(Point(0, 0, 0), Point(0, 0, 1), Point(0, 1, 0), Point(0, 1, 1)),
         [function((Field(0), 1.0))], [function((Field(0, 4), 1.0))], 4.730040744862704**-4),
        # constants have no derivative
        (1, (), [function((Field(0), 1.0))], [function((Field(0, 1), 1.0))], math.inf),
        (1, (), [function((Field(0, 1), 1.0))], [function((Field(0, 1), 2.0))], 0.5),
    ],
    ids=["O1", "O2", "O2 in H2", "DD", "sum", "trace", "mean", "clamped", "constants", "seminorm"],
)  # fmt: skip
def test_norm_ratio(
    order: int,
    conditions: tuple[Expression, ...],
    over: list[Output],
    under: list[Output],
    exact: float,
) -> None:
    pde = Pde(
        (StateVariable("x", order),), (expr(),), conditions,
        numerator=tuple(over), denominator=tuple(under),
    )  # fmt: skip
    for size in (12, 23):
        assert norm_ratio(pde, size) == pytest.approx(exact, rel=1e-9)


def test_an_unbounded_ratio_does_not_converge() -> None:
    pde = Pde(
        (StateVariable("x", 1),), (expr(),), DD,
        numerator=(function((Field(0, 1), 1.0)),), denominator=(function((Field(0), 1.0)),),
    )  # fmt: skip
    assert not refine(lambda size: norm_ratio(pde, size)).converged


# Refinement


def test_refinement_stops_when_two_sizes_agree() -> None:
    asked: list[int] = []

    def figure(size: int) -> float:
        asked.append(size)
        return 1.0 + math.pow(10.0, -size / 3.0)

    found = refine(figure, (6, 12, 24, 48), tolerance=1e-3)
    assert asked == [6, 12, 24]
    assert found.converged
    assert found.value == pytest.approx(1.0 + 1e-8, rel=1e-12)
    assert found.change == pytest.approx(1e-4, rel=1e-3)


def test_refinement_says_what_it_did_not_reach() -> None:
    found = refine(lambda size: 1.0 + 1.0 / size, (8, 16, 32))
    assert not found.converged
    assert found.change == pytest.approx(1.0 / 34.0, rel=1e-9)
    assert found.extrapolated == pytest.approx(1.0, rel=1e-12)
    hurried = refine(lambda size: 1.0 + 1.0 / size, (8, 16, 32), seconds=0.0)
    assert hurried.sizes == (8,)
    assert hurried.change == math.inf
    assert hurried.extrapolated == hurried.value == 1.125


def test_refinement_of_what_is_infinite() -> None:
    both = Refined((8, 16), (math.inf, math.inf), 1e-6, 0.0)
    assert both.converged
    one = Refined((8, 16, 32), (math.inf, math.inf, 2.0), 1e-6, 0.0)
    assert not one.converged
    assert one.extrapolated == 2.0
    with pytest.raises(ValueError, match="not one each"):
        Refined((8, 16), (1.0,), 1e-6, 0.0)


# Refusals


@pytest.mark.parametrize(
    ("states", "equation", "conditions", "message"),
    [
        (X, expr((Field(0, 2), 1.0)), DD[:1], "1 independent conditions.*add up to 2"),
        (X, expr((Field(0, 2), 1.0)), (*DD[:1], *DD[:1]), "1 independent conditions"),
        (X, expr((Field(0, 3), 1.0)), DD, "of order 2, has no such derivative"),
        (X, expr((Point(0, 2, 1), 1.0)), DD, "of order 2, has no such derivative"),
        (X, expr((Integral(0, 3, (1.0,)), 1.0)), DD, "no such derivative"),
        ((StateVariable("X", None),), expr((Point(0, 0, 1), 1.0)), (), "of order None"),
        ((StateVariable("X", None),), expr((Field(0), (0.0, 1.0))), (), "is to be a number"),
        (X, expr((Field(0, 2), 1.0)), (expr((Field(0), 1.0)), *DD[1:]), "is to be a number"),
    ],
)
def test_refusals(
    states: tuple[StateVariable, ...],
    equation: Expression,
    conditions: tuple[Expression, ...],
    message: str,
) -> None:
    with pytest.raises(ValueError, match=message):
        discretise(Pde(states, (equation,), conditions), 8)


def test_gains_of_the_wrong_shape_are_refused() -> None:
    system = discretise(observed_heat(0.0), 8)
    with pytest.raises(ValueError, match=r"L: expected a matrix of shape \(10, 1\), got \(9, 1\)"):
        observer_loop(system, np.zeros((9, 1)))
    with pytest.raises(ValueError, match=r"K: expected a matrix of shape \(0, 10\)"):
        feedback_loop(system, np.zeros((1, 10)))
    with pytest.raises(ValueError, match="gain: expected"):
        sampled_gain(system, np.zeros((1, 1)), lambda s: s[None, None])
