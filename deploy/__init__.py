"""Gains artefact to per-node sweep factors: grid, model, gains on it, one tick, sweeps, checks."""

from deploy.deployment import DenseStep, Deployment, deploy
from deploy.grid import Place, SegmentGrid, Spacing, make_grid
from deploy.stability import SpectralRadius
from wire.factors import NodeFactors, SweepFactors

__all__ = [
    "DenseStep",
    "Deployment",
    "NodeFactors",
    "Place",
    "SegmentGrid",
    "Spacing",
    "SpectralRadius",
    "SweepFactors",
    "deploy",
    "make_grid",
]
