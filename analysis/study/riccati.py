"""H-infinity gains by python-control and slycot, in a process of its own: matrices to stdin, gains from stdout.

Called by `analysis.study.feedbacks`. The solvers are native code that can hang (python-control, issue 152), so
they get a time limit; nothing else imports these two packages.
"""

from __future__ import annotations

import importlib.util
import io
import os
import subprocess
import sys
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from wire.errors import OctarmError, UsageError

Array = npt.NDArray[np.float64]

PACKAGES = ("control", "slycot")
TIME_LIMIT_S = 120.0


@dataclass(frozen=True, eq=False)
class Problem:
    """x_t = A x + B1 w + B2 u, z = (C1 x, effort u), y = C2 x + noise w_y, all norms Euclidean."""

    A: Array
    B1: Array
    B2: Array
    C1: Array
    C2: Array
    effort: float
    noise: float


@dataclass(frozen=True, eq=False)
class Gains:
    """What the packages answered."""

    K: Array
    """(controls, states): u = K x of the Riccati equation at the gamma asked for."""
    A: Array
    B: Array
    C: Array
    """Of hinfsyn's controller x_t = A x + B y, u = C x."""
    gamma: float
    """What hinfsyn says that its loop has."""


def solve(problem: Problem, gamma: float, time_limit_s: float = TIME_LIMIT_S) -> Gains:
    """State feedback below `gamma` (`control.care`), and output feedback near the optimum (`control.hinfsyn`).

    The state feedback is not checked here: below the optimum the answer is a wrong gain, not an error.
    Raises UsageError if a package is missing, OctarmError if it fails or takes longer than the time limit.
    """
    missing = [name for name in PACKAGES if importlib.util.find_spec(name) is None]
    if missing:
        raise UsageError(
            f"baselines: not installed: {', '.join(missing)}; install the extra, in a checkout: "
            ".venv/bin/python -m pip install -c constraints.txt -e '.[baselines]'"
        )
    data = io.BytesIO()
    np.savez(data, gamma=gamma, **vars(problem))
    try:
        done = subprocess.run(
            [sys.executable, "-m", __name__],
            input=data.getvalue(),
            capture_output=True,
            timeout=time_limit_s,
            check=False,
            env={**os.environ, "OPENBLAS_NUM_THREADS": "1"},
        )
    except subprocess.TimeoutExpired:
        raise OctarmError(
            f"baselines: python-control did not answer within {time_limit_s:g} s and was ended"
        ) from None
    if done.returncode:
        last = done.stderr.decode(errors="replace").strip().splitlines()[-1:]
        raise OctarmError(f"baselines: python-control failed: {' '.join(last) or done.returncode}")
    answer = np.load(io.BytesIO(done.stdout))
    return Gains(answer["K"], answer["A"], answer["B"], answer["C"], float(answer["gamma"]))


def _answer() -> None:
    """The child: read the problem, answer, exit."""
    import control  # the packages of the extra are imported here only

    given = np.load(io.BytesIO(sys.stdin.buffer.read()))
    A, B1, B2, C1, C2 = (given[key] for key in ("A", "B1", "B2", "C1", "C2"))
    effort, noise, gamma = (float(given[key]) for key in ("effort", "noise", "gamma"))
    disturbances, controls, outputs = B1.shape[1], B2.shape[1], len(C2)
    # game Riccati equation: A'X + XA + C1'C1 - X (B2 B2'/effort^2 - B1 B1'/gamma^2) X = 0
    weight = np.diag([-(gamma**2)] * disturbances + [effort**2] * controls)
    X, _, _ = control.care(A, np.hstack([B1, B2]), C1.T @ C1, weight, method="slycot")
    regulated = len(C1) + controls
    plant = control.ss(
        A,
        np.hstack([B1, np.zeros((len(A), outputs)), B2]),
        np.vstack([C1, np.zeros((controls, len(A))), C2]),
        np.block(
            [
                [
                    np.zeros((regulated, disturbances + outputs)),
                    np.vstack([np.zeros((len(C1), controls)), effort * np.eye(controls)]),
                ],
                [
                    np.zeros((outputs, disturbances)),
                    noise * np.eye(outputs),
                    np.zeros((outputs, controls)),
                ],
            ]
        ),
    )
    found, _, reached, _ = control.hinfsyn(plant, outputs, controls)
    data = io.BytesIO()
    np.savez(data, K=-B2.T @ X / effort**2, A=found.A, B=found.B, C=found.C, gamma=reached)
    sys.stdout.buffer.write(data.getvalue())


if __name__ == "__main__":
    _answer()
