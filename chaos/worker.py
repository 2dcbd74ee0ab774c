"""A process that does one case after another: `python -m chaos.worker PARENT`, started by `chaos.campaign`.

Orders come as JSON lines on standard input, results go out as status lines (wire.child). When the campaign ends
or dies, however, this process breaks its case off, ends the run and leaves.
"""

from __future__ import annotations

import json
import sys
from dataclasses import asdict
from pathlib import Path
from typing import Any

from chaos.case import run_case
from chaos.draw import draw_case
from chaos.trial import BrokenOffError
from wire.child import Child, die_with_parent, name_process
from wire.errors import OctarmError


def serve(parent: int) -> None:
    """Do what is ordered until the campaign says stop or is gone."""
    die_with_parent(parent)
    name_process("octarm-chaos")
    child = Child("worker", control=0, status=1, directory=None)
    child.install(reads_control=True)
    child.status("up")
    waiting: list[bytes] = []

    def broken_off() -> bool:
        waiting.extend(child.wait_lines(0.0))
        return child.stopping

    while not child.stopping:
        waiting += child.wait_lines(None)
        while waiting and not child.stopping:
            order: dict[str, Any] = json.loads(waiting.pop(0))
            case = draw_case(order["seed"], order["number"])
            try:
                result = run_case(
                    case, Path(order["out"]), keep=order["keep"], broken_off=broken_off
                )
            except BrokenOffError:
                return
            except (OSError, OctarmError) as error:
                child.status("failed", message=f"case {case.number}: {error}")
                return
            _tell(child, asdict(result))


def _tell(child: Child, result: dict[str, Any]) -> None:
    """A result may be longer than a status line: in pieces, one field each."""
    for name in ("hits", "wrong"):
        for item in result.pop(name):
            child.status("part", of=name, item=item)
    child.status("done", result=result)


if __name__ == "__main__":
    serve(int(sys.argv[1]))
