"""The keys and types of a problem file, and the messages for TOML that does not fit; used by `problem_file`."""

from __future__ import annotations

import re
import tomllib
from typing import Any

import msgspec

from design.pde.names import suggestion
from wire.errors import UsageError


class _Section(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    pass


class Inputs(_Section, frozen=True):
    """ "w" is a number, "w(s)" a function of s."""

    disturbances: list[str] = []
    controls: list[str] = []


class Boundary(_Section, frozen=True):
    """Each condition is an expression that is zero, or "left = right"."""

    conditions: list[str] = []


class Outputs(_Section, frozen=True):
    """Expressions; those that depend on s are functions of s."""

    regulated: list[str] = []
    measured: list[str] = []


class Norm(_Section, frozen=True):
    """Expressions in the states: the least c with |of| <= c |by|."""

    of: list[str]
    by: list[str]


class ProblemFile(_Section, frozen=True):
    """states: order or "ode"; equations: right-hand side of the derivative in time, by state."""

    states: dict[str, int | str]
    name: str = ""
    description: str = ""
    domain: tuple[float, float] = (0.0, 1.0)
    parameters: dict[str, float] = {}
    task: str | None = None
    bisect: tuple[str, float, float] | None = None
    inputs: Inputs = Inputs()
    equations: dict[str, str] | None = None
    boundary: Boundary = Boundary()
    outputs: Outputs = Outputs()
    norm: Norm | None = None


_SECTIONS: dict[str, type[_Section]] = {
    "": ProblemFile,
    "inputs": Inputs,
    "boundary": Boundary,
    "outputs": Outputs,
    "norm": Norm,
}
_ENTRIES: dict[str, Any] = {"states": int | str, "parameters": float, "equations": str}
"""Types in the free tables, whose keys msgspec does not name."""


def decode(text: str, where: str) -> ProblemFile:
    """The text as typed data; UsageError, opened by `where`, for keys and types that do not fit."""
    try:
        data: dict[str, Any] = tomllib.loads(text)
    except (ValueError, RecursionError) as error:
        hint = (
            "; expressions and names are written in quotes" if "Invalid value" in str(error) else ""
        )
        raise UsageError(f"{where}: this is not TOML: {error}{hint}") from None
    for section, kind in _ENTRIES.items():
        entries = data.get(section, {})
        for key, entry in entries.items() if isinstance(entries, dict) else ():
            try:
                msgspec.convert(entry, kind)
            except msgspec.ValidationError as error:
                raise UsageError(f"{where}: {section}.{key}: {_friendly(str(error))}") from None
    try:
        return msgspec.convert(data, ProblemFile)
    except msgspec.ValidationError as error:
        raise UsageError(f"{where}: {_located(str(error))}") from None


def _friendly(message: str) -> str:
    """msgspec's words for the types, in TOML's."""
    out = message
    for theirs, ours in (
        ("`object`", "a table"), ("`array`", "a list"), ("`str`", "a text in quotes"), ("`float`", "a number"),
        ("`int | str`", 'a whole number or "ode"'), ("`int`", "a whole number"), ("`bool`", "true or false"),
    ):  # fmt: skip
        out = out.replace(theirs, ours)
    return out[:1].lower() + out[1:]


def _located(message: str) -> str:
    """msgspec's message about a whole file: the key first, and what was meant where a key is unknown."""
    match = re.fullmatch(r"(.*?)(?: - at `(?:key in )?\$\.?(.*)`)?", message, re.DOTALL)
    what, place = (match[1], match[2] or "") if match else (message, "")
    prefix = f"{place}: " if place else ""
    unknown = re.fullmatch(r"Object contains unknown field `(.*)`", what, re.DOTALL)
    if unknown and place in _SECTIONS:
        key, fields = unknown[1], _SECTIONS[place].__struct_fields__
        if place and key in ProblemFile.__struct_fields__:
            hint = f"; {key} belongs to the top of the file, above the first [section]"
        elif sections := [
            name for name, kind in _SECTIONS.items() if key in kind.__struct_fields__
        ]:
            hint = f"; {key} belongs to the section [{sections[0]}]"
        else:
            hint = suggestion(key, fields)
        return f"{prefix}unknown key {key!r}{hint} (known: {', '.join(fields)})"
    what = what.replace("Object missing required field", "Missing the key")
    return prefix + _friendly(what)
