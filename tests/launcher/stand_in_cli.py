"""The command line with a stand-in for the LPI engine, named by OCTARM_STAND_IN; not collected by pytest.

The engine's process imports its parent's script, so the stand-in is there as well. The name "gains" stands for
the jobs of `octarm design`.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from stand_in_engine import STAND_INS

import launcher
from design import solve_command
from design.lpi.reporter import Reporter
from design.lpi.result import Result
from design.solve_command import Request

_NAME = os.environ["OCTARM_STAND_IN"]


def answer(request: Request, reporter: Reporter | None = None) -> Result:
    return STAND_INS[_NAME](request, reporter or Reporter())


solve_command.answer = answer
if _NAME == "gains":
    from stand_in_gains import well

    from design import gain

    gain.design_gain = well

if __name__ == "__main__":
    launcher.main()
