"""`python -m recorder`: started by the launcher, configured by the first line of its standard
input."""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import sys
import traceback

from recorder.process import RecorderProcess
from wire.child import Child, die_with_parent, name_process
from wire.errors import ExitCode, OctarmError
from wire.run_config import RecorderConfig, loads

NICENESS = 10
"""Records can wait for a core, the sums cannot."""


def main() -> int:
    """Run the recorder; returns the exit code."""
    die_with_parent(int(sys.argv[1]) if len(sys.argv) > 1 else os.getppid())
    name_process("octarm-recorder")
    os.nice(NICENESS)
    child = Child("recorder", control=0, status=1, directory=None)
    child.install(reads_control=True)
    try:
        config = loads(RecorderConfig, child.configuration(), "recorder configuration")
        child.directory = config.links.directory
        return int(RecorderProcess(config, child).run())
    except OctarmError as error:
        child.status("failed", code="configuration", message=str(error))
        return int(error.exit_code)
    except OSError as error:
        child.status("failed", code="recording", message=f"recording: {error}")
        return int(ExitCode.INTERNAL)
    except Exception as error:
        traceback.print_exc()
        child.status("failed", code="internal", message=f"recorder: {error!r}")
        return int(ExitCode.INTERNAL)
    finally:
        child.leave([])


if __name__ == "__main__":
    sys.exit(main())
