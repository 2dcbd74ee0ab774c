"""Scenario files: where the arm starts, where it goes, what disturbs it; and the user's options on top.

The first step from the command line to a plan. A scenario is a TOML file in SI units, every key with its unit;
those in examples/scenarios can be called by their name alone.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import TypeVar

import msgspec

from plant.disturbance import DisturbanceSpec
from plant.grid import plant_cells
from plant.initial import check_name
from plant.noise import SensorNoise
from plant.truncated_force import EXACT, check_model
from supervise.options import RunOptions
from supervise.shipped import SCENARIOS
from wire.errors import UsageError
from wire.files import TEXT_BYTES, read_limited
from wire.run_config import MOST_TICKS, DisturbanceConfig, LegConfig, NoiseConfig

T = TypeVar("T")


class LegTable(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One move and the rest after it."""

    to: str
    move_s: float
    hold_s: float = 0.0
    through: tuple[str, ...] = ()
    """Setpoints on the way, at equal shares of it."""


class DisturbanceTable(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """See plant.disturbance."""

    name: str = "none"
    amplitude: float = 1.0
    frequency_rad_per_s: float = 1.0
    start_s: float = 0.0
    duration_s: float = 10.0


class NoiseTable(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Standard deviations of the sensors' noise."""

    velocity_y_m_per_s: float = 0.0
    curvature_per_m: float = 0.0


class SchedulingTable(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """See `wire.run_config.SchedulingConfig`."""

    hysteresis_deg: float = 2.0
    bump_s: float = 3.0


class Scenario(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The content of a scenario file."""

    name: str
    start: str
    hold_s: float = 0.0
    """Rest at the start."""
    initial: str = "setpoint"
    control: bool = True
    plant_cells: int | None = None
    """Of the emulated arm's grid; None for the run's default."""
    plant_model: str = EXACT
    """See plant.truncated_force."""
    legs: tuple[LegTable, ...] = ()
    disturbance: DisturbanceTable = DisturbanceTable()
    noise: NoiseTable = NoiseTable()
    scheduling: SchedulingTable = SchedulingTable()

    @property
    def duration_s(self) -> float:
        """Of the whole scenario."""
        return self.hold_s + sum(leg.move_s + leg.hold_s for leg in self.legs)


def read_scenario(name: str) -> Scenario:
    """The scenario of that name, or in that file.

    Raises UsageError naming the file, the key, what was expected and what was found.
    """
    path, known = Path(name), sorted(one.stem for one in SCENARIOS.glob("*.toml"))
    if path.suffix == "" and path.name == name:
        if name not in known:
            raise UsageError(
                f"--scenario {name}: there is no scenario of that name; known: {', '.join(known)}; or give a "
                "file"
            )
        path = SCENARIOS / f"{name}.toml"
    try:
        raw = read_limited(path, TEXT_BYTES)
    except OSError as error:
        raise UsageError(
            f"--scenario {name}: {error.strerror or error}; give a scenario file, or the name of one: "
            f"{', '.join(known)}"
        ) from None
    try:
        scenario = msgspec.toml.decode(raw, type=Scenario)
    except (msgspec.DecodeError, ValueError, OverflowError, RecursionError) as error:
        raise UsageError(f"scenario {path}: {error}") from None
    try:
        _check(scenario)
    except UsageError as error:
        raise UsageError(f"scenario {path}: {error}") from None
    return scenario


def _check(scenario: Scenario) -> None:
    _seconds("hold_s", scenario.hold_s, positive=False)
    here = scenario.start
    for number, leg in enumerate(scenario.legs):
        key = f"legs[{number}]"
        _seconds(f"{key}.move_s", leg.move_s, positive=True)
        _seconds(f"{key}.hold_s", leg.hold_s, positive=False)
        stations = (here, *leg.through, leg.to)
        if any(a == b for a, b in pairwise(stations)):
            raise UsageError(
                f"{key}: goes from a setpoint to itself ({' -> '.join(stations)}); a longer hold_s before "
                "it rests there"
            )
        here = leg.to
    if not scenario.duration_s > 0.0:
        raise UsageError("it takes 0 s; give a hold_s or legs")
    check_name(scenario.initial)
    check_model(scenario.plant_model)
    DisturbanceSpec(**msgspec.structs.asdict(scenario.disturbance))
    SensorNoise(0, scenario.noise.velocity_y_m_per_s, scenario.noise.curvature_per_m)
    if scenario.plant_cells is not None:
        plant_cells(1, scenario.plant_cells, exact=scenario.plant_model == EXACT)
    for name in ("hysteresis_deg", "bump_s"):
        value = getattr(scenario.scheduling, name)
        if not (math.isfinite(value) and (value > 0.0 or (value == 0.0 and name != "bump_s"))):
            wanted = "a positive number" if name == "bump_s" else "0 or a positive number"
            raise UsageError(f"scheduling.{name}: expected {wanted}, got {value!r}")


def _seconds(key: str, value: float, *, positive: bool) -> None:
    if not math.isfinite(value) or value < 0.0 or (positive and value == 0.0):
        wanted = "a positive number of seconds" if positive else "0 s or more"
        raise UsageError(f"{key}: expected {wanted}, got {value!r}")


@dataclass(frozen=True)
class Course:
    """A scenario with the user's options on top: everything about a run's story, nothing open."""

    told: Scenario
    """As the file tells it, without the options."""
    setpoint: str
    initial: str
    control: bool
    ticks: int
    plant_cells: int
    plant_model: str
    first_hold_s: float
    legs: tuple[LegConfig, ...]
    disturbance: DisturbanceConfig
    noise: NoiseConfig
    hysteresis_deg: float
    bump_s: float

    @property
    def visited(self) -> tuple[str, ...]:
        """Every setpoint that the reference comes by, once, in the order of the first visit."""
        stations = [self.setpoint]
        for leg in self.legs:
            stations += [*leg.through, leg.to]
        return tuple(dict.fromkeys(stations))


def settle(options: RunOptions) -> Course:
    """Read the scenario and put the options that were given on top of it; raises UsageError."""
    scenario = read_scenario(options.scenario)
    disturbance = msgspec.structs.asdict(scenario.disturbance)
    if options.disturbance is not None:
        disturbance |= {"name": options.disturbance, "amplitude": 1.0}
    if options.disturbance_amplitude is not None:
        disturbance["amplitude"] = options.disturbance_amplitude
    for number, leg in enumerate(scenario.legs):
        if leg.move_s < options.tick_s:
            raise UsageError(
                f"scenario {scenario.name}: legs[{number}].move_s: expected at least a tick, "
                f"{options.tick_s:g} s, got {leg.move_s!r}"
            )
    noise = scenario.noise
    model = _given(options.plant_model, scenario.plant_model)
    exact, cells = model == EXACT, options.plant_cells
    if cells is None and scenario.plant_cells is not None and model == scenario.plant_model:
        cells = max(scenario.plant_cells, plant_cells(options.nodes, None, exact=exact))
    return Course(
        told=scenario,
        setpoint=_given(options.setpoint, scenario.start),
        initial=_given(options.initial, scenario.initial),
        control=scenario.control,
        ticks=_ticks(scenario, options.tick_s) if options.ticks is None else options.ticks,
        plant_cells=plant_cells(options.nodes, cells, exact=exact),
        plant_model=model,
        first_hold_s=scenario.hold_s,
        legs=tuple(LegConfig(leg.to, leg.through, leg.move_s, leg.hold_s) for leg in scenario.legs),
        disturbance=DisturbanceConfig(**disturbance),
        noise=NoiseConfig(
            _given(options.noise_velocity, noise.velocity_y_m_per_s),
            _given(options.noise_curvature, noise.curvature_per_m),
        ),
        hysteresis_deg=scenario.scheduling.hysteresis_deg,
        bump_s=scenario.scheduling.bump_s,
    )


def _ticks(scenario: Scenario, tick_s: float) -> int:
    """As many as the scenario takes."""
    ticks = scenario.duration_s / tick_s
    if not ticks <= MOST_TICKS:
        raise UsageError(
            f"scenario {scenario.name}: it takes {scenario.duration_s:.6g} s, {ticks:.3g} ticks of "
            f"{tick_s:g} s; expected at most {MOST_TICKS} ticks; shorten it or give --ticks"
        )
    return max(1, round(ticks))


def _given(option: T | None, default: T) -> T:
    return default if option is None else option
