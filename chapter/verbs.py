"""The verb of the command line that reproduces the source chapter.

Part of launcher.py in a file of its own; what it does lives in the other modules of this room.
"""

from __future__ import annotations

from pathlib import Path

import tyro

from supervise.entry import show_json, teller

Flag = tyro.conf.FlagCreatePairsOff[bool]
PartNames = tyro.conf.Positional[tuple[str, ...]]


def chapter(
    parts: PartNames = (),
    /,
    *,
    out: Path = Path("runs/chapter"),
    json: Flag = False,
    quiet: Flag = False,
) -> int:
    """Make the source chapter's tables and figures: printed form, corrected form, and how they were checked.

    Args:
        parts: Which, in any order: model, setpoints, operators, ode, lpi, inverse, decentral,
            observer. Default all.
        out: Directory for the pages, figures and facts.json, made if missing; pages of other parts in it stay.
        json: Print one JSON object instead of the table.
        quiet: No progress.
    """
    from chapter.command import reproduce

    made = reproduce(parts, out, teller(silent=quiet or json))
    if json:
        show_json(made.facts)
    else:
        print(made.table, end="")
        print("\n".join(map(str, made.files)))
    return 0
