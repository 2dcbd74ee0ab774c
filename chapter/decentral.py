"""Section 4 reproduced: the formula for u_i, c_i and d_i, its quadrature, its transfers, and real nodes that
run it.

Between the formula (`chapter.section4`), the runs (`chapter.section4_run`, `chapter.section4_deployed`) and
the page.
"""

from __future__ import annotations

import tempfile
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from analysis.recording import read_recording
from chapter import markdown
from chapter.decentral_figures import NAMES, rules, transfer
from chapter.part import Claim, Part, Tell
from chapter.rounding import gap, significant
from chapter.section4 import Rule, columns, nodes, refinement
from chapter.section4_deployed import agreement
from chapter.section4_loop import growth_per_s
from chapter.section4_run import MEASURED, look, received_sums, recorded, run_apart
from supervise.shipped import DEFAULT_GAINS
from wire.artefact import read_artefact
from wire.factors import STATES

COUNTS = (5, 10, 20, 40, 80, 160, 320)
NODES = 10
TICKS = 1200
SHOWN_TICK = 40
"""The tick of Fig. 3."""


def part(tell: Tell) -> Part:
    """Everything that section 4 says of the formula, checked."""
    artefact = read_artefact(DEFAULT_GAINS)
    controller, length = artefact.setpoints[0].controller, artefact.arm.length_m
    tell("decentral: both rules against the exact integral")
    errors = refinement(controller, length, COUNTS)
    orders = {rule: float(np.log2(values[-2] / values[-1])) for rule, values in errors.items()}
    transfers = {
        str(n): nodes(controller, length, n, Rule.MIDPOINT).sweep(np.zeros((n, 4)))[3]
        for n in (2, 3, 10, 20, 40)
    }
    seen = {}
    with tempfile.TemporaryDirectory(prefix="octarm-chapter-") as work:
        for rule in Rule:
            tell(f"decentral: {NODES} node processes run the formula ({rule})")
            path = run_apart(DEFAULT_GAINS, Path(work) / str(rule), NODES, TICKS, rule)
            seen[rule] = look(path, rule)
            if rule is Rule.MIDPOINT:
                figure = _transfer_of(path)
        tell("decentral: octarm's own step asked for the same formula")
        step = agreement(_ordinary_run(Path(work) / "own"))
    runs = {
        str(rule): {
            "error": gap(one.error),
            "sums_error": gap(one.sums_error),
            "messages_per_tick": one.messages_per_tick,
            "numbers": list(one.numbers),
            "ticks": one.ticks,
            "tip_error_mm": [
                significant(1e3 * float(np.sqrt(np.mean(part**2))), 2)
                for part in np.split(one.tip_error_m, 6)
            ],
        }
        for rule, one in seen.items()
    }
    numbers: dict[str, Any] = {
        "counts": list(COUNTS),
        "errors": errors,
        "orders": orders,
        "transfers": transfers,
        "runs": runs,
        "deployed": {
            **significant(asdict(step), 2),
            "implicit": gap(step.implicit, 1e-13),
            **{key: getattr(step, key) for key in ("ticks", "nodes", "messages_per_tick")},
            "numbers": list(step.numbers),
        },
        "growth_per_s": {
            f"{cells} cells, {'at once' if tick is None else f'{tick:g} s'}": growth_per_s(
                artefact, NODES, cells, Rule.MIDPOINT, tick
            )
            for cells in (NODES, 4 * NODES)
            for tick in (None, 0.01, 0.1)
        },
        "growth_at_middles_per_s": growth_per_s(
            artefact, NODES, 4 * NODES, Rule.MIDPOINT, None, middle=True
        ),
    }
    facts: dict[str, Any] = significant(numbers, 4)
    fine = f"{4 * NODES} cells"
    rates = [facts["growth_per_s"][f"{fine}, {how}"] for how in ("at once", "0.1 s")]
    worst = max(one["error"] for one in facts["runs"].values())
    claims = (
        Claim(
            "4, u_i against K_n x_i",
            "K_1 over j <= i in the first formula, j < i in c_i of the last",
            "two different rules; the last leaves the own piece out. "
            f"Both are of first order ({orders['display']:.2f}, {orders['transfer']:.2f})",
            holds=False,
        ),
        Claim(
            "4, ds = L / (n + 1)",
            "s_i = i ds, i = 0 .. n",
            "left ends of n + 1 pieces: no node at the tip. Midpoints and half of the own piece on either side "
            f"are of order {orders['midpoint']:.2f} at the same cost",
            holds=False,
        ),
        Claim(
            "4, factors",
            "K_i(s, theta) = K_ia(s) K_ib(theta)",
            "true of polynomials, with as many columns as the kernel has rank "
            f"({seen[Rule.MIDPOINT].numbers[0]} here): that many numbers travel, not one",
            holds=True,
        ),
        Claim(
            "4, recursions",
            "c_{i+1} = c_i + K_1b x_i, d_i = d_{i+1} + K_2b x_i",
            f"real processes give the double sum to {worst:.0e}",
            holds=True,
        ),
        Claim(
            "4, 2 n transfers",
            "2 n against n^2 (section 1: n (n - 1))",
            "2 n for nodes 0 .. n, that is 2 (N - 1) for N nodes against N (N - 1); counted by the receivers: "
            f"{seen[Rule.MIDPOINT].messages_per_tick:g} a tick with 10",
            holds=True,
        ),
        Claim(
            "4, delay",
            "delay arising from communication between distal nodes is avoided",
            "no: a sum from the root is at the tip after N - 1 hops; only the wires are saved (docs/growth.md)",
            holds=False,
        ),
        Claim(
            "4, from operator to nodes",
            "the discretised controller stands for the designed one",
            f"10 nodes without observer: decay on their own grid, growth of {rates[1]:+.3f} 1/s on one four "
            f"times finer at a tick of 0.1 s ({rates[0]:+.3f} without sampling)",
            holds=False,
        ),
        Claim(
            "4, K and L are 3-PI operators",
            "also for u and y of (17), (20)",
            "there u and y are numbers: then K is one integral and L a function. The formula needs u(s), y(s)",
            holds=False,
        ),
    )
    tips = {str(rule): one.tip_error_m for rule, one in seen.items()}
    return Part(
        key="decentral",
        title="Decentralised implementation",
        section="4",
        text=_text(facts),
        claims=claims,
        figures={
            "decentral-transfer.png": figure,
            "decentral-rules.png": rules(COUNTS, errors, tips, 0.1),
        },
        facts=facts,
    )


