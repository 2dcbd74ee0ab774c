"""`python -m plant`: started by the launcher, configured by the first line of its standard
input."""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import sys
import traceback

from plant.process import PlantProcess
from wire.child import Child, die_with_parent, name_process
from wire.errors import ExitCode, OctarmError
from wire.run_config import PlantConfig, loads


def main() -> int:
    """Run the plant; returns the exit code."""
    die_with_parent(int(sys.argv[1]) if len(sys.argv) > 1 else os.getppid())
    name_process("octarm-plant")
    child = Child("plant", control=0, status=1, directory=None)
    child.install(reads_control=True)
    endpoints: list[str] = []
    try:
        config = loads(PlantConfig, child.configuration(), "plant configuration")
        child.directory = config.links.directory
        endpoints = list(config.links.listen)
        return int(PlantProcess(config, child).run())
    except OctarmError as error:
        child.status("failed", code="configuration", message=str(error))
        return int(error.exit_code)
    except Exception as error:
        traceback.print_exc()
        child.status("failed", code="internal", message=f"plant: {error!r}")
        return int(ExitCode.INTERNAL)
    finally:
        child.leave(endpoints)


if __name__ == "__main__":
    sys.exit(main())
