"""Answers of the LPI engine as tables for a person.

Takes the plain data of `design.solve_command.facts` and of `supervise.suite.run_suite`, gives text; nothing is
computed here but shares and units.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from analysis.folded_table import WIDTH, Column, folded

_GAMMA = {
    "gain": "no disturbance is amplified more, in the regulated outputs: proven",
    "observer": "no disturbance is amplified more, in the error of the estimated outputs: proven",
    "controller": "no disturbance is amplified more, in the regulated outputs with feedback: proven",
    "norm": "least c that is proven for |of| <= c |by|",
    "h2": "root of the variance of the regulated outputs under white noise: no larger, proven",
    "h2-observer": "root of the error's variance under white noise: no larger, proven",
}
_ACHIEVED = {
    "stability": "rightmost eigenvalue",
    "gain": "the norm",
    "observer": "the norm with this observer",
    "controller": "the norm with this feedback",
    "norm": "the ratio",
    "h2": "the H2 norm",
    "h2-observer": "the H2 norm with this observer",
}
_PARTS = {
    "assembly": "assembly",
    "modelling": "CVXPY",
    "solver": "solver",
    "verification": "verification",
}


def answer_table(facts: dict[str, Any], width: int = WIDTH) -> str:
    """The answer to one problem: what was asked, the verdict with its evidence, one line a degree."""
    out = _table(
        [("figure", "left"), ("value", "left"), ("meaning", "left")], _figures(facts), width
    )
    if facts["attempts"]:
        out += "\n\n" + _table(_ATTEMPT, [_attempt(a) for a in facts["attempts"]], width, gap=1)
    return out + "\n"


def suite_table(suite: dict[str, Any], width: int = WIDTH) -> str:
    """All reference problems, and below them what failed, what was slow, and the totals."""
    rows = suite["rows"]
    lines = [_table(_SUITE, [_suite_row(row) for row in rows], width, gap=1), ""]
    lines += [f"{row['id']} fails: {row['reason']}" for row in rows if not row["ok"]]
    lines += [
        f"{row['id']} took {row['seconds']:.0f} s, its time is {row['seconds_allowed']:g} s"
        for row in rows
        if row["seconds"] is not None and row["seconds"] > row["seconds_allowed"]
    ]
    if suite["not_run"]:
        lines.append(f"interrupted; not run: {', '.join(suite['not_run'])}")
    well = sum(row["ok"] for row in rows)
    peak = max((row["peak_memory_mb"] or 0.0 for row in rows), default=0.0)
    lines.append(
        f"{well} of {len(rows)} rows ok, {suite['seconds']:.0f} s, largest peak memory {peak:.0f} MB"
    )
    return "\n".join(lines) + "\n"


def _table(
    columns: Sequence[Column], rows: Sequence[Sequence[str]], width: int, gap: int = 2
) -> str:
    return "\n".join(folded(columns, rows, width, gap=gap))


# One answer


def _figures(f: dict[str, Any]) -> list[tuple[str, str, str]]:
    problem, task = f["problem"], f["task"]
    out = [
        ("problem", problem["name"] or "without a name", problem["file"]),
        ("task", _asked(f), _parameters(problem)),
        (
            "states",
            _states(problem["states"]),
            f"order of the highest derivative in s, {_domain(problem)}",
        ),
    ]
    out += [
        (name, ", ".join(problem[key]), meaning)
        for key, (name, meaning) in _GROUPS.items()
        if problem[key]
    ]
    out.append(("verdict", f["status"], f["message"]))
    if f["limit"] is not None:
        name = f["bisect"]["parameter"]
        out.append(
            ("limit", _number(f["limit"]), f"last {name} with a certificate, from the stable end")
        )
    if f["gamma"] is not None:
        out.append(("gamma", _number(f["gamma"]), _GAMMA[task]))
    if f["achieved"] is not None:
        out.append(("achieved", _number(f["achieved"]), _achieved(f)))
    if f["open_loop"] is not None:
        what = "observer" if "observer" in task else "feedback"
        out.append(("open loop", _number(f["open_loop"], "unstable"), f"the same without {what}"))
    if f["optimum"] is not None:
        out.append(("optimum", _number(f["optimum"]), _optimum(f)))
    if f.get("gain"):
        kind = "L, xh_t = A xh + L (C2 xh - y)" if "observer" in task else "K, u = K x"
        out.append(("gain", f"norm {_number(f['gain']['norm'])}", f"{kind}; its kernels: --json"))
    if f["formulation"]:
        out.append(("formulation", f["formulation"], _program(f)))
    out.append(("time", f"{f['seconds']:.1f} s", _shares(f)))
    if f["peak_memory_mb"] is not None:
        out.append(("peak memory", f"{f['peak_memory_mb']:.0f} MB", "of the engine's process"))
    return out


_GROUPS = {
    "disturbances": ("disturbances", "inputs that nobody commands"),
    "controls": ("controls", "inputs of the feedback"),
    "regulated": ("regulated", "outputs to keep small"),
    "measured": ("measured", "outputs that sensors give"),
    "norm_of": ("of", "expressions in the states"),
    "norm_by": ("by", "expressions in the states"),
}


def _asked(f: dict[str, Any]) -> str:
    if not f["bisect"]:
        return str(f["task"])
    b = f["bisect"]
    return f"limit of stability, {b['parameter']} in [{b['low']:g}, {b['high']:g}]"


def _parameters(problem: dict[str, Any]) -> str:
    given = ", ".join(f"{name} = {value:g}" for name, value in problem["parameters"].items())
    return f"parameters {given}" if given else ""


def _states(states: dict[str, int | str]) -> str:
    return ", ".join(f"{name}: {order}" for name, order in states.items())


def _domain(problem: dict[str, Any]) -> str:
    low, high = problem["domain"]
    return f"s in [{low:g}, {high:g}]"


def _achieved(f: dict[str, Any]) -> str:
    sizes = ", ".join(
        f"{size}: {_number(value, 'unstable')}" for size, value in f["achieved_by_size"]
    )
    state = "" if f["achieved_converged"] else "; not converged"
    what = "limit of the spectrum" if f["bisect"] else _ACHIEVED[f["task"]]
    return f"{what}, on an independent discretisation{f', by size {sizes}' if sizes else ''}{state}"


def _optimum(f: dict[str, Any]) -> str:
    text = "least of any gain (Riccati equation of the discretisation)"
    if f["gamma"] is not None and f["optimum"]:
        text += f"; certified is {f['gamma'] / f['optimum']:.4f} times it"
    return text


def _program(f: dict[str, Any]) -> str:
    sdp = f["sdp"]
    if f["degree"] is None:
        return ""
    return (
        f"degree {f['degree']}: Gram matrices {_sizes(sdp['gram_sizes'])}, {sdp['equalities']} equalities, "
        f"{sdp['solver']}"
    )


def _shares(f: dict[str, Any]) -> str:
    total = f["seconds"]
    if not f["attempts"] or not total > 0.0:
        return ""
    parts = f["seconds_by_part"]
    shares = [f"{name} {parts[part] / total:.0%}" for part, name in _PARTS.items()]
    other = max(0.0, total - sum(parts.values()))
    return ", ".join([*shares, f"other {other / total:.0%}"])


_ATTEMPT: tuple[Column, ...] = (
    ("degree", "right"), ("Gram sizes", "left"), ("equalities", "right"), ("value", "right"),
    ("margin", "right"), ("residual", "right"), ("Gram eigenvalue", "right"), ("solver says", "left"),
    ("seconds", "right"),
)  # fmt: skip


def _attempt(a: dict[str, Any]) -> tuple[str, ...]:
    return (
        str(a["degree"]),
        _sizes(a["gram_sizes"]),
        str(a["equalities"]),
        _number(a["value"]),
        _small(a["margin"]),
        _small(a["residual"]),
        _small(a["smallest_gram_eigenvalue"]),
        a["solver_status"],
        f"{a['seconds']:.1f}",
    )


# The suite


_SUITE: tuple[Column, ...] = (
    ("id", "left"), ("problem", "left"), ("true", "right"), ("ours", "right"), ("ratio", "right"),
    ("published", "left"), ("achieved", "right"), ("degree", "right"), ("seconds", "right"), ("MB", "right"),
    ("verdict", "left"),
)  # fmt: skip


def _suite_row(row: dict[str, Any]) -> tuple[str, ...]:
    stable = row["true"] == "stable"
    certified = "stable" if row["status"] == "certified" else "-"
    return (
        row["id"],
        row["problem"],
        "stable" if stable else _number(row["true"]),
        certified if stable else _number(row["ours"]),
        "-" if row["ratio"] is None else f"{row['ratio']:.4f}",
        " / ".join(p if isinstance(p, str) else f"{p:g}" for p in row["published"]),
        _number(row["achieved"]),
        "-" if row["degree"] is None else str(row["degree"]),
        "-" if row["seconds"] is None else f"{row['seconds']:.1f}",
        "-" if row["peak_memory_mb"] is None else f"{row['peak_memory_mb']:.0f}",
        "ok" if row["ok"] else "FAILS",
    )


def _number(value: float | None, infinite: str = "infinite") -> str:
    if value is None or math.isnan(value):
        return "-"
    return infinite if math.isinf(value) else f"{value:.6g}"


def _small(value: float) -> str:
    return f"{value:.1e}" if math.isfinite(value) else "-"


def _sizes(sizes: Sequence[int]) -> str:
    return ", ".join(map(str, sizes)) or "-"
