"""The problem file: what a user writes about a linear 1-D PDE (TOML), read into a `Pde` and a task."""

from __future__ import annotations

import keyword
import math
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from enum import StrEnum
from pathlib import Path

from design.pde.expression import Role, read_expression
from design.pde.model import Expression, Output, Pde, Signal, StateVariable
from design.pde.names import RESERVED, Names, suggestion
from design.pde.problem_schema import ProblemFile, decode
from wire.errors import UsageError, shown
from wire.files import TEXT_BYTES, read_limited

MAX_ORDER = 8
"""Of a state: the highest derivative that problem files may use."""
_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]*")
_SIGNAL = re.compile(r"\s*([^()\s]+)\s*(\(\s*s\s*\))?\s*")


class Task(StrEnum):
    """What can be asked about a problem."""

    STABILITY = "stability"
    GAIN = "gain"
    OBSERVER = "observer"
    CONTROLLER = "controller"
    NORM = "norm"
    H2 = "h2"
    H2_OBSERVER = "h2-observer"


_DISTURBED = (Task.GAIN, Task.OBSERVER, Task.CONTROLLER, Task.H2, Task.H2_OBSERVER)


@dataclass(frozen=True)
class Bisection:
    """Look for the limit of stability in a parameter, between low and high."""

    parameter: str
    low: float
    high: float


@dataclass(frozen=True)
class Problem:
    """A problem file: the PDE, its text and name (to read it again with other parameters), and the task."""

    pde: Pde
    text: str
    source: str
    task: Task | None = None
    bisect: Bisection | None = None
    description: str = ""


def read_problem_file(path: Path, overrides: Mapping[str, float] | None = None) -> Problem:
    """Read a problem file; UsageError if there is none, or for what it says (see `parse_problem`)."""
    try:
        raw = read_limited(path, TEXT_BYTES)
    except OSError as error:
        raise UsageError(
            f"problem file {path}: {error.strerror or error}; expected a readable TOML file"
        ) from None
    try:
        text = raw.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise UsageError(
            f"problem file {path}: expected text in UTF-8, got the byte {raw[error.start]:#04x} at position "
            f"{error.start}; save the file as UTF-8"
        ) from None
    return parse_problem(text, str(path), overrides)


def parse_problem(text: str, source: str, overrides: Mapping[str, float] | None = None) -> Problem:
    """Read the text of a problem file, with some parameters replaced.

    source: names the file in messages. overrides: new values of declared parameters. UsageError names the file,
    the key, the term at fault and what was expected.
    """
    where = f"problem file {source}"
    file = decode(text, where)
    names = _names(file, where, overrides or {})
    pde = Pde(
        states=names.states,
        equations=_equations(file, names, where),
        conditions=_conditions(file, names, where),
        disturbances=names.disturbances,
        controls=names.controls,
        regulated=_outputs(file.outputs.regulated, names, f"{where}: outputs.regulated"),
        measured=_outputs(file.outputs.measured, names, f"{where}: outputs.measured"),
        name=file.name,
        domain=names.domain,
        parameters=dict(names.parameters),
    )
    if file.norm is not None:
        for key, texts in (("of", file.norm.of), ("by", file.norm.by)):
            if not texts:
                raise UsageError(
                    f'{where}: norm.{key}: expected at least one expression, as in ["x_s"]'
                )
        pde = replace(
            pde,
            numerator=_outputs(file.norm.of, names, f"{where}: norm.of", Role.NORM),
            denominator=_outputs(file.norm.by, names, f"{where}: norm.by", Role.NORM),
        )
    task = _task(file, where)
    if task is not None:
        check_task(pde, task, f"{where}: task")
    return Problem(pde, text, source, task, _bisect(file, where), file.description)


def check_task(pde: Pde, task: Task, where: str) -> None:
    """UsageError, opened by `where`, if the problem lacks what the task is about."""
    needs: dict[str, tuple[Iterable[object], tuple[Task, ...]]] = {
        "inputs.disturbances": (pde.disturbances, _DISTURBED),
        "outputs.regulated": (pde.regulated, _DISTURBED),
        "outputs.measured": (pde.measured, (Task.OBSERVER, Task.H2_OBSERVER)),
        "inputs.controls": (pde.controls, (Task.CONTROLLER,)),
        "norm.of": (pde.numerator, (Task.NORM,)),
    }
    missing = [key for key, (given, tasks) in needs.items() if task in tasks and not given]
    if missing:
        raise UsageError(
            f"{where}: {task.value!r} needs {' and '.join(missing)}, which the problem does not give"
        )


# Names


def _names(file: ProblemFile, where: str, overrides: Mapping[str, float]) -> Names:
    parameters = dict(file.parameters)
    for name, value in overrides.items():
        if name not in parameters:
            known = ", ".join(parameters) or "none"
            raise UsageError(
                f"{where}: parameters: there is no parameter {name!r} to set"
                f"{suggestion(name, parameters)} (declared: {known})"
            )
        parameters[name] = float(value)
    for name, value in parameters.items():
        if not math.isfinite(value):
            raise UsageError(f"{where}: parameters.{name}: expected a finite number, got {value}")
    names = Names(
        states=tuple(_state(name, order, where) for name, order in file.states.items()),
        disturbances=_signals(file.inputs.disturbances, f"{where}: inputs.disturbances"),
        controls=_signals(file.inputs.controls, f"{where}: inputs.controls"),
        parameters=parameters,
        domain=_domain(file.domain, where),
    )
    _check_names(names, where)
    return names


