"""The same quantity on matrices that share no code with the LPI: what stands beside every certified number."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from scipy import linalg

from design.channel import Channel
from design.lpi.gains import Gain
from design.lpi.result import Achieved
from design.pde.evidence import (
    Refined,
    controller_optimum,
    feedback_loop,
    observer_loop,
    observer_optimum,
    refine,
)
from design.pde.galerkin import System, discretise, norm_ratio
from design.pde.model import Pde

TOLERANCE = 1e-6
"""Relative agreement of the last two sizes."""
_OPTIMUM_SIZE = 23


class Verification:
    """Discretisations of one PDE, made once and kept."""

    def __init__(self, pde: Pde, seconds: float = 60.0) -> None:
        self.pde = pde
        self.seconds = seconds
        self._systems: dict[int, System] = {}
        self._optima: dict[tuple[str, int], float | None] = {}

    def system(self, size: int) -> System:
        """The matrices of this size. Raises ValueError if the PDE cannot be discretised."""
        if size not in self._systems:
            self._systems[size] = discretise(self.pde, size)
        return self._systems[size]

    def abscissa(self) -> float:
        """Largest real part of the eigenvalues at the optimum's size."""
        return self.system(_OPTIMUM_SIZE).abscissa()

    def unstable(self) -> bool:
        """Whether two sizes agree that a resolved mode grows."""
        pair = [self.system(size) for size in (15, _OPTIMUM_SIZE)]
        return all(s.grows() and not s.undecided() for s in pair)

    def slowest_rate(self) -> float:
        """A rate of the slow dynamics: the decay, or a tenth of the smallest eigenvalue if that is larger."""
        values = self.system(15).eigenvalues
        magnitudes = [float(abs(v)) for v in values if abs(v) > 1e-9]
        return max(-float(values.real.max()), 0.1 * min(magnitudes, default=1.0), 1e-6)

    def open_loop(self) -> Achieved:
        """The H-infinity norm without any gain."""
        return _achieved(self._refined(lambda s: s.gain()))

    def norm(self) -> Achieved:
        """The largest quotient |numerator| / |denominator|."""
        return _achieved(refine(lambda n: norm_ratio(self.pde, n), tolerance=TOLERANCE))

    def loop(self, gain: Gain) -> Achieved:
        """The H-infinity norm with the gain, beside that without and the best that any gain could reach."""

        def norm(system: System) -> float:
            operator = gain.operator
            if gain.role == "observer":
                return observer_loop(
                    system, operator.discretise(system.size, system.rows)
                ).hinf_norm()
            if gain.fundamental is None:
                K = operator.discretise(system.rows, system.size)
            else:  # the f that belongs to the discretised x
                to_state = gain.fundamental.discretise(system.size, system.rows)
                K = operator.discretise(system.size) @ np.linalg.pinv(to_state)
            return feedback_loop(system, K).hinf_norm()

        return _achieved(
            self._refined(norm), self.system(_OPTIMUM_SIZE).gain(), self.optimum(gain.role)
        )

    def h2(self, gain: Gain | None = None) -> Achieved:
        """The H2 norm of the open loop or of the observer's error; beside it the Kalman filter's."""

        def norm(system: System) -> float:
            if gain is None:
                return _h2(Channel(system.A, system.B1, system.C1, system.D11))
            L = gain.operator.discretise(system.size, system.rows)
            return _h2(observer_loop(system, L))

        if gain is None:
            return _achieved(self._refined(norm))
        system = self.system(_OPTIMUM_SIZE)
        without = _h2(Channel(system.A, system.B1, system.C1, system.D11))
        return _achieved(self._refined(norm), without, self.kalman())

    def kalman(self) -> float | None:
        """The smallest H2 norm of any observer, None where the noise is singular or nothing stabilises."""
        s = self.system(_OPTIMUM_SIZE)
        try:
            X = linalg.solve_continuous_are(
                s.A.T, s.C2.T, s.B1 @ s.B1.T, s.D21 @ s.D21.T, s=s.B1 @ s.D21.T
            )
        except (linalg.LinAlgError, ValueError):
            return None
        value = float(np.trace(s.C1 @ X @ s.C1.T))
        return math.sqrt(value) if value > 0.0 else None

    def optimum(self, role: str, size: int = _OPTIMUM_SIZE) -> float | None:
        """The infimum of gamma over all gains, infinite if none helps; None where no Riccati equation says."""
        of = observer_optimum if role == "observer" else controller_optimum
        if (role, size) not in self._optima:
            self._optima[role, size] = of(self.system(size)).value
        return self._optima[role, size]

    def _refined(self, figure: Callable[[System], float]) -> Refined:
        return refine(lambda n: figure(self.system(n)), tolerance=TOLERANCE, seconds=self.seconds)


def _h2(channel: Channel) -> float:
    """tr(C X C*)^(1/2) with A X + X A* + B B* = 0; infinite unless all modes decay."""
    if channel.decay() <= 0.0:
        return math.inf
    X = linalg.solve_continuous_lyapunov(channel.A, -channel.B @ channel.B.T)
    return math.sqrt(max(float(np.trace(channel.C @ X @ channel.C.T)), 0.0))


def _achieved(
    refined: Refined, open_loop: float | None = None, optimum: float | None = None
) -> Achieved:
    return Achieved(
        value=refined.value,
        by_size=tuple(zip(refined.sizes, refined.values, strict=True)),
        converged=refined.converged and math.isfinite(refined.value),
        open_loop=open_loop,
        optimum=optimum,
    )
