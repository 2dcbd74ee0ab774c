"""`python -m recorder`: started by the launcher, configured by the first line of its standard
input."""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import sys

from recorder.process import RecorderProcess
from wire.run_config import RecorderConfig
from wire.serving import serve_child

NICENESS = 10
"""Records can wait for a core, the sums cannot."""


def main() -> int:
    """Run the recorder; returns the exit code."""
    os.nice(NICENESS)
    parent = int(sys.argv[1]) if len(sys.argv) > 1 else os.getppid()
    return serve_child(
        "recorder", parent, RecorderConfig, lambda c, child: RecorderProcess(c, child).run()
    )


if __name__ == "__main__":
    sys.exit(main())
