"""What is drawn: the same for the same seed, every kind and target, nothing that the run does not have."""

from __future__ import annotations

from collections import Counter

from chaos.draw import (
    BEFORE,
    ENDLESS,
    LIVE,
    MOST_FAULTS,
    NODE,
    PREPARED,
    RUN,
    START,
    WEIGHTS,
    draw_case,
)
from chaos.inject import INJECTORS

CASES = [draw_case(11, number) for number in range(1500)]


def test_a_case_depends_on_seed_and_number_alone() -> None:
    assert [draw_case(11, number) for number in (7, 3, 1499)] == [CASES[7], CASES[3], CASES[1499]]
    assert draw_case(12, 7) != CASES[7]
    assert len({case.faults for case in CASES}) > 1490


def test_every_kind_target_and_variant_is_drawn() -> None:
    drawn = Counter((f.kind, f.target) for case in CASES for f in case.faults if f.phase != BEFORE)
    assert set(drawn) == set(WEIGHTS)
    assert {kind for kind, _ in WEIGHTS} == set(INJECTORS)
    before = {(f.kind, f.variant) for case in CASES for f in case.faults if f.phase == BEFORE}
    assert before == {(kind, variant) for kind, many in PREPARED.items() for variant in many}
    phases = Counter(f.phase for case in CASES for f in case.faults)
    assert min(phases[phase] for phase in (BEFORE, START, RUN)) > 100


def test_every_way_to_run_is_drawn() -> None:
    runs = [case.run for case in CASES]
    assert {run.nodes for run in runs} == set(range(2, 9))
    assert {run.hold_ticks for run in runs} == set(range(7))
    assert {run.scenario for run in runs} == {"hold", "reach", "track"}
    assert {run.segments_per_process for run in runs} == {1, 2, 3}
    links = {"unix": (False,), "tcp": (False, True)}
    assert {(run.realtime, run.restart, run.transport, run.keys, run.live) for run in runs} == {
        (realtime, restart, transport, keys, live)
        for realtime in (False, True)
        for restart in (False, True)
        for transport, many in links.items()
        for keys in many
        for live in (False, True)
    }
    assert 300 < sum(run.ticks == ENDLESS for run in runs) < 1200


def test_faults_fit_the_run() -> None:
    for case in CASES:
        assert 1 <= len(case.faults) <= MOST_FAULTS
        for fault in case.faults:
            assert fault.target != LIVE or case.run.live
            assert fault.kind != "sockets gone" or case.run.transport == "unix"
            assert (fault.target == NODE) == (fault.node >= 0)
            if fault.target == NODE:
                assert fault.node in case.run.firsts
            if fault.target == NODE and fault.kind in ("garbage", "flood"):
                assert fault.node != case.run.firsts[-1]  # the tip's process does not listen
    twins = sum(
        (a.phase, a.at_s) == (b.phase, b.at_s) and a.phase != BEFORE
        for case in CASES
        for a, b in zip(case.faults, case.faults[1:], strict=False)
    )
    assert twins > 100
