"""`python -m bench --zygote` and `--driver`: the two processes that a group's launcher starts."""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import argparse
import sys

from wire.serving import serve_child


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

    return serve_child(
        "driver", parent, DriverConfig, lambda c, child: Driver(c, child).run(), directory=directory
    )


if __name__ == "__main__":
    sys.exit(main())