def _state(name: str, order: int | str, where: str) -> StateVariable:
    if order == "ode":
        return StateVariable(name, None)
    if isinstance(order, str) or not 0 <= order <= MAX_ORDER:
        raise UsageError(
            f"{where}: states.{name}: expected the order of the highest derivative in s, 0 to {MAX_ORDER}, or "
            f'"ode" for a state that does not depend on s; got {shown(order)}'
        )
    return StateVariable(name, order)


def _signals(entries: list[str], where: str) -> tuple[Signal, ...]:
    out = []
    for number, entry in enumerate(entries):
        match = _SIGNAL.fullmatch(entry)
        if match is None:
            raise UsageError(
                f'{where}[{number}]: expected a name, as "w", or "w(s)" for a function of s; got {entry!r}'
            )
        out.append(Signal(match[1], distributed=match[2] is not None))
    return tuple(out)


def _domain(domain: tuple[float, float], where: str) -> tuple[float, float]:
    a, b = domain
    if not (math.isfinite(a) and math.isfinite(b) and a < b and math.isfinite(b - a)):
        raise UsageError(f"{where}: domain: expected [a, b] with finite a < b, got [{a:g}, {b:g}]")
    return domain


def _check_names(names: Names, where: str) -> None:
    """UsageError unless all names are usable and distinct, also from the derivatives of states."""
    if not names.states:
        raise UsageError(f"{where}: states: expected at least one state, as in x = 2")
    declared: dict[str, str] = {}
    for key, group in (
        ("parameters", list(names.parameters)),
        ("states", [state.name for state in names.states]),
        ("inputs.disturbances", [signal.name for signal in names.disturbances]),
        ("inputs.controls", [signal.name for signal in names.controls]),
    ):
        for name in group:
            place = f"{where}: {key}: {name!r}"
            if not _NAME.fullmatch(name) or keyword.iskeyword(name):
                why = "a word with a meaning of its own" if keyword.iskeyword(name) else "no name"
                raise UsageError(
                    f"{place} is {why}; names are a letter and then letters, digits and underscores"
                )
            if name in RESERVED:
                raise UsageError(f"{place} is reserved for {RESERVED[name]}; choose another name")
            if name in declared:
                raise UsageError(f"{place} is declared in {declared[name]} already; choose another")
            others = Names(tuple(state for state in names.states if state.name != name))
            if (derivative := others.state(name)) is not None:
                raise UsageError(
                    f"{place} reads as a derivative of the state {others.states[derivative[0]].name!r}; "
                    "choose another name"
                )
            declared[name] = key


# Expressions


def _equations(file: ProblemFile, names: Names, where: str) -> tuple[Expression, ...]:
    if file.equations is None and file.norm is not None:
        return tuple(Expression((), "0") for _ in names.states)
    equations = file.equations or {}
    known = [state.name for state in names.states]
    for name in equations:
        if name not in known:
            top = name in ProblemFile.__struct_fields__
            hint = (
                f"; the key {name} belongs to the top of the file, above the first [section]"
                if top
                else suggestion(name, known)
            )
            raise UsageError(
                f"{where}: equations.{name}: there is no state of this name{hint} (states: {', '.join(known)})"
            )
    out = []
    for state in names.states:
        if state.name not in equations:
            raise UsageError(
                f"{where}: equations: the state {state.name!r} has no equation; give its derivative in time as "
                f'{state.name} = "..."'
            )
        role = Role.ODE if state.order is None else Role.EQUATION
        place = f"{where}: equations.{state.name}"
        out.append(read_expression(equations[state.name], names, place, role).expression)
    return tuple(out)


def _conditions(file: ProblemFile, names: Names, where: str) -> tuple[Expression, ...]:
    texts = file.boundary.conditions
    orders = {state.name: state.order for state in names.states if state.order}
    if len(texts) != sum(orders.values()):
        each = ", ".join(f"{name}: {order}" for name, order in orders.items())
        raise UsageError(
            f"{where}: boundary.conditions: expected {sum(orders.values())}, the sum of the orders of all "
            f"states{f' ({each})' if each else ''}; got {len(texts)}"
        )
    return tuple(
        read_expression(
            text, names, f"{where}: boundary.conditions[{number}]", Role.CONDITION
        ).expression
        for number, text in enumerate(texts)
    )


def _outputs(
    texts: list[str], names: Names, where: str, role: Role = Role.OUTPUT
) -> tuple[Output, ...]:
    readings = [
        read_expression(text, names, f"{where}[{number}]", role)
        for number, text in enumerate(texts)
    ]
    return tuple(Output(reading.expression, reading.distributed) for reading in readings)


# The task


def _task(file: ProblemFile, where: str) -> Task | None:
    if file.task is None:
        return None
    known = [task.value for task in Task]
    if file.task not in known:
        raise UsageError(
            f"{where}: task: expected one of {', '.join(known)}; got {file.task!r}"
            f"{suggestion(file.task, known)}"
        )
    return Task(file.task)


def _bisect(file: ProblemFile, where: str) -> Bisection | None:
    if file.bisect is None:
        return None
    name, low, high = file.bisect
    if name not in file.parameters:
        known = ", ".join(file.parameters) or "none"
        raise UsageError(
            f"{where}: bisect: there is no parameter {name!r}{suggestion(name, file.parameters)} "
            f"(declared: {known})"
        )
    if not (math.isfinite(low) and math.isfinite(high) and low < high):
        raise UsageError(
            f"{where}: bisect: expected [parameter, low, high] with finite low < high, got low = {low:g} and "
            f"high = {high:g}"
        )
    return Bisection(name, low, high)
