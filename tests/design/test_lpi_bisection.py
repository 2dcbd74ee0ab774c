"""The parameter where stability ends: certified up to a part in ten thousand, and never beyond."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
from lpi_reference import DD, DN, heat

from design.lpi.bisection import GAP, bisect_stability
from design.lpi.engine import stability_limit
from design.lpi.reporter import Reporter
from design.lpi.result import Attempt, Options, Progress, Result, Status, silent
from design.pde.model import Pde

PI2 = math.pi**2


def growing(growth: float) -> Pde:
    return heat(f"x_ss + {growth!r}*x + w", DD)


def diffusing(diffusion: float) -> Pde:
    return heat(f"{diffusion!r}*x_ss + 4*x + w", DD)


def test_limit_of_growth() -> None:
    """S1: x_t = x_ss + lam x, x(0) = x(1) = 0 is stable below pi^2."""
    said: list[str] = []
    result = stability_limit(growing, 0.0, 20.0, Options(), said.append)
    assert result.status is Status.CERTIFIED
    assert result.limit is not None
    assert PI2 * (1.0 - 2e-4) <= result.limit < PI2
    assert result.achieved is not None and result.achieved.converged
    assert result.achieved.value == pytest.approx(PI2, rel=1e-6)
    assert result.best is not None and result.best.margin > 0.0
    assert [a.degree for a in result.attempts] == list(range(1, result.best.degree + 1))
    assert result.gamma is None
    assert f"{result.limit:.8g}" in result.message
    assert said[0].startswith("the spectrum puts the limit at 9.8696")


def test_stable_above_the_limit() -> None:
    """x_t = nu x_ss + 4 x is stable for nu above 4 / pi^2: the certified value lies above the limit."""
    result = stability_limit(diffusing, 0.1, 2.0, Options(degree=3))
    assert result.status is Status.CERTIFIED
    assert result.limit is not None
    assert 4.0 / PI2 < result.limit <= 4.0 / PI2 * (1.0 + 2e-4)


def test_ends_in_any_order() -> None:
    forward = stability_limit(growing, 5.0, 12.0, Options(degree=3))
    backward = stability_limit(growing, 12.0, 5.0, Options(degree=3))
    assert forward.limit == pytest.approx(backward.limit, rel=1e-6)
    assert forward.status is backward.status is Status.CERTIFIED


@pytest.mark.parametrize(("low", "high", "what"), [(0.0, 5.0, "do not grow"), (11.0, 20.0, "grow")])
def test_no_limit_between_the_ends(low: float, high: float, what: str) -> None:
    with pytest.raises(ValueError, match=f"modes {what} at both"):
        stability_limit(growing, low, high, Options(degree=1))


def test_degree_that_does_not_reach_the_limit() -> None:
    """DN at degree 2: less is certified than the spectrum says, by bisection; what is, is stable."""
    result = stability_limit(lambda v: heat(f"x_ss + {v!r}*x + w", DN), 0.0, 5.0, Options(degree=2))
    assert result.status is Status.CERTIFIED
    assert result.limit is not None
    assert 2.0 < result.limit < PI2 / 4.0 * (1.0 - 1e-4)
    assert result.achieved is not None
    assert result.achieved.value == pytest.approx(PI2 / 4.0, rel=1e-6)


ATTEMPT = Attempt(
    degree=1, gram_sizes=(), equalities=0, iterations=0, solver="", solver_status="", residual=0.0,
    smallest_gram_eigenvalue=0.0, margin=1.0, value=1.0, section_change=0.0, assembly_s=0.0,
    modelling_s=0.0, solver_s=0.0, verification_s=0.0,
)  # fmt: skip


class Certifier:
    """Certifies below a value that grows with the degree; remembers what it was asked."""

    def __init__(self, *upto: float) -> None:
        self.upto = upto
        self.asked: list[tuple[float, int]] = []

    def __call__(self, pde: Pde, options: Options, progress: Progress) -> Result:
        degree = options.degree or 0
        growth = float(pde.equations[0].terms[1][1][0])
        self.asked.append((growth, degree))
        good = growth <= self.upto[min(degree, len(self.upto)) - 1]
        status = Status.CERTIFIED if good else Status.UNRELIABLE
        return Result("stability", status, "", attempts=(replace(ATTEMPT, degree=degree),))


def bisected(certify: Certifier, options: Options, progress: Progress = silent) -> Result:
    return bisect_stability(certify, growing, 0.0, 20.0, options, progress)


def test_bisection_closes_in_on_what_is_certified() -> None:
    certify = Certifier(7.3)
    result = bisected(certify, Options(degree=2))
    assert result.limit is not None
    assert result.limit <= 7.3
    assert result.limit == pytest.approx(7.3, abs=(PI2 - 0.0) / 2**9)
    assert {degree for _, degree in certify.asked} == {2}
    assert max(growth for growth, _ in certify.asked) < PI2  # never asked where it is unstable


def test_higher_degrees_until_the_target() -> None:
    certify = Certifier(3.0, 8.0, 20.0)
    result = bisected(certify, Options())
    assert result.limit == pytest.approx(PI2 * (1.0 - GAP), rel=1e-7)
    assert [degree for _, degree in certify.asked][-1] == 3
    assert result.best is not None and result.best.degree == 3


def test_nothing_is_certified() -> None:
    result = bisected(Certifier(-1.0), Options())
    assert result.status is Status.UNRELIABLE
    assert result.limit is None
    assert "no value" in result.message


def test_best_so_far_is_told() -> None:
    """Each value that is handed over is certified, and the last is where the search stood."""
    told: list[Result] = []
    certify = Certifier(3.0, 8.0)
    result = bisected(certify, Options(degree=2), Reporter(best=told.append))
    assert told
    limits = [math.inf if t.limit is None else t.limit for t in told]
    assert all(t.status is Status.CERTIFIED for t in told)
    assert result.limit is not None
    assert limits == sorted(limits)
    assert limits[-1] <= result.limit <= 8.0
