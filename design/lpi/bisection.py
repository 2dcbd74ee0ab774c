"""The parameter at which stability ends: the last value that a Lyapunov operator certifies.

The spectrum of the discretisation says where to look; what is reported is what the LPI proves.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace

from design.lpi.reporter import Reporter
from design.lpi.result import Achieved, Attempt, Options, Progress, Result, Status, silent
from design.pde.evidence import stability_limit
from design.pde.galerkin import discretise
from design.pde.model import Pde

GAP = 1e-4
"""Distance from the spectral limit, relative, that is tried first and is close enough."""
STEPS = 10
"""Halvings of the interval that is left, at the last degree, as far as time allows."""
_GROWTH = 5.0
"""How much longer a degree takes than the one before it."""
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

    def remaining_s() -> float:
        return options.time_limit_s - (time.perf_counter() - start)

    def certified(parameter: float, degree: int) -> bool:
        nonlocal last
        left = replace(options, degree=degree, time_limit_s=max(remaining_s(), 1.0))
        result = certify(problem(parameter), left, silent)
        if result.attempts:
            last = result.attempts[-1]
        return result.status is Status.CERTIFIED

    degrees = DEGREES if options.degree is None else range(options.degree, options.degree + 1)
    for degree in degrees:
        began = time.perf_counter()
        if certified(target, degree):
            best = target
        else:  # one step of the bisection, so that something is certified whatever comes
            middle = stable if best is None else 0.5 * (best + target)
            best = middle if certified(middle, degree) else best
        took = time.perf_counter() - began
        if last is not None:
            attempts.append(last)
        progress(
            f"degree {degree}: {'nothing' if best is None else f'certified up to {best:.8g}'}, "
            f"{took:.1f} s"
        )
        if best is not None and isinstance(progress, Reporter):
            progress.best(_so_far(best, attempts, time.perf_counter() - start))
        if best == target or _GROWTH * took > remaining_s():
            break
    if best is not None and best != target:
        inside, outside, step_s = best, target, took
        for _ in range(STEPS):
            if step_s > remaining_s():
                break
            middle = 0.5 * (inside + outside)
            began = time.perf_counter()
            inside, outside = (middle, outside) if certified(middle, degree) else (inside, middle)
            step_s = time.perf_counter() - began
        best = inside
        progress(f"degree {degree}: certified up to {best:.8g}")
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


def _so_far(best: float, attempts: list[Attempt], seconds: float) -> Result:
    return Result(
        task="stability",
        status=Status.CERTIFIED,
        message=f"stopped; the best so far is {best:.8g}",
        limit=best,
        best=attempts[-1],
        attempts=tuple(attempts),
        seconds=seconds,
    )


def _looks_stable(problem: Callable[[float], Pde], parameter: float) -> bool:
    """Whether the discretisation is stable there: tells the stable end from the other."""
    return not discretise(problem(parameter), 15).grows()
