"""The frame of the command line: picks the verb, turns what it raises into messages and exit codes.

Between launcher.py, whose verbs say what is done, and the shell. Results go to standard output
(with --json nothing but one JSON object), everything else to standard error.
"""

from __future__ import annotations

import errno
import json
import os
import signal
import sys
import tempfile
import threading
import traceback
from collections.abc import Callable, Mapping
from typing import Any, NoReturn

import tyro

from wire.errors import ExitCode, OctarmError
from wire.limits import files_exhausted, refusal

AGAIN_S = 0.01
_decided: list[tuple[ExitCode, str]] = []
"""See `decide`: one at most."""


def serve(verbs: Mapping[str, Callable[..., int]], prog: str, description: str) -> NoReturn:
    """Run the verb that the command line names; ends the process with its exit code."""
    _decided.clear()
    before, sys.unraisablehook = sys.unraisablehook, _again_if_interrupted
    try:
        code = _serve(verbs, prog, description)
    finally:
        sys.unraisablehook = before
    # What is decided stays decided while Python clears up.
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)
    sys.exit(code)


def _serve(verbs: Mapping[str, Callable[..., int]], prog: str, description: str) -> int:
    signal.signal(signal.SIGTERM, _interrupt)
    if signal.getsignal(signal.SIGINT) is signal.SIG_DFL:  # see launcher.py
        signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        code: int = tyro.extras.subcommand_cli_from_dict(
            dict(verbs), prog=prog, description=description
        )
    except OctarmError as error:
        print(f"{prog}: {error}", file=sys.stderr)
        code = int(error.exit_code)
    except KeyboardInterrupt:
        decided, text = _decided.pop() if _decided else (ExitCode.INTERRUPTED, "interrupted")
        print(f"{prog}: {text}", file=sys.stderr)
        code = int(decided)
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)  # nobody reads the output any more
        code = int(ExitCode.OK)
    except Exception as error:
        if isinstance(error, OSError) and error.errno == errno.ENAMETOOLONG:
            print(f"{prog}: {error.filename}: {error.strerror}", file=sys.stderr)
            sys.exit(int(ExitCode.USAGE))  # only what the user typed can be so long
        if reason := refusal(error) or refusal(files_exhausted() or error):
            print(f"{prog}: {reason}", file=sys.stderr)
            sys.exit(int(ExitCode.USAGE))
        code = int(ExitCode.INTERNAL)
        print(f"{prog}: internal error: {error!r}; {_save_traceback()}", file=sys.stderr)
    return code


def _again_if_interrupted(what: sys.UnraisableHookArgs) -> None:
    """Ctrl-C while Python takes an object apart is printed and forgotten by it: it has to come again."""
    if issubclass(what.exc_type, KeyboardInterrupt):
        threading.Timer(AGAIN_S, os.kill, (os.getpid(), signal.SIGINT)).start()
    else:
        sys.__unraisablehook__(what)


def decide(code: ExitCode, text: str) -> None:
    """Exit code and message of this process if it is interrupted from now on: a graver end has come before."""
    _decided[:] = [(code, text)]


def show_json(value: Mapping[str, Any]) -> None:
    """Print the one JSON object of --json; ValueError for a number that is not finite."""
    print(json.dumps(value, allow_nan=False))


def teller(*, silent: bool) -> Callable[[str], None]:
    """Where a verb's progress goes: a line on standard error each, or nowhere."""

    def tell(text: str) -> None:
        if not silent:
            print(text, file=sys.stderr, flush=True)

    return tell


def _interrupt(*_: object) -> NoReturn:
    raise KeyboardInterrupt


def _save_traceback() -> str:
    try:
        with tempfile.NamedTemporaryFile(
            "w", prefix="octarm-error-", suffix=".txt", delete=False
        ) as file:
            traceback.print_exc(file=file)
    except OSError:
        return "its traceback could not be saved"
    return f"the traceback is in {file.name}"
