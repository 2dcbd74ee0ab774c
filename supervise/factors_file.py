"""What `octarm deploy` shows and writes: ranks and message sizes, and every node's matrices as
JSON.

The file serves targets that run a node in other software: matrices, offsets and starting values of
the sweep (theory, section 5), in SI units.
"""

from __future__ import annotations

import dataclasses
import json
from typing import Any

from deploy import Deployment, NodeFactors
from wire.messages import message_bytes


def readable(factors: NodeFactors) -> dict[str, Any]:
    """One node's factors as plain lists."""
    return {
        "index": factors.index,
        "nodes": factors.nodes,
        "bend_m": factors.bend_m,
        "initial_estimate": factors.initial_estimate.tolist(),
        "initial_command_n_per_m": factors.initial_command.tolist(),
        "setpoints": [
            {f.name: getattr(one, f.name).tolist() for f in dataclasses.fields(one)}
            for one in factors.setpoints
        ],
    }


def factors_json(deployment: Deployment) -> str:
    """Grid, ranks and every node's factors as one JSON object."""
    return json.dumps(
        {
            "faces_m": deployment.faces_m.tolist(),
            "tick_s": deployment.tick_s,
            "setpoint_names": list(deployment.setpoint_names),
            "ranks_forward": [list(ranks) for ranks in deployment.ranks_forward],
            "ranks_backward": [list(ranks) for ranks in deployment.ranks_backward],
            "largest_difference_to_dense": deployment.check,
            "nodes": [readable(factors) for factors in deployment.nodes],
        }
    )


def facts(deployment: Deployment) -> dict[str, Any]:
    """The table of `octarm deploy`."""
    # every setpoint's sums travel in messages of one length, with what the scheduling needs behind them
    lengths = [
        length
        for node in deployment.nodes
        for length in (node.forward_received, node.backward_received)
        if length
    ]
    size = [message_bytes(min(lengths)), message_bytes(max(lengths))]
    rows = []
    for i, name in enumerate(deployment.setpoint_names):
        forward, backward = deployment.ranks_forward[i], deployment.ranks_backward[i]
        rows.append(
            {
                "name": name,
                "rank_forward": max(forward),
                "rank_backward": max(backward),
                "bytes_per_message": size,
                "spectral_radius": deployment.spectral_radius[i].largest,
            }
        )
    return {
        "nodes": len(deployment.nodes),
        "tick_s": deployment.tick_s,
        "faces_m": deployment.faces_m.tolist(),
        "messages_per_tick": deployment.messages_per_tick,
        "largest_difference_to_dense": deployment.check,
        "setpoints": rows,
    }


def facts_table(table: dict[str, Any]) -> str:
    """The dictionary of `facts` as text."""
    lines = [
        f"{table['nodes']} nodes, tick {table['tick_s']:g} s, "
        f"{table['messages_per_tick']} neighbour messages a tick, "
        f"sweeps equal the dense step to {table['largest_difference_to_dense']:.1e}",
        f"{'setpoint':<12} {'forward':>8} {'backward':>9} {'bytes':>12} {'radius':>9}",
    ]
    for row in table["setpoints"]:
        low, high = row["bytes_per_message"]
        lines.append(
            f"{row['name']:<12} {row['rank_forward']:>8} {row['rank_backward']:>9} "
            f"{f'{low}-{high}':>12} {row['spectral_radius']:>9.6f}"
        )
    return "\n".join(lines)
