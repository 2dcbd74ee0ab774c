"""Linear algebra on one thread: the same digits on one machine, however many processors it has.

A BLAS with several threads splits its sums among them, so the last digits of what it returns depend on how many
there are. What is to be the same bytes every time is computed within `one_thread`, or in a process that was
started within `one_thread_in_children`. Matrices of this project are so small that it costs no time.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager

import threadpoolctl

_VARIABLES = (
    "OPENBLAS_NUM_THREADS",
    "OMP_NUM_THREADS",
    "MKL_NUM_THREADS",
    "RAYON_NUM_THREADS",
)
"""Read by a library when it is loaded; the last one by solvers in Rust (Clarabel), at their first use."""


@contextmanager
def one_thread() -> Iterator[None]:
    """Hold this process and those it starts meanwhile to one thread, whatever the user has set.

    Libraries that are loaded already are told so and told otherwise at the end; one that is loaded meanwhile
    reads the environment, and keeps to one thread until the process ends.
    """
    with one_thread_in_children(), threadpoolctl.threadpool_limits(1):
        yield


@contextmanager
def one_thread_in_children() -> Iterator[None]:
    """Hold the processes started meanwhile to one thread, whatever the user has set, by their environment."""
    before = {name: os.environ.get(name) for name in _VARIABLES}
    os.environ.update(dict.fromkeys(_VARIABLES, "1"))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value
