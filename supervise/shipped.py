"""Where the shipped arm and gains lie; the command line and the plan of a run take their defaults here."""

from __future__ import annotations

from pathlib import Path

EXAMPLES = Path(__file__).resolve().parent.parent / "examples"
DEFAULT_ARM = EXAMPLES / "chapter_arm.toml"
DEFAULT_GAINS = EXAMPLES / "default.gains.json"
