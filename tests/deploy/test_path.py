"""References between setpoints: the exact plant follows them with the feed-forward alone."""

from __future__ import annotations

import msgspec
import numpy as np
import numpy.typing as npt
import pytest
from closed_form import ARM, artefact
from statics import SETPOINT_2, SETPOINT_3

from deploy import deploy, make_grid
from deploy.path import References, make_references
from plant.disturbance import DisturbanceSpec
from plant.initial import initial_shape
from plant.model import ArmPlant, PlantParameters
from wire.artefact import GainsArtefact
from wire.errors import UsageError
from wire.run_config import LegConfig

Array = npt.NDArray[np.float64]
TICK = 0.1
GRID = make_grid(1.0, 6, "equispaced")


@pytest.fixture(scope="module")
def gains() -> GainsArtefact:
    """Setpoints straight, 1 (14 degrees) and 2 (the chapter's)."""
    base = artefact()
    second = msgspec.structs.replace(base.setpoints[1], name="2", curvature_per_m=SETPOINT_2)
    return msgspec.structs.replace(base, setpoints=[*base.setpoints, second])


@pytest.fixture(scope="module")
def there(gains: GainsArtefact) -> References:
    legs = [LegConfig("2", (), 14.0, 3.0), LegConfig("1", (), 12.0, 0.0)]
    return make_references(gains, GRID, TICK, "1", 2.0, legs)


def test_rests_are_the_setpoints_of_the_deployment(gains: GainsArtefact, there: References) -> None:
    dense = deploy(gains, 6, TICK).dense
    for tick, index in ((0, 1), (19, 1), (160, 2), (189, 2), (310, 1), (9999, 1)):
        offset = dense[index].out_offset.reshape(6, 5)
        np.testing.assert_allclose(there.states(tick), offset, atol=1e-6)


def test_velocities_are_the_rates_of_the_places(there: References) -> None:
    """Strain and curvature of the nodes move as the velocities say: e_t, k_t from (v')."""
    h = TICK
    for tick in (60, 90, 120, 240):
        before, now, after = (there.plant.at(tick + i) for i in (-1, 0, 1))
        rate = (after[3] - before[3]) / (2.0 * h)
        assert abs(rate) > 1e-3
        tip = (after[:2] - before[:2]) / (2.0 * h)
        np.testing.assert_allclose(there.states(tick)[-1, :2], tip, rtol=2e-3, atol=2e-5)
        faces = np.append(0.0, there.states(tick)[:, 1])
        mean = float(np.mean(0.5 * (faces[1:] + faces[:-1])))
        assert now[2] == pytest.approx(mean, rel=0.1)


def test_chords_lead_from_the_clamp_to_the_tip(gains: GainsArtefact) -> None:
    """Also on a grid whose three curvatures could not be added up to the shape."""
    legs = [LegConfig("2", (), 10.0, 0.0)]
    coarse = make_references(gains, make_grid(1.0, 3, "equispaced"), TICK, "1", 0.0, legs)
    for tick in (0, 30, 60, 200):
        tip = coarse.chords_m(tick).sum(axis=0)
        np.testing.assert_allclose(tip, coarse.plant.at(tick)[:2], atol=1e-3)


def test_the_way_back_is_the_way_there_backwards(gains: GainsArtefact) -> None:
    both = [LegConfig("2", (), 10.0, 0.0), LegConfig("1", (), 10.0, 0.0)]
    back_and_forth = make_references(gains, GRID, TICK, "1", 0.0, both)
    alone = make_references(gains, GRID, TICK, "2", 0.0, both[1:])
    for tick in range(0, 100, 7):
        np.testing.assert_allclose(back_and_forth.states(100 + tick), alone.states(tick), atol=1e-6)
        np.testing.assert_allclose(
            back_and_forth.plant.at(100 + tick), alone.plant.at(tick), atol=1e-7
        )


def test_a_way_passes_through_its_waypoints(gains: GainsArtefact) -> None:
    legs = [LegConfig("2", ("1",), 10.0, 0.0)]
    way = make_references(gains, GRID, TICK, "straight", 0.0, legs)
    offset = deploy(gains, 6, TICK).dense[1].out_offset.reshape(6, 5)
    np.testing.assert_allclose(way.states(50)[:, 2:4], offset[:, 2:4], atol=1e-6)


@pytest.mark.parametrize("actuator", ["transverse", "normal"])
def test_the_exact_arm_follows_with_the_feed_forward_alone(
    gains: GainsArtefact, actuator: str
) -> None:
    """No sensor, no feedback: 45 cm there and back within 6 mm, so inertia and drag are in the commands."""
    arm = msgspec.structs.replace(ARM, actuator=actuator)
    turned = msgspec.structs.replace(gains, arm=arm)
    legs = [LegConfig("2", (), 14.0, 3.0), LegConfig("1", (), 12.0, 0.0)]
    way = make_references(turned, GRID, TICK, "1", 2.0, legs)
    plant = ArmPlant(
        PlantParameters(
            arm=arm,
            faces_m=tuple(GRID.faces_m.tolist()),
            tick_s=TICK,
            initial=initial_shape("setpoint", gains.setpoints[1], 1.0),
            disturbance=DisturbanceSpec(),
            cells=60,
        )
    )
    wanted = np.stack([way.plant.at(tick)[:2] for tick in range(310)])
    errors = []
    for tick in range(310):
        errors.append(float(np.hypot(*(plant.tip() - wanted[tick]))))
        plant.advance(way.states(tick)[:, 4], tick)
    assert np.hypot(*np.ptp(wanted, axis=0)) > 0.4
    assert max(errors) < 6e-3


def test_shapes_on_the_way_that_cannot_be_held_are_refused(gains: GainsArtefact) -> None:
    far = msgspec.structs.replace(
        gains.setpoints[2], name="far", curvature_per_m=(1.4 * np.array(SETPOINT_3)).tolist()
    )
    more = msgspec.structs.replace(gains, setpoints=[*gains.setpoints, far])
    with pytest.raises(
        UsageError, match=r"setpoint 1 -> far at \d\.\d\d of the way: the arm turns"
    ):
        make_references(more, GRID, TICK, "1", 0.0, [LegConfig("far", (), 5.0, 0.0)])
    with pytest.raises(UsageError, match="setpoint 'nowhere' is not in the gains artefact"):
        make_references(gains, GRID, TICK, "1", 0.0, [LegConfig("nowhere", (), 5.0, 0.0)])


def test_a_way_to_where_the_arm_is_is_a_rest(gains: GainsArtefact) -> None:
    """As when a start is asked for on the command line that is the first leg's end."""
    way = make_references(gains, GRID, TICK, "2", 1.0, [LegConfig("2", (), 5.0, 0.0)])
    for tick in (0, 30, 45, 100):
        np.testing.assert_allclose(way.states(tick), way.states(0), atol=1e-9)
