"""Gains files: a whole, finite, certified artefact, or refused, also where the digest fits what is wrong."""

from __future__ import annotations

import hashlib
import math
from typing import Any

import msgspec
import numpy as np
import valid
from hypothesis import given
from mutations import damaged, json_of, outcome

from deploy import deploy
from wire.artefact import GainsArtefact, digest, parse_artefact
from wire.errors import GainsRefusedError, OctarmError


def sealed(content: str) -> bytes:
    """A gains file with this content and the digest of it: what an editor would make that knows the format."""
    raw = content.encode(errors="surrogatepass")
    sha = hashlib.sha256(raw).hexdigest()
    return (
        f'{{"format":"octarm-gains","version":2,"sha256":"{sha}","content":'.encode() + raw + b"}"
    )


def check(raw: bytes) -> GainsArtefact | None:
    got, refusal = outcome(lambda: parse_artefact(raw, "the file"), GainsRefusedError)
    if got is None:
        assert refusal.startswith("the file")
        assert refusal.encode()
        return None
    for value in everything(msgspec.to_builtins(got)):
        assert math.isfinite(value)
    return got


def everything(value: Any) -> list[float]:
    if isinstance(value, dict):
        value = list(value.values())
    if isinstance(value, list):
        return [number for one in value for number in everything(one)]
    return [float(value)] if isinstance(value, int | float) else []


@given(damaged(valid.gains_text()))
def test_a_damaged_gains_file_is_refused(raw: bytes) -> None:
    got = check(raw)
    if got is not None:  # only what is not said in the content may differ
        assert digest(got) == digest(valid.gains())


@given(json_of(valid.content_of(valid.gains_text())).map(sealed))
def test_damage_that_the_digest_does_not_show_is_refused_or_leaves_a_usable_arm(raw: bytes) -> None:
    got = check(raw)
    if got is None:
        return
    with np.errstate(all="ignore"):
        try:
            deployment = deploy(got, 2, 0.01)
        except OctarmError:
            return
    for node in deployment.nodes:
        assert np.isfinite(node.initial_command).all()
