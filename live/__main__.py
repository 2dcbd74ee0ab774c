"""`python -m live`: started by the launcher, configured by the first line of its standard input."""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import sys

from live.process import LiveProcess
from wire.run_config import LiveConfig
from wire.serving import serve_child

NICENESS = 10
"""As the recorder: telemetry can wait for a core. What makes the page steps back further, see live.process."""


def main() -> int:
    """Serve the page of one run; returns the exit code."""
    os.nice(NICENESS)
    parent = int(sys.argv[1]) if len(sys.argv) > 1 else os.getppid()
    return serve_child(
        "live", parent, LiveConfig, lambda config, child: LiveProcess(config, child).run()
    )


if __name__ == "__main__":
    sys.exit(main())
