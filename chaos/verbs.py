"""The verb of the command line that injects faults.

Part of launcher.py in a file of its own; what it does lives in the other modules of this room.
"""

from __future__ import annotations

import sys
from pathlib import Path

import tyro

from supervise.entry import show_json, teller

Flag = tyro.conf.FlagCreatePairsOff[bool]


def chaos(
    *,
    seed: int = 1,
    minutes: float = 5.0,
    faults: int | None = None,
    only: int | None = None,
    out: Path | None = None,
    json: Flag = False,
    quiet: Flag = False,
) -> int:
    """Inject random faults into random real runs and check what must hold. Exit code 3 if it did not.

    Args:
        seed: Of what is drawn: the same seed gives the same runs and the same plan of faults.
        minutes: So long new runs are started, two at a time.
        faults: Or until so many faults were injected, whichever comes first.
        only: Number of the one case to do; everything about it is kept.
        out: Directory for the cases that went wrong, made if missing; default runs/chaos-<seed>-<date>.
        json: Print one JSON object instead of the table.
        quiet: No progress.
    """
    from chaos.campaign import ChaosOptions, run_chaos

    options = ChaosOptions(seed, minutes, faults, only, out)
    done = run_chaos(options, teller(silent=quiet or json))
    show_json(done.facts) if json else print(done.table, end="")
    if done.message:
        print(f"octarm chaos: {done.message}", file=sys.stderr)
    return int(done.exit_code)
