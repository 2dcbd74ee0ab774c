"""Problem files: what is read, and that refusals name the file, the key, the term and what was expected."""

from __future__ import annotations

import errno
import math
import os
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from design.pde.model import (
    Expression,
    Field,
    Input,
    Kind,
    Output,
    Pde,
    Point,
    Signal,
    StateVariable,
)
from design.pde.problem_file import (
    Bisection,
    Problem,
    Task,
    check_task,
    parse_problem,
    read_problem_file,
)
from wire.errors import UsageError

VALID = """\
name = "rod"
description = "a rod and its end"
domain = [1, 3]
parameters = { lam = 4, L = 3.0 }
task = "observer"
bisect = ["lam", 0, 20.5]
[states]
x = 2
X = "ode"
[inputs]
disturbances = ["w1", "f(s)"]
controls = [" u ", "g ( s )"]
[equations]
X = "-X + int(x)"
x = "x_ss + lam*x + w1 + f + g"
[boundary]
conditions = ["x(1)", "x_s(L) = X"]
[outputs]
regulated = ["x(3)", "x"]
measured = ["X + u"]
"""


def parse(text: str, **overrides: float) -> Problem:
    return parse_problem(text, "p.toml", overrides)


# What is read


def test_all_that_a_file_can_say(tmp_path: Path) -> None:
    path = tmp_path / "rod.toml"
    path.write_text(VALID)
    problem = read_problem_file(path)
    pde = problem.pde
    assert (problem.text, problem.source) == (VALID, str(path))
    assert (problem.task, problem.bisect) == (Task.OBSERVER, Bisection("lam", 0.0, 20.5))
    assert (pde.name, problem.description) == ("rod", "a rod and its end")
    assert (pde.domain, pde.parameters) == ((1.0, 3.0), {"lam": 4.0, "L": 3.0})
    assert pde.states == (StateVariable("x", 2), StateVariable("X", None))
    assert pde.disturbances == (Signal("w1", False), Signal("f", True))
    assert pde.controls == (Signal("u", False), Signal("g", True))
    assert [e.text for e in pde.equations] == ["x_ss + lam*x + w1 + f + g", "-X + int(x)"]
    half = math.sqrt(0.5)
    assert dict(pde.equations[0].terms) == {
        Field(0, 2): (0.25,),
        Field(0): (4.0,),
        Input(Kind.DISTURBANCE, 0): (1.0,),
        Input(Kind.DISTURBANCE, 1): pytest.approx((half,)),
        Input(Kind.CONTROL, 1): pytest.approx((half,)),
    }
    assert dict(pde.conditions[1].terms) == {Point(0, 1, 1): (0.5,), Field(1): (-1.0,)}
    assert [output.distributed for output in pde.regulated] == [False, True]
    assert dict(pde.regulated[1].expression.terms) == {Field(0): pytest.approx((math.sqrt(2.0),))}
    assert pde.measured == (
        Output(Expression(((Field(1), (1.0,)), (Input(Kind.CONTROL, 0), (1.0,))), "X + u"), False),
    )
    assert pde.numerator == pde.denominator == ()


def test_the_least_that_a_file_must_say() -> None:
    problem = parse('states = { q = 0 }\nequations = { q = "-q" }')
    expected = Pde(
        states=(StateVariable("q", 0),), equations=(Expression(((Field(0), (-1.0,)),), "-q"),)
    )
    assert problem.pde == expected
    assert (problem.task, problem.bisect) == (None, None)


def test_a_norm_needs_no_equations() -> None:
    problem = parse(
        'task = "norm"\ndomain = [0, 4]\n[states]\nx = 1\n[boundary]\nconditions = ["x(0)"]\n'
        '[norm]\nof = ["x", "x(4)"]\nby = ["x_s"]'
    )
    assert [e.terms for e in problem.pde.equations] == [()]
    over, under = problem.pde.numerator, problem.pde.denominator
    assert [output.distributed for output in (*over, *under)] == [True, False, True]
    assert dict(over[0].expression.terms) == {Field(0): (2.0,)}
    assert dict(over[1].expression.terms) == {Point(0, 0, 1): (1.0,)}
    assert dict(under[0].expression.terms) == {Field(0, 1): (0.5,)}


def test_parameters_can_be_replaced() -> None:
    problem = parse(VALID, lam=-1.5)
    assert problem.pde.parameters == {"lam": -1.5, "L": 3.0}
    assert dict(problem.pde.equations[0].terms)[Field(0)] == (-1.5,)
    assert parse(problem.text, lam=4.0) == parse(VALID)
    gone = parse(VALID, lam=0.0)
    assert Field(0) not in dict(gone.pde.equations[0].terms)


