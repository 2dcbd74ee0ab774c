"""`python -m node CONFIGURATION` starts one node by hand, on any machine; `python -m node --zygote` is what
the launcher uses."""

from __future__ import annotations

import os

os.environ.setdefault(
    "OPENBLAS_NUM_THREADS", "1"
)  # before numpy: its threads would fight for two cores

import argparse
import sys
from pathlib import Path

from node.process import NodeProcess
from wire.child import Child, name_process
from wire.config_json import loads
from wire.errors import ExitCode, OctarmError, UsageError
from wire.run_config import NodeConfig


def main() -> int:
    """Run one node, or the zygote; returns the exit code."""
    parser = argparse.ArgumentParser(prog="python -m node", description=__doc__)
    parser.add_argument(
        "configuration",
        nargs="?",
        help="JSON file written by the launcher; - for standard input",
    )
    parser.add_argument(
        "--zygote", action="store_true", help="serve the launcher on standard input"
    )
    parser.add_argument(
        "--remote", action="store_true", help="with --zygote: the launcher is on another machine"
    )
    parser.add_argument(
        "--directory", help="with --zygote: private directory to remove if the launcher dies"
    )
    parser.add_argument("--parent", type=int, default=os.getppid(), help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.zygote:
        from node.zygote import serve

        parent = None if arguments.remote else arguments.parent
        return serve(parent, directory=arguments.directory)
    if arguments.configuration is None:
        parser.error("give a configuration file or --zygote")
    try:
        return _by_hand(arguments.configuration)
    except OctarmError as error:
        print(f"node: {error}", file=sys.stderr)
        return int(error.exit_code)


def _by_hand(name: str) -> int:
    where = "configuration on standard input" if name == "-" else f"configuration {name}"
    try:
        text = sys.stdin.buffer.read() if name == "-" else Path(name).read_bytes()
    except OSError as error:
        raise UsageError(f"{where}: {error.strerror or error}") from None
    config = loads(NodeConfig, text, where)
    name_process(f"octarm-node{config.index}")
    child = Child(f"node {config.index}", control=-1, status=1, directory=None)
    child.install(reads_control=False)
    try:
        NodeProcess(config, child, supervised=False).run()
    finally:
        child.leave(list(config.links.listen))
    return int(ExitCode.OK)


if __name__ == "__main__":
    sys.exit(main())
