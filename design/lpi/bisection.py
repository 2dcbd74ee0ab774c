"""The parameter at which stability ends: the last value that a Lyapunov operator certifies.

The spectrum of the discretisation says where to look; what is reported is what the LPI proves.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace

from design.lpi.result import Achieved, Attempt, Options, Progress, Result, Status, silent
from design.pde.evidence import stability_limit
from design.pde.galerkin import discretise
from design.pde.model import Pde

GAP = 1e-4
"""Distance from the spectral limit, relative, that is tried first and is close enough."""
STEPS = 6
"""Halvings of the uncertified interval per degree, when the first try fails."""
DEGREES = range(1, 7)


def bisect_stability(
    certify: Callable[[Pde, Options, Progress], Result],
    problem: Callable[[float], Pde],
    low: float,
    high: float,
    options: Options,
    progress: Progress,
) -> Result:
    """Raise the degree until a value within GAP of the spectral limit is certified, or time is up.

    certify: answers the stability task for one PDE at the degree in its options. Raises ValueError if the
    discretisation is stable, or unstable, at both ends.
    """
    start = time.perf_counter()
    spectral = stability_limit(problem, low, high)
    limit = spectral.value
    stable = low if _looks_stable(problem, low) else high
    scale = max(abs(limit), 1e-2 * abs(high - low))
    target = limit + GAP * scale * (1.0 if stable > limit else -1.0)
    progress(f"the spectrum puts the limit at {limit:.8g}")
    best: float | None = None
    attempts: list[Attempt] = []
    last: Attempt | None = None

    def certified(parameter: float, degree: int) -> bool:
        nonlocal last
        left = options.time_limit_s - (time.perf_counter() - start)
        result = certify(
            problem(parameter), replace(options, degree=degree, time_limit_s=max(left, 1.0)), silent
        )
        if result.attempts:
            last = result.attempts[-1]
        return result.status is Status.CERTIFIED

    for degree in DEGREES if options.degree is None else (options.degree,):
        began = time.perf_counter()
        reached = certified(target, degree)
        if reached:
            best = target
        else:
            inside = stable if best is None else best
            if best is None and certified(stable, degree):
                best = stable
            outside = target
            for _ in range(STEPS if best is not None else 0):
                middle = 0.5 * (inside + outside)
                if certified(middle, degree):
                    inside = best = middle
                else:
                    outside = middle
        if last is not None:
            attempts.append(last)
        progress(
            f"degree {degree}: {'nothing' if best is None else f'certified up to {best:.8g}'}, "
            f"{time.perf_counter() - began:.1f} s"
        )
        left = options.time_limit_s - (time.perf_counter() - start)
        if reached or 4.0 * (time.perf_counter() - began) > left:
            break
    return Result(
        task="stability",
        status=Status.UNRELIABLE if best is None else Status.CERTIFIED,
        message=(
            "no value between the ends is certified"
            if best is None
            else f"stable from {stable:g} up to {best:.8g}; the spectrum's limit is {limit:.8g}"
        ),
        limit=best,
        achieved=Achieved(
            value=limit,
            by_size=tuple(zip(spectral.sizes, spectral.values, strict=True)),
            converged=spectral.converged,
        ),
        formulation="Lyapunov LPI, bisection",
        best=attempts[-1] if attempts else None,
        attempts=tuple(attempts),
        seconds=time.perf_counter() - start,
    )


def _looks_stable(problem: Callable[[float], Pde], parameter: float) -> bool:
    """Whether the discretisation is stable there: tells the stable end from the other."""
    return not discretise(problem(parameter), 15).grows()
