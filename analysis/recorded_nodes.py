"""The configurations of a run's node processes: as the recording has them, else made again from its gains.

Between a recording and the replay of its nodes. Since format version 4 they are attached bit for bit. Gains
that are deployed again give the same matrices with the same machine and libraries; elsewhere rounding may
differ.
"""

from __future__ import annotations

from dataclasses import dataclass

import msgspec

from analysis.recording import Recording
from deploy.node_configs import node_configs
from wire.channels import NODES_ATTACHMENT
from wire.config_json import loads
from wire.errors import UsageError
from wire.run_config import LinkConfig, NodeConfig

_DEADLINE_S = 5.0


@dataclass(frozen=True)
class RecordedNodes:
    """One configuration a node process, from the root to the tip."""

    configs: tuple[NodeConfig, ...]
    recorded: bool
    """False: made again from artefact and configuration, because the recording has none."""

    def process_of(self, segment: int) -> NodeConfig:
        """The process that has this segment; UsageError if the arm has not."""
        for config in self.configs:
            if config.index <= segment <= config.last:
                return config
        raise UsageError(
            f"--node {segment}: expected one of the nodes 0 to {self.configs[-1].last} of the recording"
        )


def recorded_nodes(recording: Recording) -> RecordedNodes:
    """The configurations of all node processes; UsageError if those attached are not a whole arm."""
    text = recording.attachments.get(NODES_ATTACHMENT)
    if text is None:
        return RecordedNodes(_made_again(recording), recorded=False)
    where = f"recording {recording.path}: {NODES_ATTACHMENT}"
    try:
        lines = msgspec.json.decode(text, type=list[msgspec.Raw])
    except msgspec.DecodeError as error:
        raise UsageError(f"{where}: expected a JSON list of configurations ({error})") from None
    configs = tuple(loads(NodeConfig, bytes(one), f"{where}[{i}]") for i, one in enumerate(lines))
    covered = [j for config in configs for j in range(config.index, config.last + 1)]
    if covered != list(range(recording.nodes)):
        raise UsageError(
            f"{where}: expected the segments 0 to {recording.nodes - 1} in order, got {covered}; it was edited"
        )
    return RecordedNodes(configs, recorded=True)


def _made_again(recording: Recording) -> tuple[NodeConfig, ...]:
    links = LinkConfig((), (), None, _DEADLINE_S, epoch_ns=None, cpu=None, fifo=None)
    run, deployment = recording.configuration, recording.deployment
    return node_configs(run, deployment, recording.references, lambda _: links)
