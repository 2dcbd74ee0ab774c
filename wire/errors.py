"""The errors that a user can cause, each with the exit code of the command line that reports it.

Every message says what was expected, what came, where, and what to do about it.
"""

from __future__ import annotations

import reprlib
from collections.abc import Iterator
from contextlib import contextmanager
from enum import IntEnum


class ExitCode(IntEnum):
    """Exit codes of every verb (README, "Exit codes")."""

    OK = 0
    INTERNAL = 1
    USAGE = 2
    DEGRADED = 3
    SAFETY_STOP = 4
    START_UP_TIMEOUT = 5
    GAINS_REFUSED = 6
    INTERRUPTED = 130


class OctarmError(Exception):
    """Base of every error that is reported as one message without a traceback."""

    exit_code: ExitCode = ExitCode.INTERNAL


class UsageError(OctarmError):
    """A wrong argument, configuration value or input file."""

    exit_code = ExitCode.USAGE


class GainsRefusedError(OctarmError):
    """A gains artefact that is damaged, of an unknown version, or not certified for this use."""

    exit_code = ExitCode.GAINS_REFUSED


class StartUpTimeoutError(OctarmError):
    """Some process or link was not there in time; the message names which."""

    exit_code = ExitCode.START_UP_TIMEOUT


class StartUpFailedError(OctarmError):
    """Some process gave up, or died, before the first tick; the message names which."""

    def __init__(self, message: str, exit_code: ExitCode) -> None:
        super().__init__(message)
        self.exit_code = exit_code


@contextmanager
def about(what: str) -> Iterator[None]:
    """Put what it is about before the message of an error from inside: a file, for whoever does not know it."""
    try:
        yield
    except OctarmError as error:
        error.args = (f"{what}: {error}", *error.args[1:])
        raise


def shown(value: object) -> str:
    """A value from outside for a message, short: a text of megabytes, a number of a million digits, and what is
    nested more deeply than Python's stack, which its own `repr` would follow down."""
    if type(value) is int and value.bit_length() > 64:
        return f"a whole number of {value.bit_length()} bits"
    return str(value) if type(value) is int else reprlib.repr(value)
