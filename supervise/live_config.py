"""What the live page's process is told of a run: beside the plan of one that will be, and of a recorded one."""

from __future__ import annotations

from collections.abc import Iterable

from deploy import Deployment
from deploy.path import References
from wire.artefact import GainsArtefact
from wire.joints import TipConfig
from wire.run_config import GoalConfig, LinkConfig, LiveConfig, RunConfig

GOAL_POINTS = 65
"""Of a setpoint's shape."""


def live_config(
    run: RunConfig,
    artefact: GainsArtefact,
    deployment: Deployment,
    references: References,
    *,
    links: LinkConfig,
    port: int,
    elsewhere: Iterable[int],
    period_s: float,
    replay_from: int | None = None,
) -> LiveConfig:
    """The configuration; see `wire.run_config.LiveConfig` for what the last four mean."""
    return LiveConfig(
        run=run,
        port=port,
        forward_widths=deployment.forward_widths,
        backward_widths=deployment.backward_widths,
        tip=tip_of(deployment, references),
        goals=_goals(artefact, sorted(run.scheduling.setpoints)),
        elsewhere=tuple(sorted(elsewhere)),
        period_s=period_s,
        replay_from=replay_from,
        links=links,
    )


def tip_of(deployment: Deployment, references: References) -> TipConfig:
    """What must be known of the tip's segment to draw the estimated arm."""
    return TipConfig(references.nodes[-1].to_plain(), deployment.nodes[-1].bend_m)


def _goals(artefact: GainsArtefact, indices: Iterable[int]) -> tuple[GoalConfig, ...]:
    """Setpoints as shapes."""
    from analysis.goals import setpoint_shape

    length_m = artefact.arm.length_m
    shapes = {i: setpoint_shape(artefact.setpoints[i], length_m, GOAL_POINTS) for i in indices}
    return tuple(GoalConfig(i, tuple(map(tuple, one.tolist()))) for i, one in shapes.items())
