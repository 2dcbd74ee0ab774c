"""The benchmark from options to files: campaign, targets, comparison, JSON, table, picture.

Between the command line and `bench.campaign`. Whatever ends it, what was finished is written.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from platform import python_version
from typing import Any

from bench.campaign import Campaign
from bench.group import Signals
from bench.options import BenchOptions
from bench.picture import draw
from bench.results import FORMAT, read_results, write_results
from bench.statistics import ratios, targets
from bench.table import table
from supervise.origin import machine_facts, versions
from supervise.own_directory import claim, tidy
from wire.errors import ExitCode, OctarmError

RESULTS = "bench.json"
PICTURE = "bench.png"
LOG = "processes.log"


@dataclass(frozen=True)
class Bench:
    """A benchmark that came to its end, or as far as it came."""

    facts: dict[str, Any]
    """As in the JSON file."""
    table: str
    files: tuple[Path, ...]
    exit_code: ExitCode
    message: str
    """Why it ended early; empty if it did not."""


def run_bench(options: BenchOptions, progress: Callable[[str], None]) -> Bench:
    """Run the benchmark; files go to the output directory.

    Raises UsageError before anything is started, and what ended it if nothing was finished by then.
    """
    old = None if options.compare is None else read_results(options.compare)
    date = time.strftime("%Y-%m-%dT%H:%M:%S%z")
    directory = options.out or Path("runs") / time.strftime("bench-%Y%m%d-%H%M%S")
    made = claim(directory, LOG)
    ended: BaseException | None = None
    try:
        with (directory / LOG).open("wb") as log, Signals() as signals:
            campaign = Campaign(options, log, signals, progress)
            try:
                campaign.run()
            except BaseException as error:
                ended = error
            if not campaign.rows and ended is not None:
                raise ended
            facts = _facts(campaign, options, date, ended, old)
            files = (directory / RESULTS, directory / PICTURE)
            write_results(facts, files[0])
            draw(facts, files[1])
        if ended is not None and not isinstance(ended, KeyboardInterrupt | OctarmError):
            raise ended
    finally:
        tidy(directory, LOG, made=made)
    code, message = _ending(ended)
    return Bench(facts, table(facts), files, code, message)


def _facts(
    campaign: Campaign,
    options: BenchOptions,
    date: str,
    ended: BaseException | None,
    old: dict[str, Any] | None,
) -> dict[str, Any]:
    facts: dict[str, Any] = {
        "format": FORMAT,
        "date": date,
        "seed": options.seed,
        "options": options.facts(),
        "machine": {**machine_facts(), "python": python_version(), "versions": versions()},
        "ended": "finished" if ended is None else _ending(ended)[1],
        "notes": campaign.notes,
        "rows": campaign.rows,
        "rates": campaign.rates,
        "targets": [t.facts() for t in targets(campaign.rows, campaign.rates)],
        "compared_with": None,
        "ratios": [],
    }
    if old is not None:
        facts["compared_with"] = {"file": str(options.compare), "date": old["date"]}
        facts["ratios"] = ratios(facts, old)
    return facts


def _ending(error: BaseException | None) -> tuple[ExitCode, str]:
    if error is None:
        return ExitCode.OK, ""
    if isinstance(error, OctarmError):
        return error.exit_code, str(error)
    if isinstance(error, KeyboardInterrupt):
        return ExitCode.INTERRUPTED, "interrupted"
    return ExitCode.INTERNAL, f"internal error: {error!r}"
