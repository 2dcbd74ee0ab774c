"""Many independent calls on several processors, for the studies; results in order, progress as they come."""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from typing import Any, TypeVar

from analysis.one_thread import one_thread_in_children

Result = TypeVar("Result")


def call_all(
    function: Callable[..., Result],
    arguments: Sequence[tuple[Any, ...]],
    jobs: int | None = None,
    done: Callable[[int], None] | None = None,
    *,
    fresh: bool = False,
) -> list[Result]:
    """`function(*a)` for each a; `jobs` processes at once, by default one a processor, 1 stays in this one.

    `fresh` gives every call a new process, also with one job: its peak of memory is the call's own.

    `done` is told how many calls are finished. An exception of a call ends all and is raised here.
    """
    jobs = min(jobs or len(os.sched_getaffinity(0)), len(arguments))
    if jobs <= 1 and not fresh:
        out = []
        for count, one in enumerate(arguments):
            out.append(function(*one))
            if done:
                done(count + 1)
        return out
    context = multiprocessing.get_context("spawn")
    calls = 1 if fresh else None
    with (
        one_thread_in_children(),
        ProcessPoolExecutor(max(1, jobs), context, max_tasks_per_child=calls) as pool,
    ):
        futures = [pool.submit(function, *one) for one in arguments]
        try:
            for count, future in enumerate(as_completed(futures)):
                future.result()
                if done:
                    done(count + 1)
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise
        return [future.result() for future in futures]
