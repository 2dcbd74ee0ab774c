"""From the text of an expression in a problem file to linear terms on [0, 1]; called by `problem_file`.

The grammar: + - * / ** and parentheses over numbers, parameters, s, pi, states and inputs by name, x_s, x_ss,
x_s5 (derivatives), x(0), x_s(1) (values at an end) and int(...) over the domain [a, b]. The domain is mapped
here: s = a + l sigma, d/ds = (1/l) d/dsigma, and distributed signals carry sqrt(l), so that L2 norms stay those
of the file.
"""

from __future__ import annotations

import ast
import math
import operator
import re
from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum

from design.pde.linear import Linear, NotLinearError
from design.pde.model import (
    Expression,
    Field,
    Input,
    InputIntegral,
    Integral,
    Point,
    Signal,
)
from design.pde.names import RESERVED, Names, suggestion
from design.pde.syntax import Source, shortened
from wire.errors import UsageError

MAX_DEPTH = 60
"""Levels of parentheses, calls and signs."""
END_TOLERANCE = 1e-9
"""How far the place in x(1) may be from the end of the domain, relative to the domain's length."""
_TIME_DERIVATIVE = re.compile(r"(.+)_t+")
_OPERATORS: dict[type[ast.operator], Callable[[Linear, Linear], Linear]] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: operator.truediv,
    ast.Pow: operator.pow,
}


class Role(Enum):
    """Where an expression stands, which decides what it may contain."""

    EQUATION = "the equation of a function of s"
    ODE = "the equation of an ode state"
    CONDITION = "a boundary condition"
    OUTPUT = "an output"
    NORM = "a norm"


@dataclass(frozen=True)
class Reading:
    """An expression, and whether it is a function of s; that follows from its text, so that + 0*s makes one."""

    expression: Expression
    distributed: bool


def read_expression(text: str, names: Names, where: str, role: Role) -> Reading:
    """Read a linear expression; `where` (file and key) opens every message.

    A condition may be "left = right"; a distributed output is multiplied by sqrt(b - a). UsageError for
    anything but a sum of polynomials in s times states, their derivatives, values and integrals, and inputs;
    for what `role` forbids; for coefficients that are not finite.
    """
    source = Source(text, where, equation=role is Role.CONDITION)
    evaluator = _Evaluator(source, names)
    value = evaluator.value(source.sides[0])
    for tree in source.sides[1:]:
        value = evaluator.apply(tree, operator.sub, value, evaluator.value(tree))
    evaluator.check(value, role)
    if value.varies and role in (Role.OUTPUT, Role.NORM):
        scale = Linear.number(math.sqrt(names.length))
        value = evaluator.apply(source.sides[0], operator.mul, value, scale)
    terms = evaluator.apply(source.sides[0], value.merged).terms
    if role is Role.CONDITION and not any(isinstance(atom, Point | Integral) for atom in terms):
        raise UsageError(
            f"{where}: {shortened(text)!r} holds no function of s; a boundary condition is made of values at "
            "the ends, as in x(0) or x_s(1), or of integrals"
        )
    return Reading(Expression(tuple(terms.items()), text), value.varies)


def _driven(value: Linear) -> bool:
    return any(isinstance(atom, Input | InputIntegral) for atom in value.terms)


