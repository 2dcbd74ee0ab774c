"""The errors that a user can cause, each with the exit code of the command line that reports it.

Every message says what was expected, what came, where, and what to do about it.
"""

from __future__ import annotations

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
