"""The report of a campaign: faults by kind and target, how runs ended, violations, the longest times.

Last step, after `chaos.campaign`: from the results of cases to one object, and from that to a table.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import Any

from analysis.text_table import aligned, ruled

NO_END = "none"
"""Key of runs whose launcher did not end."""


def facts_of(seed: int, results: Sequence[dict[str, Any]], seconds: float) -> dict[str, Any]:
    """The object of --json, from results (chaos.case.Result) in the order in which they were done."""
    faults: dict[str, Counter[str]] = {}
    codes: Counter[str] = Counter()
    missed: Counter[str] = Counter()
    ends: dict[str, tuple[float, int]] = {}
    """The longest time, and whose case it was."""
    row = longest = 0
    for result in results:
        code = NO_END if result["exit_code"] is None else str(result["exit_code"])
        codes[code] += 1
        missed.update(result["missed"])
        own = [hit["name"] for hit in result["hits"] if not hit["curtain"]]
        for name in own:
            faults.setdefault(name, Counter())[code] += 1
        for name, end_s in result["end_s"].items():
            ends[name] = max(ends.get(name, (0.0, -1)), (round(end_s, 2), result["number"]))
        row = 0 if result["wrong"] else row + len(own)
        longest = max(longest, row)
    return {
        "seed": seed,
        "seconds": round(seconds, 1),
        "runs": len(results),
        "begun": sum(bool(result["begun"]) for result in results),
        "faults": sum(counts.total() for counts in faults.values()),
        "faults_in_a_row": row,
        "longest_row": longest,
        "by_fault": {name: dict(sorted(faults[name].items())) for name in sorted(faults)},
        "exit_codes": dict(sorted(codes.items())),
        "missed": dict(sorted(missed.items())),
        "longest_s": {
            "fault_to_end": {name: list(ends[name]) for name in sorted(ends)},
            "case": list(max(((r["seconds"], r["number"]) for r in results), default=(0.0, -1))),
            "launcher_dead_to_all_gone": round(max((r["gone_s"] for r in results), default=0.0), 2),
        },
        "violations": [_violation(seed, result) for result in results if result["wrong"]],
        "cases": [_case(results[0])] if len(results) == 1 else [],
    }


def _violation(seed: int, result: dict[str, Any]) -> dict[str, Any]:
    return {
        **_case(result),
        "wrong": result["wrong"],
        "again": f"octarm chaos --seed {seed} --only {result['number']}",
    }


def _case(result: dict[str, Any]) -> dict[str, Any]:
    return {
        "number": result["number"],
        "exit_code": result["exit_code"],
        "hits": [f"{hit['at_s']:.2f} s: {hit['fault']} ({hit['what']})" for hit in result["hits"]],
        "directory": result["directory"],
    }


def table(facts: dict[str, Any]) -> str:
    """The report for a person."""
    codes = sorted(facts["exit_codes"], key=_order)
    body = [
        (name, str(sum(counts.values())), *(str(counts.get(code, "")) for code in codes))
        for name, counts in facts["by_fault"].items()
    ]
    total = facts["exit_codes"]
    body.append(("runs", str(facts["runs"]), *(str(total[code]) for code in codes)))
    heads = [code if code == NO_END else f"exit {code}" for code in codes[:1]] + codes[1:]
    lines = _table(("fault", "injected", *heads), body)
    longest = facts["longest_s"]
    if longest["fault_to_end"]:
        rows = [
            (name, f"{seconds:.2f} s", str(number))
            for name, (seconds, number) in longest["fault_to_end"].items()
        ]
        head = ("fault that ended a run", "longest time to the launcher's end", "in case")
        lines += ["", *_table(head, rows)]
    if "-9" in total:
        gone_s = longest["launcher_dead_to_all_gone"]
        lines += ["", f"launcher killed: everything else gone within {gone_s:.2f} s"]
    lines += ["", *_words(facts), ""]
    return "\n".join(lines)


def _order(code: str) -> tuple[bool, int]:
    """Exit codes in order, then signals, then runs without an end."""
    return (True, 1000) if code == NO_END else (code.startswith("-"), abs(int(code)))


def _words(facts: dict[str, Any]) -> list[str]:
    missed = sum(facts["missed"].values())
    seconds, number = facts["longest_s"]["case"]
    out = [
        f"longest case: {number}, {seconds:.1f} s",
        f"seed {facts['seed']}: {facts['faults']} faults in {facts['runs']} runs ({facts['begun']} came to "
        f"their first tick), {facts['seconds']:.0f} s; {missed} found nothing to hit any more",
        f"{len(facts['violations'])} violations; {facts['faults_in_a_row']} faults survived in a row",
    ]
    for case in facts["cases"]:
        out += [
            f"case {case['number']}: exit code {case['exit_code']}, kept in {case['directory']}"
        ]
        out += [f"  {hit}" for hit in case["hits"]]
    for case in facts["violations"]:
        out += [f"case {case['number']}: {text}" for text in case["wrong"]]
        out += [f"  kept in {case['directory']}; again: {case['again']}"]
    return out


def _table(head: Sequence[str], body: Sequence[Sequence[str]]) -> list[str]:
    return ruled(aligned(head, body, gap=3))