def test_a_byte_order_mark_is_no_text(tmp_path: Path) -> None:
    path = tmp_path / "p.toml"
    path.write_bytes(b"\xef\xbb\xbf" + VALID.encode())
    assert read_problem_file(path).pde == parse(VALID).pde


@pytest.mark.parametrize("order", range(9))
def test_as_many_conditions_as_orders(order: int) -> None:
    conditions = ", ".join(f'"x_s{j}(0)"' if j else '"x(0)"' for j in range(order))
    text = (
        f'[states]\nx = {order}\n[equations]\nx = "-x"\n[boundary]\nconditions = [{conditions}]\n'
    )
    pde = parse(text).pde
    assert [dict(c.terms) for c in pde.conditions] == [
        {Point(0, j, 0): (1.0,)} for j in range(order)
    ]


# Refusals: (what to change in VALID, into what, parts of the message)

CHANGES = [
    # keys and types
    ("[outputs]", "[output]", ["unknown key 'output'; did you mean outputs?", "known: states, name"]),
    ("measured", "mesured", ["outputs: unknown key 'mesured'; did you mean measured?"]),
    ("[states]", "conditions = []\n[states]", ["unknown key 'conditions'", "to the section [boundary]"]),
    ("[outputs]", 'task = "gain"\n[outputs]', ["boundary: unknown key 'task'", "the top of the file"]),
    ("[boundary]", 'domain = "[0, 1]"\n[boundary]', ["equations.domain: there is no state", "top of the file"]),
    ('name = "rod"', "name = 3", ["name: expected a text in quotes, got a whole number"]),
    ("[1, 3]", "[1]", ["domain: expected a list of length 2, got 1"]),
    ("[1, 3]", "[1, 'b']", ["domain[1]: expected a number, got a text in quotes"]),
    ("[1, 3]", "[3, 1]", ["domain: expected [a, b] with finite a < b, got [3, 1]"]),
    ("[1, 3]", "[1, 1]", ["domain: expected [a, b]"]),
    ("[1, 3]", "[1, inf]", ["domain: expected [a, b] with finite a < b"]),
    ("[1, 3]", "[-1.7e308, 1.7e308]", ["domain: expected [a, b]"]),
    ("[1, 3]", "[nan, 3]", ["domain: expected [a, b]"]),
    ('["x(1)", "x_s(L) = X"]', '"x(1)"', ["boundary.conditions: expected a list, got a text in quotes"]),
    ('["x(1)", "x_s(L) = X"]', '["x(1)", 0]', ["boundary.conditions[1]: expected a text in quotes"]),
    ('"-X + int(x)"', "0", ["equations.X: expected a text in quotes, got a whole number"]),
    # parameters
    ("lam = 4", "lam = nan", ["parameters.lam: expected a finite number, got nan"]),
    ("lam = 4", "lam = inf", ["parameters.lam: expected a finite number, got inf"]),
    ("lam = 4", "lam = true", ["parameters.lam: expected a number, got true or false"]),
    ("lam = 4", "lam = " + "9" * 400, ["parameters.lam: number out of range"]),
    ("lam = 4", "lam = [4]", ["parameters.lam: expected a number, got a list"]),
    # states
    ("x = 2\n", "x = 9\n", ["states.x: expected the order", "0 to 8", '"ode"', "got 9"]),
    ("x = 2\n", "x = -1\n", ["states.x: expected the order", "got -1"]),
    ("x = 2\n", "x = 2.0\n", ['states.x: expected a whole number or "ode", got a number']),
    ("x = 2\n", "x = true\n", ["states.x: expected a whole number", "got true or false"]),
    ("x = 2\n", 'x = "pde"\n', ["states.x: expected the order", "got 'pde'"]),
    ('x = 2\nX = "ode"\n', "", ["states: expected at least one state"]),
    # names
    ("x = 2\n", "x = 2\nx_s = 1\n", ["states: 'x_s' reads as a derivative of the state 'x'"]),
    ("x = 2\n", 'x = 2\nX_ss = "ode"\n', ["states: 'X_ss' reads as a derivative of the state 'X'"]),
    ("lam = 4,", "lam = 4, x_s3 = 1,", ["parameters: 'x_s3' reads as a derivative of the state 'x'"]),
    ('"w1"', '"x_ss"', ["inputs.disturbances: 'x_ss' reads as a derivative"]),
    ("x = 2\n", "x = 2\ns = 2\n", ["states: 's' is reserved for the place along the domain"]),
    ("lam = 4,", "lam = 4, t = 1,", ["parameters: 't' is reserved for time"]),
    ("lam = 4,", "lam = 4, pi = 3,", ["parameters: 'pi' is reserved for 3.14159"]),
    ('"w1"', '"int"', ["inputs.disturbances: 'int' is reserved"]),
    ("lam = 4,", "lam = 4, x = 3,", ["states: 'x' is declared in parameters already"]),
    ('"w1"', '"X"', ["inputs.disturbances: 'X' is declared in states already"]),
    ('"w1"', '"w1", "w1"', ["inputs.disturbances: 'w1' is declared in inputs.disturbances already"]),
    ('" u "', '"w1(s)"', ["inputs.controls: 'w1' is declared in inputs.disturbances already"]),
    ('"w1"', '"w1(t)"', ["inputs.disturbances[0]: expected a name", '"w(s)"', "got 'w1(t)'"]),
    ('"w1"', '""', ["inputs.disturbances[0]: expected a name"]),
    ('"w1"', '"1w"', ["inputs.disturbances: '1w' is no name"]),
    ('"w1"', '"_w"', ["'_w' is no name"]),
    ("lam = 4,", "lambda = 4,", ["parameters: 'lambda' is a word with a meaning of its own"]),
    ("lam = 4,", '"\u03bb" = 4,', ["parameters: '\u03bb' is no name"]),
    ("lam = 4,", '"" = 4,', ["parameters: '' is no name"]),
    # equations
    ('X = "-X + int(x)"\n', "", ["equations: the state 'X' has no equation", 'X = "..."']),
    ("X = \"-X", "Y = \"-X", ["equations.Y: there is no state of this name", "(states: x, X)"]),
    ("-X + int(x)", "-X + x", ["equations.X: 'x' depends on s", "\n    -X + x\n         ^"]),
    ("lam*x", "lam*x*x", ["equations.x: 'lam*x*x' is not linear"]),
    ("lam*x", "lam", ["equations.x: 'lam' is a constant term"]),
    ("lam*x", "lamb*x", ["equations.x: 'lamb' is not declared; did you mean lam?"]),
    ("lam*x", "x_sss", ["equations.x: 'x_sss' is not defined: x has order 2"]),
    # conditions
    ('"x(1)", ', "", ["boundary.conditions: expected 2, the sum of the orders", "(x: 2)", "got 1"]),
    ('"x(1)", ', '"x(1)", "x(3)", ', ["boundary.conditions: expected 2", "got 3"]),
    ("x = 2\n", "x = 2\nz = 3\n", ["equations: the state 'z' has no equation"]),
    ('"x(1)"', '"x(1) = u"', ["boundary.conditions[0]: 'u' contains an input"]),
    ('"x(1)"', '"x(0)"', ["boundary.conditions[0]: 'x(0)' is taken at 0", "[1, 3]"]),
    ("x_s(L) = X", "x_s(L) = 1", ["boundary.conditions[1]: '1' is a constant term"]),
    # outputs
    ('"X + u"', '"X + u", "x*x"', ["outputs.measured[1]: 'x*x' is not linear"]),
    ('["x(3)", "x"]', '["x(3)", "1"]', ["outputs.regulated[1]: '1' is a constant term"]),
    # the task
    ('"observer"', '"obsever"', ["task: expected one of stability, gain", "did you mean observer?"]),
    ('"observer"', '"norm"', ["task: 'norm' needs norm.of, which the problem does not give"]),
    ('measured = ["X + u"]\n', "", ["task: 'observer' needs outputs.measured"]),
    ('["lam", 0, 20.5]', '["mu", 0, 1]', ["bisect: there is no parameter 'mu'", "(declared: lam, L)"]),
    ('["lam", 0, 20.5]', '["lam", 1, 1]', ["bisect: expected [parameter, low, high]", "low = 1"]),
    ('["lam", 0, 20.5]', '["lam", 0, inf]', ["bisect: expected [parameter, low, high]"]),
    ('["lam", 0, 20.5]', '["lam", 0]', ["bisect: expected a list of length 3, got 2"]),
    ("[outputs]", '[norm]\nof = ["x"]\n[outputs]', ["norm: missing the key `by`"]),
    ("[outputs]", '[norm]\nof = []\nby = ["x"]\n[outputs]', ["norm.of: expected at least one"]),
    ("[outputs]", '[norm]\nof = ["x"]\nby = ["u"]\n[outputs]', ["norm.by[0]: 'u' contains an input"]),
    # TOML
    ("domain = [1, 3]", "domain = [1, 3", ["this is not TOML", "line"]),
    ('"-X + int(x)"', "-X + int(x)", ["this is not TOML", "in quotes"]),
    ("x = 2\n", "x = 2\nx = 2\n", ["this is not TOML"]),
    ("x = 2\n", "x = " + "9" * 5000 + "\n", ["this is not TOML"]),
    ("[1, 3]", "[" * 5000, ["this is not TOML"]),
]  # fmt: skip


