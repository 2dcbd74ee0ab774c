"""Where the shipped arm, gains, scenarios and reference problems lie: the defaults of the command line."""

from __future__ import annotations

from pathlib import Path

EXAMPLES = Path(__file__).resolve().parent.parent / "examples"
DEFAULT_ARM = EXAMPLES / "chapter_arm.toml"
DEFAULT_GAINS = EXAMPLES / "default.gains.json"
SUITE = EXAMPLES / "suite.toml"
SCENARIOS = EXAMPLES / "scenarios"
