"""`python -m bench --zygote` and `--driver`: the two processes that a group's launcher starts."""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import argparse
import sys
import traceback

from wire.child import Child, die_with_parent, name_process
from wire.errors import ExitCode, OctarmError
from wire.run_config import loads


def main() -> int:
    """Serve the launcher on standard input; returns the exit code."""
    parser = argparse.ArgumentParser(prog="python -m bench", description=__doc__)
    what = parser.add_mutually_exclusive_group(required=True)
    what.add_argument("--zygote", action="store_true", help="fork a worker a line")
    what.add_argument("--driver", action="store_true", help="drive a group, configured by a line")
    parser.add_argument("--directory", help="the group's private directory")
    parser.add_argument("--parent", type=int, default=os.getppid(), help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.zygote:
        from bench.zygote import serve

        return serve(arguments.parent, arguments.directory)
    return _drive(arguments.parent, arguments.directory)


def _drive(parent: int, directory: str | None) -> int:
    from bench.configs import DriverConfig
    from bench.driver import Driver

    die_with_parent(parent)
    name_process("octarm-driver")
    child = Child("driver", control=0, status=1, directory=directory)
    child.install(reads_control=True)
    endpoints: list[str] = []
    try:
        config = loads(DriverConfig, child.configuration(), "driver configuration")
        endpoints = list(config.links.listen)
        return int(Driver(config, child).run())
    except OctarmError as error:
        child.status("failed", code="configuration", message=str(error))
        return int(error.exit_code)
    except Exception as error:
        traceback.print_exc()
        child.status("failed", code="internal", message=f"driver: {error!r}")
        return int(ExitCode.INTERNAL)
    finally:
        child.leave(endpoints)


if __name__ == "__main__":
    sys.exit(main())