def _transfer_of(path: Path) -> Figure:
    recording = read_recording(path)
    run = recording.configuration
    controller = columns(recording.artefact.setpoints[run.setpoint_index].controller, MEASURED)
    hold = nodes(controller, recording.artefact.arm.length_m, run.nodes, Rule.MIDPOINT)
    k = SHOWN_TICK
    x = recording.measurements[k] - recording.references.states(k)[:, MEASURED]
    u = recording.commands[k + 1] - recording.references.states(k + 1)[:, STATES]
    c = np.zeros((run.nodes, hold.K1b.shape[1]))
    d = np.zeros((run.nodes, hold.K2b.shape[1]))
    c[1:] = received_sums(recording, c.shape[1], "c")[k]
    d[:-1] = received_sums(recording, d.shape[1], "d")[k]
    return transfer(k, x, c, d, u)


def _ordinary_run(directory: Path) -> Path:
    """`octarm run`, default gains."""
    command = f"launcher.py run --nodes {NODES} --ticks 200 --no-plot --quiet --out".split()
    return recorded([*command, str(directory.absolute())], directory, "octarm run")


def _text(facts: dict[str, Any]) -> str:
    errors = [
        (count, *(f"{facts['errors'][str(rule)][k]:.2e}" for rule in Rule))
        for k, count in enumerate(facts["counts"])
    ]
    orders = ("order", *(f"{facts['orders'][str(rule)]:.3f}" for rule in Rule))
    by_rule = markdown.table(("nodes", *(NAMES[rule] for rule in Rule)), [*errors, orders])
    runs = markdown.table(
        (
            "rule",
            "commands, relative difference",
            "sums",
            "messages a tick",
            "tip error, rms of every 20 s [mm]",
        ),
        [
            (
                NAMES[name],
                f"{one['error']:.0e}",
                f"{one['sums_error']:.0e}",
                f"{one['messages_per_tick']:g}",
                ", ".join(f"{v:g}" for v in one["tip_error_mm"]),
            )
            for name, one in facts["runs"].items()
        ],
    )
    transfers = ", ".join(f"{n}: {count}" for n, count in facts["transfers"].items())
    rates = [f"{rate:+.4f}" for rate in facts["growth_per_s"].values()]
    growth = markdown.table(
        ("", "at once", "tick 0.01 s", "tick 0.1 s"),
        [(f"{NODES} cells", *rates[:3]), (f"{4 * NODES} cells", *rates[3:])],
    )
    step, run = facts["deployed"], facts["runs"]["midpoint"]
    return f"""## The formula and its quadrature

The controller of the shipped gains at setpoint 1 (kernels of rank {run["numbers"][0]}) on a smooth state,
against its integrals by Gauss quadrature; largest error of a command, relative to the largest command:

{by_rule}

![Errors of the rules, and the arm under each](decentral-rules.png)

Section 4 states the formula twice, and not the same one. In K_n x_i the kernel K_1 acts on j = 0 .. i and K_2
on j = i + 1 .. n: the nodes s_i = i ds, ds = L / (n + 1), are left ends of n + 1 pieces, and node i's own
piece, which lies on the tip's side of s_i, is counted with K_1. In u_i at the end c_i holds j < i and
d_{{i+1}} j > i, so the own piece is not counted at all: with ten nodes
{facts["errors"]["transfer"][1]:.0%} of the largest command is missing. Both are of first order. The corrected
rule has the nodes in the middle of their pieces and counts the own state half under K_1, half under K_2:

    u_i = K_0 x_i + ds K_1a (c_i + 1/2 K_1b x_i) + ds K_2a (d_{{i+1}} + 1/2 K_2b x_i),   s_i = (i + 1/2) ds,
    ds = L / N.

It is of second order, with the same sums and transfers: only what a node does at home changes.

## Transfers

Transfers for N nodes, counted in the sweep: {transfers}: 2 (N - 1). The chapter's nodes are 0 .. n, that is N
= n + 1 of them, so its 2 n is right there; with the n nodes of
section 1, whose all-to-all exchange it counts as n (n - 1), it is 2 (n - 1). A transfer carries as many
numbers as the kernel has rank. What is saved is wires and messages, not delay: a sum from the root reaches
the tip after N - 1 hops, one after the other ([../growth.md](../growth.md)).

## Real nodes

`chapter.section4_run` starts {NODES} node processes, the plant and the recorder as `octarm run` does, but
gives the nodes the numbers of this page: W = V = I, Q = K_1b(s_i), R = K_2b(s_i), P = ds K_1a(s_i), U = ds
K_2a(s_i), D the rest. x_i is what node i measures, (v_y, k); what the gain makes of v_x and e, which nobody
measures, is left out, and there is no observer. Every recorded command was computed again from the recorded
measurements of the tick before, pair by pair, from the kernels' coefficients; every received sum from the
products of the nodes before it. {TICKS} ticks of 0.1 s, exact plant, disturbance and noise:

{runs}

![Fig. 3 with the numbers of one tick](decentral-transfer.png)

Messages are counted by the receivers; {2 * (NODES - 1)} is 2 (N - 1). The recordings hold the matrices that
the nodes were given, so `octarm replay` repeats these runs bit for bit.

The arm comes near its setpoint and then does not rest. On the nodes' own grid the linear loop decays; on a
model four times finer, which is what the plant has, a motion between the nodes grows (rate of the slowest
motion in 1/s, corrected rule; "at once" without sampling):

{growth}

It is not a matter of places: with v_y and k of the middles of the segments the rate at once is
{facts["growth_at_middles_per_s"]:+.4f}. The formula distributes a static gain over a few places and says
nothing of what lies between them; with the observer, in the step below, the same gain brings the tip to rest
(README).

## The step that octarm deploys

`octarm run` does observer and controller in one exchange, with transition matrices in the sums (theory,
section 5), so its c and d ({step["numbers"][0]} and {step["numbers"][1]} numbers in the middle of the arm)
are not the chapter's. Its commands are, on the recorded estimates xh,

    u = K (xh + h b u),

K by a double sum with dual cells about the places where the states live (velocities at the outer face of a
segment, strain at its centre, curvature at its inner face; `deploy/operators.py`), the last term being what
the command itself does within the tick. Computed by pairs from the recording of {step["ticks"]} ticks:
relative difference {step["implicit"]:.0e}. Without the last term it is {step["explicit"]:.1%}; with the rule
of this page, which knows no staggered places, {step["midpoint"]:.0%} with {step["nodes"]} nodes.
{step["messages_per_tick"]:g} messages a tick here too.
"""
