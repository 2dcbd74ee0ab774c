"""How many threads linear algebra has, asked of the libraries, here and in a process that is started."""

from __future__ import annotations

import subprocess
import sys

import pytest
import scipy.linalg  # noqa: F401 (a BLAS of its own beside NumPy's)
from threadpoolctl import threadpool_info, threadpool_limits

from analysis.one_thread import one_thread, one_thread_in_children

ASK = "import scipy.linalg, threadpoolctl as t; print(*{p['num_threads'] for p in t.threadpool_info()})"


def here() -> int:
    """Of the library that has most: another test may have loaded one that is built for a single thread."""
    pools = threadpool_info()
    assert len(pools) >= 2
    return max(int(pool["num_threads"]) for pool in pools)


def in_a_child() -> str:
    done = subprocess.run([sys.executable, "-c", ASK], capture_output=True, text=True, check=True)
    return done.stdout.strip()


def test_one_thread_whatever_was_set_and_afterwards_as_before(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("OPENBLAS_NUM_THREADS", "2")
    monkeypatch.delenv("MKL_NUM_THREADS", raising=False)
    with threadpool_limits(2):
        assert (here(), in_a_child()) == (2, "2")
        with one_thread():
            assert (here(), in_a_child()) == (1, "1")
        assert (here(), in_a_child()) == (2, "2")
        with one_thread_in_children():
            assert (here(), in_a_child()) == (2, "1")
        with pytest.raises(ZeroDivisionError), one_thread():
            _ = 1 / 0
        assert (here(), in_a_child()) == (2, "2")
