"""`python -m recorder`: started by the launcher, configured by the first line of its standard
input."""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import sys

from recorder.process import RecorderProcess
from wire.child import Child
from wire.errors import ExitCode, OctarmError
from wire.run_config import RecorderConfig
from wire.serving import serve_child

NICENESS = 10
"""Records can wait for a core, the sums cannot."""


def main() -> int:
    """Run the recorder; returns the exit code."""
    os.nice(NICENESS)
    parent = int(sys.argv[1]) if len(sys.argv) > 1 else os.getppid()
    return serve_child("recorder", parent, RecorderConfig, _record)


def _record(config: RecorderConfig, child: Child) -> ExitCode:
    try:
        return RecorderProcess(config, child).run()
    except OSError as error:  # a full disk, say: no fault of the program
        raise OctarmError(f"recording: {error}") from None


if __name__ == "__main__":
    sys.exit(main())
