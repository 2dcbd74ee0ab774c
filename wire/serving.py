"""The main of a process that the launcher starts and configures by the first line of its standard input.

Plant, recorder and the benchmark's driver: what goes wrong is told in a status line, and the end leaves no
socket.
"""

from __future__ import annotations

import os
import sys
import traceback
from collections.abc import Callable
from typing import Protocol, TypeVar

from wire.child import Child, die_with_parent, name_process
from wire.config_json import loads
from wire.errors import ExitCode, OctarmError
from wire.limits import refusal
from wire.run_config import LinkConfig

USAGE = int(ExitCode.USAGE)


class Configuration(Protocol):
    """What every such process is told."""

    @property
    def links(self) -> LinkConfig:
        """Where it listens and whom it dials."""


C = TypeVar("C", bound=Configuration)


def serve_child(
    name: str,
    parent: int,
    kind: type[C],
    run: Callable[[C, Child], ExitCode],
    *,
    directory: str | None = None,
) -> int:
    """Read the configuration and run the process; returns the exit code.

    `name` is how the launcher calls it; `directory` the run's private one, where it is known before.
    """
    die_with_parent(parent)
    name_process(f"octarm-{name}")
    child = Child(name, control=0, status=1, directory=directory)
    child.install(reads_control=True)
    endpoints: list[str] = []
    try:
        config = loads(kind, child.configuration(), f"{name} configuration")
        child.directory = config.links.directory
        endpoints = list(config.links.listen)
        return int(run(config, child))
    except OctarmError as error:
        code = int(error.exit_code)
        child.status("failed", code="configuration", exit=code, message=str(error))
        return int(error.exit_code)
    except SystemExit:
        raise
    except BaseException as error:  # a panic of native code is no Exception
        if reason := refusal(error):
            child.status("failed", code="limit", exit=USAGE, message=f"{name}: {reason}")
            return USAGE
        traceback.print_exc()
        child.status("failed", code="internal", message=f"{name}: {error!r}")
        return int(ExitCode.INTERNAL)
    finally:
        child.leave(endpoints)
        if (
            child.orphaned
        ):  # nobody asks for the exit code, and a session may still be closing (wire.gate)
            sys.stderr.flush()
            os._exit(int(ExitCode.OK))