@pytest.mark.parametrize(("old", "new", "parts"), CHANGES)
def test_refusals(old: str, new: str, parts: list[str]) -> None:
    assert VALID.count(old) >= 1
    with pytest.raises(UsageError) as refusal:
        parse(VALID.replace(old, new, 1))
    message = str(refusal.value)
    assert message.startswith("problem file p.toml: ")
    for part in parts:
        assert part in message
    assert len(message) < 600


def test_an_empty_file_lacks_its_states() -> None:
    with pytest.raises(UsageError, match=r"^problem file p\.toml: missing the key `states`$"):
        parse("")


def test_several_states_with_too_few_conditions_are_told_apart() -> None:
    with pytest.raises(UsageError, match=r"expected 3, .*\(x: 2, v: 1\); got 0"):
        parse('[states]\nx = 2\nv = 1\nq = 0\n[equations]\nx = "v"\nv = "x"\nq = "q"')


def test_conditions_where_none_belong() -> None:
    with pytest.raises(UsageError, match=r"boundary.conditions: expected 0, .*; got 1"):
        parse('[states]\nq = 0\n[equations]\nq = "-q"\n[boundary]\nconditions = ["q(0)"]')


@pytest.mark.parametrize(
    ("overrides", "parts"),
    [
        (
            {"lan": 1.0},
            ["there is no parameter 'lan' to set; did you mean lam?", "(declared: lam, L)"],
        ),
        ({"x": 1.0}, ["there is no parameter 'x' to set"]),
        ({"lam": math.nan}, ["parameters.lam: expected a finite number, got nan"]),
        ({"L": 2.0}, ["boundary.conditions[1]: 'x_s(L)' is taken at 2"]),
    ],
)
def test_refused_overrides(overrides: dict[str, float], parts: list[str]) -> None:
    with pytest.raises(UsageError) as refusal:
        parse(VALID, **overrides)
    for part in parts:
        assert part in str(refusal.value)


