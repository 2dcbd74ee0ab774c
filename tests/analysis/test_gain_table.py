"""The table of `octarm design`: ratios, decays and targets from the certificates."""

from __future__ import annotations

from typing import Any

import msgspec
import pytest
from closed_form import CERTIFICATE

from analysis.gain_table import gain_rows, gain_table
from wire.artefact import Certificate

GOOD = {
    "certified_gamma": 0.10,
    "achieved_gamma": 0.09,
    "optimum_gamma": 0.08,
    "open_loop_gamma": 1.25,
    "decay_per_s": 0.03,
    "open_loop_decay_per_s": 0.01,
    "gain_norm": 12.345,
    "seconds": 7.89,
}


def gains(role: str = "observer", **figures: Any) -> list[tuple[str, str, Certificate]]:
    """Two gains with good certificates, but for these figures of one of them."""
    good = msgspec.structs.replace(CERTIFICATE, **GOOD)
    bad = msgspec.structs.replace(good, **figures)
    return [("1", name, bad if name == role else good) for name in ("observer", "controller")]


def test_rows() -> None:
    observer, controller = gain_rows(gains())
    assert (observer["setpoint"], observer["role"], controller["role"]) == (
        "1",
        "observer",
        "controller",
    )
    for row in (observer, controller):
        assert {key: row[key] for key in GOOD} == GOOD
        assert row["certified_ratio"] == pytest.approx(1.25)
        assert row["achieved_ratio"] == pytest.approx(1.125)
        assert row["decay_ratio"] == pytest.approx(3.0)
        assert row["targets_missed"] == []


@pytest.mark.parametrize(
    ("role", "figures", "missed"),
    [
        ("observer", {"certified_gamma": 0.1041}, ["certified"]),
        ("observer", {"certified_gamma": 0.1039}, []),
        ("controller", {"achieved_gamma": 0.0921}, ["achieved"]),
        ("controller", {"achieved_gamma": 0.0919}, []),
        ("observer", {"decay_per_s": 0.0099}, ["decay"]),
        ("observer", {"decay_per_s": 0.01 * (1.0 - 1e-9)}, []),  # rounding
        ("controller", {"decay_per_s": 0.0199}, ["decay"]),
        ("controller", {"decay_per_s": 0.0201}, []),
        (
            "controller",
            {"optimum_gamma": 0.04, "decay_per_s": 0.01},
            ["certified", "achieved", "decay"],
        ),
        ("observer", {"open_loop_decay_per_s": None}, []),  # an artefact that does not say
        ("observer", {"optimum_gamma": 0.0}, []),
    ],
)
def test_targets(role: str, figures: dict[str, Any], missed: list[str]) -> None:
    observer, controller = gain_rows(gains(role, **figures))
    row, other = (observer, controller) if role == "observer" else (controller, observer)
    assert row["targets_missed"] == missed
    assert other["targets_missed"] == []


def test_table() -> None:
    rows = gain_rows(gains("controller", certified_gamma=0.12, open_loop_decay_per_s=None))
    units, head, observer, controller, targets = gain_table(rows).splitlines()
    assert observer.split() == [
        "1", "observer", "0.1000", "0.0900", "0.0800", "1.25", "1.250", "1.125", "12.35", "0.0300",
        "0.0100", "7.9", "-",
    ]  # fmt: skip
    assert controller.split()[-3:] == ["-", "7.9", "certified"]
    assert "optimum" in head and "gamma" in units
    for column in ("certified", "optimum", "gain norm", "seconds"):
        # numbers end where their heading ends
        end = head.index(column) + len(column)
        assert observer[end - 1].isdigit() and observer[end] == " "
    assert "1.3" in targets and "1.15" in targets
    assert max(map(len, (units, head, observer, controller, targets))) <= 130