class _Evaluator:
    """Evaluates the syntax trees of one text."""

    def __init__(self, source: Source, names: Names) -> None:
        self.source, self.names = source, names
        self.refuse = source.refuse

    # What a role forbids

    def check(self, value: Linear, role: Role) -> None:
        """UsageError that names the summand at fault."""
        if role in (Role.ODE, Role.CONDITION) and value.varies:
            raise self.refuse(
                self.culprit(lambda v: v.varies),
                f"depends on s, but {role.value} must be a number: use int(...) or a value at an end, as x(0)",
            )
        if role in (Role.CONDITION, Role.NORM) and _driven(value):
            hint = (
                ': let the input act through an ode state, as in X = "ode" with the equation X = "-10*X + u" '
                "and the condition x(1) = X"
            )
            raise self.refuse(
                self.culprit(_driven),
                f"contains an input, which {role.value} cannot{hint if role is Role.CONDITION else ''}",
            )
        if value.constant:
            raise self.refuse(
                self.culprit(lambda v: bool(v.constant)),
                "is a constant term, without a state or input, but problems are linear: measure the states "
                "from their equilibrium, or multiply the term by a disturbance",
            )

    def culprit(self, guilty: Callable[[Linear], bool]) -> ast.expr:
        """The first summand for which `guilty` holds."""
        for tree in self.source.sides:
            summands, node = [], tree
            while isinstance(node, ast.BinOp) and isinstance(node.op, ast.Add | ast.Sub):
                summands.append(node.right)
                node = node.left
            for summand in (node, *reversed(summands)):
                if guilty(self.value(summand)):
                    return summand
        return self.source.sides[0]

    # The tree

    def value(self, node: ast.expr, depth: int = 0, inside: bool = False) -> Linear:
        """Evaluate; inside: of int(...). Long sums and products lean to the left and are followed in a loop."""
        if depth > MAX_DEPTH:
            raise self.refuse(node, f"is nested more than {MAX_DEPTH} levels deep")
        chain: list[ast.BinOp] = []
        while isinstance(node, ast.BinOp):
            chain.append(node)
            node = node.left
        result = self.operand(node, depth + 1, inside)
        for binary in reversed(chain):
            operation = _OPERATORS.get(type(binary.op))
            if operation is None:
                raise self.refuse(binary, "has an operator that is none of + - * / **")
            right = self.value(binary.right, depth + 1, inside)
            result = self.apply(binary, operation, result, right)
        return result

    def apply(
        self, node: ast.expr, operation: Callable[..., Linear], *operands: Linear | float
    ) -> Linear:
        """The operation, with what it refuses reported at `node`."""
        try:
            return operation(*operands)
        except NotLinearError as error:
            raise self.refuse(node, str(error)) from None

    def operand(self, node: ast.expr, depth: int, inside: bool) -> Linear:
        match node:
            case ast.UnaryOp(op=ast.USub()):
                return -self.value(node.operand, depth, inside)
            case ast.UnaryOp(op=ast.UAdd()):
                return self.value(node.operand, depth, inside)
            case ast.Constant():
                return self.number(node)
            case ast.Name():
                return self.name(node)
            case ast.Call():
                return self.call(node, depth, inside)
        raise self.refuse(node, "has no meaning in an expression")

    def number(self, node: ast.Constant) -> Linear:
        based = self.source.of(node).lower().startswith(("0x", "0o", "0b"))
        if isinstance(node.value, bool) or not isinstance(node.value, int | float) or based:
            raise self.refuse(node, "is no decimal number; a product is written with *, as in 0*x")
        try:
            return self.apply(node, Linear.number, float(node.value))
        except OverflowError:
            raise self.refuse(node, "is too large a number") from None

    def name(self, node: ast.Name) -> Linear:
        if node.id == "s":
            a, b = self.names.domain
            return Linear((a, b - a), {}, True)
        if node.id == "pi":
            return Linear.number(math.pi)
        if node.id == "int":
            raise self.refuse(node, "needs what it integrates, as in int(x)")
        if node.id == "t":
            raise self.refuse(node, "is time, on which coefficients cannot depend")
        if node.id in self.names.parameters:
            return Linear.number(self.names.parameters[node.id])
        if (found := self.names.input(node.id)) is not None:
            return self.signal(*found)
        if (place := self.names.state(node.id)) is not None:
            return self.function(node, *place)
        raise self.unknown(node)

    def unknown(self, node: ast.Name) -> UsageError:
        match = _TIME_DERIVATIVE.fullmatch(node.id)
        if match and self.names.state(match[1]) is not None:
            return self.refuse(
                node,
                "is a derivative in time, which only stands on the left of equations: declare it as a state "
                f'v of its own, with the equation {match[1]} = "v"',
            )
        known = self.names.known()
        return self.refuse(
            node, f"is not declared{suggestion(node.id, known)} (declared: {', '.join(known)})"
        )

    def signal(self, atom: Input, signal: Signal) -> Linear:
        factor = 1.0 / math.sqrt(self.names.length) if signal.distributed else 1.0
        return Linear((), {atom: (factor,)}, signal.distributed)

    def function(self, node: ast.expr, state: int, derivative: int) -> Linear:
        """A state or its derivative at s."""
        self.check_derivative(node, state, derivative)
        atom = Field(state, derivative)
        return Linear((), {atom: (self.scale(derivative, node),)}, self.names.varies(atom))

    def check_derivative(
        self, node: ast.expr, state: int, derivative: int, end: bool = False
    ) -> None:
        """UsageError unless the derivative exists, as a function or (end) at the ends of the domain."""
        name, order = self.names.states[state].name, self.names.states[state].order
        if order is None:
            if derivative or end:
                raise self.refuse(
                    node, f"is not defined: {name} is an ode state, a number without place"
                )
            return
        last = order - 1 if end else order
        if derivative > last:
            kind = "values at the ends" if end else "derivatives"
            upto = f"up to {name}{'_' * (last > 0)}{'s' * last}" if last >= 0 else "not at all"
            raise self.refuse(
                node,
                f"is not defined: {name} has order {order} in [states], so {kind} exist {upto}",
            )

    def scale(self, derivative: int, node: ast.expr) -> float:
        """l^-derivative."""
        try:
            return float(self.names.length**-derivative)
        except (OverflowError, ZeroDivisionError):
            raise self.refuse(node, "is not finite: the domain is too short") from None

    # Calls

    def call(self, node: ast.Call, depth: int, inside: bool) -> Linear:
        """int(...), x(0), x(s), w(s)."""
        if not isinstance(node.func, ast.Name):
            raise self.refuse(node, "lacks an operator: a product is written with *")
        name = node.func.id
        if len(node.args) != 1 or node.keywords or isinstance(node.args[0], ast.Starred):
            raise self.refuse(node, f"must have one argument in the parentheses after {name}")
        argument = node.args[0]
        if name == "int":
            if inside:
                raise self.refuse(
                    node, "is an integral inside of an integral; take it out as a factor"
                )
            value = self.value(argument, depth, inside=True)
            length = self.names.length
            return self.apply(node, lambda: value.integral(self.names.varies, length))
        at_s = isinstance(argument, ast.Name) and argument.id == "s"
        if (found := self.names.input(name)) is not None:
            if not found[1].distributed:
                raise self.refuse(
                    node,
                    f'is not defined: {name} is a number; a function is declared as "{name}(s)"',
                )
            if not at_s:
                raise self.refuse(
                    node, f"is not defined: {name} has no values at points; use int(...)"
                )
            return self.signal(*found)
        if (place := self.names.state(name)) is None:
            raise self.unknown_function(node, node.func)
        if at_s and self.names.states[place[0]].order is not None:
            return self.function(node, *place)
        self.check_derivative(node, *place, end=True)
        return self.point(node, *place, self.value(argument, depth, inside))

    def unknown_function(self, node: ast.Call, name: ast.Name) -> UsageError:
        if name.id in self.names.parameters or name.id in RESERVED:
            return self.refuse(node, "lacks an operator: a product is written with *")
        if hasattr(math, name.id):
            return self.refuse(
                node, "is not available: coefficients are polynomials in s; put one in its place"
            )
        return self.unknown(name)

    def point(self, node: ast.Call, state: int, derivative: int, place: Linear) -> Linear:
        """A state or its derivative at an end of the domain."""
        (a, b), length = self.names.domain, self.names.length
        try:
            at = place.value_of("")
        except NotLinearError:
            raise self.refuse(
                node, f"must be taken at s or at an end of the domain [{a:g}, {b:g}]"
            ) from None
        end = 0 if abs(at - a) <= abs(at - b) else 1
        if abs(at - (a, b)[end]) > END_TOLERANCE * length:
            raise self.refuse(
                node,
                f"is taken at {at:g}, but values exist at the ends of the domain [{a:g}, {b:g}] only",
            )
        return Linear((), {Point(state, derivative, end): (self.scale(derivative, node),)})