def test_an_override_where_nothing_is_declared() -> None:
    with pytest.raises(UsageError, match=r"no parameter 'lam' to set \(declared: none\)"):
        parse('states = { q = 0 }\nequations = { q = "-q" }', lam=1.0)


@pytest.mark.parametrize(
    ("task", "missing"),
    [
        (Task.GAIN, "inputs.disturbances and outputs.regulated"),
        (Task.OBSERVER, "inputs.disturbances and outputs.regulated and outputs.measured"),
        (Task.CONTROLLER, "inputs.disturbances and outputs.regulated and inputs.controls"),
        (Task.NORM, "norm.of"),
    ],
)
def test_what_a_task_needs(task: Task, missing: str) -> None:
    bare = parse('states = { q = 0 }\nequations = { q = "-q" }').pde
    check_task(bare, Task.STABILITY, "--task")
    with pytest.raises(UsageError) as refusal:
        check_task(bare, task, "--task")
    assert str(refusal.value) == (
        f"--task: {task.value!r} needs {missing}, which the problem does not give"
    )


# Files that cannot be read


def test_a_missing_file(tmp_path: Path) -> None:
    path = tmp_path / "none.toml"
    with pytest.raises(UsageError, match=r"none\.toml: No such file or directory"):
        read_problem_file(path)


def test_a_folder(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="Is a directory; expected a readable TOML file"):
        read_problem_file(tmp_path)


def test_an_unreadable_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(path: Path, *_: object) -> None:
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(path))

    monkeypatch.setattr(Path, "open", refuse)
    with pytest.raises(UsageError, match=r"p\.toml: Permission denied"):
        read_problem_file(tmp_path / "p.toml")


def test_a_file_that_is_not_utf8(tmp_path: Path) -> None:
    path = tmp_path / "p.toml"
    path.write_bytes(VALID.replace("rod", "r\u00f6d").encode("latin-1"))
    with pytest.raises(UsageError, match="expected text in UTF-8, got the byte 0xf6 at position 9"):
        read_problem_file(path)


# Damage


@settings(max_examples=300, deadline=None)
@given(
    at=st.integers(0, len(VALID)),
    length=st.integers(0, 12),
    piece=st.one_of(
        st.text(max_size=4),
        st.text("xXws0123_()[]{}=+-*/\"',.\n", max_size=6),
        st.sampled_from(["nan", "inf", "true", "2020-01-01", "1e999", "x_ss", "int(", "[norm]\n"]),
    ),
)
def test_a_damaged_file_is_read_or_refused(at: int, length: int, piece: str) -> None:
    text = VALID[:at] + piece + VALID[at + length :]
    message = ""
    try:
        problem = parse(text)
        assert all(math.isfinite(p) for p in problem.pde.parameters.values())
    except UsageError as error:
        message = str(error)
    assert not message or message.startswith("problem file p.toml: ")
