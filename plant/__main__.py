"""`python -m plant`: started by the launcher, configured by the first line of its standard
input."""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import sys

from plant.process import PlantProcess
from wire.run_config import PlantConfig
from wire.serving import serve_child


def main() -> int:
    """Run the plant; returns the exit code."""
    parent = int(sys.argv[1]) if len(sys.argv) > 1 else os.getppid()
    return serve_child("plant", parent, PlantConfig, lambda c, child: PlantProcess(c, child).run())


if __name__ == "__main__":
    sys.exit(main())
