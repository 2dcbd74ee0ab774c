"""What `octarm study` does: one of the studies on given gains; leaves facts as JSON and a plot.

Between the command line and `analysis.study`, whose modules each have run, table and, where a picture
makes sense, plot. A study says by its own parameters what may be chosen; anything else is refused here.
"""

from __future__ import annotations

import importlib
import inspect
import json
import os
import tempfile
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

from analysis.whole_directory import make_directory
from wire.artefact import read_artefact
from wire.config_json import finite
from wire.errors import UsageError

STUDIES = ("robustness", "baselines", "convergence", "growth")
Progress = Callable[[str], None]
Choices = Mapping[str, tuple[Any, ...] | None]
"""Per option what was given for it; None where nothing was."""


@dataclass(frozen=True)
class Study:
    """A finished study."""

    facts: dict[str, Any]
    """As --json prints them."""
    table: str
    files: tuple[Path, ...]
    """What was written."""


def run_study(
    name: str, gains: Path, choices: Choices, out: Path | None, progress: Progress, *, force: bool
) -> Study:
    """Run one of `STUDIES`; JSON and plot go to <out>/<name>.json and .png.

    Raises UsageError for a choice that the study does not offer or a file that cannot be written, and
    what `read_artefact` raises. Files appear whole or not at all, and no empty directory is left.
    """
    module = importlib.import_module(f"analysis.study.{name}")
    keywords = keywords_of(name, module.run, choices)
    made = out is not None and not out.exists()
    targets = _targets(name, module, out, force)
    try:
        found = module.run(read_artefact(gains), progress, **keywords)
        found = {"study": name, "gains": str(gains), **found}
        for target in targets:
            _write(target, module, found)
    except BaseException:
        if made and out is not None:
            with suppress(OSError):  # what is not empty stays
                out.rmdir()
        raise
    return Study(finite(found), module.table(found), targets)


def keywords_of(name: str, run: Callable[..., Any], choices: Choices) -> dict[str, Any]:
    """The choices as the study's own parameters: an option's name, its plural, or its name in seconds."""
    parameters = inspect.signature(run).parameters
    offered = {
        option: parameters[known]
        for option in choices
        for known in (option, f"{option}s", f"{option}_s")
        if known in parameters
    }
    keywords = {}
    for option, values in choices.items():
        if not values:
            continue
        if option not in offered:
            has = ", ".join(f"--{one}" for one in offered) or "none"
            raise UsageError(
                f"--{option}: the study of {name} does not offer this choice; it has {has}"
            )
        several = isinstance(offered[option].default, tuple | list)
        if len(values) > 1 and not several:
            raise UsageError(f"--{option}: the study of {name} takes one, got {len(values)}")
        if option == "jobs" and min(values) < 1:
            raise UsageError(f"--jobs: expected at least 1, got {min(values)}")
        keywords[offered[option].name] = values if several else values[0]
    return keywords


def _targets(name: str, module: ModuleType, out: Path | None, force: bool) -> tuple[Path, ...]:
    """Where JSON and plot go; refused before anything is computed."""
    if out is None:
        return ()
    kinds = ("json", "png") if hasattr(module, "plot") else ("json",)
    targets = tuple(out / f"{name}.{kind}" for kind in kinds)
    for target in targets:
        if target.exists() and not force:
            raise UsageError(
                f"--out {out}: {target.name} exists there already; give another directory or --force"
            )
    make_directory(out)
    return targets


def _write(target: Path, module: ModuleType, facts: dict[str, Any]) -> None:
    handle, name = tempfile.mkstemp(
        dir=target.parent, prefix=f".{target.stem}-", suffix=target.suffix
    )
    os.close(handle)
    growing = Path(name)
    try:
        if target.suffix == ".json":
            growing.write_text(json.dumps(finite(facts), indent=1, allow_nan=False) + "\n")
        else:
            module.plot(facts, growing)
        growing.chmod(0o644)
        growing.replace(target)
    except OSError as error:
        raise UsageError(f"--out {target.parent}: {error.strerror or error}") from None
    finally:
        with suppress(OSError):
            growing.unlink(missing_ok=True)
