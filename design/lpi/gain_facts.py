"""A gain as plain data, in the units of the problem file: what `octarm solve --json` hands to the user.

With sigma = (s - a) / (b - a) for the file's domain [a, b], all polynomials are coefficients of the Legendre
polynomials P_i(2 sigma - 1). A gain maps (numbers, functions) to (numbers, functions) by

    finite x + int q(s) y(s) ds,    profile(s) x + multiplier(s) y(s) + int_a^s below(s, t) y(t) dt
                                        + int_s^b above(s, t) y(t) dt.
"""

from __future__ import annotations

import math
from typing import Any

from design import legendre
from design.legendre import Array
from design.lpi.gains import Gain
from design.operators import PIOperator
from design.pde.model import Output, Pde, Signal


def gain_facts(gain: Gain, pde: Pde) -> dict[str, Any]:
    """Names of what goes in and comes out, and the coefficients; the layout is in the module's docstring.

    The model lives on [0, 1] with distributed signals scaled to keep their norms; both are undone here.
    """
    length = pde.domain[1] - pde.domain[0]
    root = math.sqrt(length)
    states = (
        [s.name for s in pde.states if s.order is None],
        [s.name for s in pde.states if s.order is not None],
    )
    if gain.role == "observer":
        into, out = _names(pde.measured), states
        scale_in, scale_out = root, 1.0  # a distributed y is sqrt(length) times the user's
    else:
        into, out = states, _names(pde.controls)
        scale_in, scale_out = 1.0, 1.0 / root  # a distributed u is the model's over sqrt(length)
    operator = gain.operator
    return {
        "role": gain.role,
        "acts_on": "state" if gain.fundamental is None else "highest derivatives",
        "basis": "Legendre polynomials P_i(2 sigma - 1), sigma = (s - a) / (b - a)",
        "domain": list(pde.domain),
        "from": {"numbers": into[0], "functions": into[1]},
        "to": {"numbers": out[0], "functions": out[1]},
        "finite": operator.p.tolist(),
        "integrals": _plain(operator.q1 * (scale_in / length)),
        "profiles": _plain(operator.q2 * scale_out),
        "multiplier": _plain(operator.r0 * (scale_in * scale_out)),
        "below": _plain_kernel(operator.r1 * (scale_in * scale_out / length)),
        "above": _plain_kernel(operator.r2 * (scale_in * scale_out / length)),
        "norm": _norm(operator),
        "fit_tail": gain.tail,
    }


def _names(signals: tuple[Output, ...] | tuple[Signal, ...]) -> tuple[list[str], list[str]]:
    def name(signal: Output | Signal) -> str:
        return signal.expression.text if isinstance(signal, Output) else signal.name

    numbers = [name(s) for s in signals if not s.distributed]
    return numbers, [name(s) for s in signals if s.distributed]


def _plain(coefficients: Array) -> list[Any]:
    return list(legendre.to_plain(legendre.trim(coefficients, (2,))).tolist())


def _plain_kernel(kernel: Array) -> list[Any]:
    both = legendre.to_plain(legendre.to_plain(kernel).swapaxes(2, 3)).swapaxes(2, 3)
    return list(both.tolist())


def _norm(operator: PIOperator) -> float:
    """Hilbert-Schmidt, kernels halved; on [0, 1]."""
    arrays = (operator.p, operator.q1, operator.q2, operator.r0)
    squares = sum(float((a**2).sum()) for a in arrays)
    squares += 0.5 * float((operator.r1**2).sum() + (operator.r2**2).sum())
    return math.sqrt(squares)
