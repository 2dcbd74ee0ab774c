"""Prose and claims of `chapter.observer`, from its facts."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping
from typing import Any

from chapter.markdown import table
from chapter.part import Claim

Facts = Mapping[str, Any]
WIDTH = 112


def _s(value: float | None) -> str:
    return "not" if value is None else f"{value:g} s"


def text(facts: Facts) -> str:
    """The page below its title."""
    start, cut = facts["initial"], facts["truncation"]
    grid = facts["straight"]["corrected"]["(18)"]
    higher = facts["scheduled"]["chapter"]["(18)"]["share_of_higher_modes"]
    whole, small = (facts["scheduled"][k]["(18)"] for k in ("chapter", "a tenth of chapter"))
    page = f"""\
## What is simulated
*Grid.* Ten cells over [0, 1] m. Even derivatives by second-order central differences, odd ones by
first-order one-sided ones, the clamped root and the free tip by ghost points (`plant/differences.py`). On
smooth fields the orders are 2 and 1, and the frequencies of the straight arm converge to the closed form
with order 2 (1 % at ten cells). "Upwind" has no meaning for this system: waves run both ways, nothing is
blown along. The side taken here is the root's, whose two values are given; the tip's changes the growth
rates below by {_share(cut, "growth_odd_towards_tip_per_s")} at setpoints 1, 2, 3. The chapter's four
conditions on u leave a stretch u = s unopposed (a double eigenvalue 0); two conditions (u = 0 at the root,
u_s = 0 at the tip) are used.

*Initial condition.* x_3(s, 0) = 2 s^2 - 8/3 s^3 + s^4, all else 0, is read as the error at t = 0: in (15)
it makes no difference whether x is the whole displacement or the deviation from a setpoint. It does for the
schedule: the tip stands at {start["sector_deg_if_whole"]:g} degrees (sector 1) or, about setpoint 1, at
{start["sector_deg_if_about_setpoint_1"]:g} degrees (sector 2, by less than a degree). w_sss(1, 0) =
{start["w_sss_at_tip"]:g}, not 0: the tip's shear condition is violated, so d_s^4 of it has no integral that
agrees with T: 24 as written, 16 with the tip's condition put in (z(0) = {start["z"]:g} on ten cells, first
order). Summed over the grid, the fourth differences of w do not tend to their integral but to 2/3 of it
({start["sum_of_differences"]:g} and {start["sum_in_the_limit"]:g} here): at s_1 the even ghost point is off
by w_sss / (3 ds). So z and y_2 are taken as -w_sss(0), which the integral is.

*Regulated output.* z = int d_s^4 e_w ds = -e_w'''(0), the root's shear, is the second measured output at
the same time. With D_ij = 0 it is measured exactly: gamma of (16) on the grid is the weight that the noise
of y_2 is given ({_weights(facts)}), and goes to 0 with it. All gains here have noise weights.

*Gains.* "(18)": the inequality on energy states with the chapter's two outputs, epsilon = 1
(`chapter/lpi_gains.py`), designed with octarm's drag. "(16) on the grid": the LMI of section 3.4.1 for w on
the ten cells, epsilon = 10: the order of the chapter's steps turned round. "octarm": the shipped artefact,
which measures (v_y, k) in every segment. "No correction": the model alone.

## Fig. 4a: error dynamics (15) about the straight arm
![Regulated output and tip error over time](observer-output.png)

{_straight_table(facts)}

The first bending mode, which is what one sees for long, decays as its eigenvalue says. Without drag nothing
but the gain can take energy out, and the gains of (18), made for the arm and not for ten cells, push
{grid["growing_pairs"]} of its ten modes a little, the fastest: they grow at {grid["slowest_rate_per_s"]:g}
1/s (rho A), from almost nothing; with the drag everything decays. Rates fitted to the time series agree
with the eigenvalues of A + L C. With rho A all times are 22.6 times shorter, but the chapter's w(t) =
sin(t)/(10 t) N/m then swings the linear arm by
{facts["straight"]["corrected"]["no correction"]["largest_tip_m"]:g} m (printed:
{facts["straight"]["printed"]["no correction"]["largest_tip_m"]:g} m); octarm reads it as a force per
volume, which gives the printed acceleration. The error does not forget w(t) faster than w(t) fades, as 1/t.

## Fig. 4b and 5: the scheduled observer
![Arm and estimate at several times](observer-shapes.png)
![Tip error from several initial conditions](observer-initial.png)
![Three origins of the gains](observer-origins.png)

Right: the exact arm (1) on 40 cells, ten segments, ticks of 0.1 s, drag, w(t) as a body force, no noise, no
feedback; the loads hold setpoint 1, where the estimate starts. The gains are those of the 30-degree sector
in which the estimated tip is (2 degrees of hysteresis). Error of the tip:

{_scheduled_table(facts)}

It converges from every start, also through changes of gains. What is left at the end is not the arm's
nonlinearity: a tenth of the deviation leaves {1e2 * small["last_tenth_m"] / small["first"]:.1f} % of the
first error, the whole {1e2 * whole["last_tenth_m"] / whole["first"]:.1f} %. The tip's error is then mostly
the first mode's, in which the arm itself still swings ({1e2 * (1.0 - higher["tip"]):.0f} % of its power in
the last 100 s); z is made of the higher modes ({1e2 * higher["z"]:.1f} %), which the chapter's two outputs
hardly damp: from the chapter's start it falls no faster than without correction, from the straight arm,
which has few of them, it does.

## A large epsilon
![Tip error for several epsilon](observer-epsilon.png)

{_epsilon_table(facts)}

On the grid it is as the chapter says: faster, at the price of gain and gamma. For the arm what is
*certified* gets faster (epsilon / (2 |P|)), and gamma grows, but the first mode decays a little slower: the
inequality asks for decay in all modes at once and P grows with epsilon.

## What (2) and (5) do
![Growth rates and truncated model](observer-truncation.png)

*(2) from the chapter's initial condition* leaves for infinity after
{cut["leaves_s"]["printed"]["corrected"]:g} s (printed rho) or {cut["leaves_s"]["corrected"]["corrected"]:g}
s (rho A), in either form of its last products. Its energy is cut off after the third order and has no lower
bound: with u_x = -w_x^2/2 it is EI w_xx^2/2 - EA w_x^4/8. The slopes of the initial condition reach
{start["largest_slope"]:g}. Scaled down, the tip's error against (1) over one period is

{_truncation_table(cut)}

*(5) at the setpoints* is unstable on any grid, in two bands of wave numbers: k > k_2 (theory, section 1,
found by grids fine enough) and k < k_1, which ten cells see well. Leading terms, c the largest w_e' over the
printed 0 <= x <= 1 (cut at the arclength 1 m: the page of the model), alpha = 80:
growth where alpha k < c |k^2 - alpha^2|. The lower band is the truncation's: the matrix [[1, c], [c, 0]] of
the axial energy in (u_x, w_x) has a negative eigenvalue, and [[1, c], [c, 3 c^2 / 2]], with the terms of
third order in the equations, has none. The exact model (1), linearised at the same shapes, has no growing
mode.

{_growth_table(cut)}

So the schedule's models are unstable at every setpoint, and the gains of (18), made for the arm, change
nothing of that. An observer of (5) must pin its growing modes by
two outputs: for (16) on ten cells the solver {_solved(facts)}, and Riccati gains in the same units are
above 10^6 (the norm of L in the table above: below 10^3). Nor are the setpoints solutions of (2) with u_e =
0 (section 2.2): the first equation is left with up to {cut["setpoints"]["1"]["axial_residual_n_per_m"]:g}
N/m at setpoint 1, twelve times w(0). This is why the scheduled experiment stands beside (1).

## As a plant
`plant_model` of a scenario (or `octarm run --plant-model`): `exact`, `quadratic` (2), `linear` (4) at the
setpoint of the start, and both `-printed`, on the chapter's grid. An arm that leaves ends the run with a
safety stop: `octarm run --scenario chapter` after {_ticks(cut)}.
"""
    return "\n\n".join(map(_filled, page.split("\n\n")))


def _filled(paragraph: str) -> str:
    """Prose in lines of one length; headings, figures and tables as they are."""
    found: list[str] = []
    prose: list[str] = []
    for line in [*paragraph.split("\n"), ""]:
        if line and not line.startswith(("#", "!", "|")):
            prose.append(line)
            continue
        words = " ".join(prose)
        found += textwrap.wrap(words, WIDTH, break_long_words=False, break_on_hyphens=False)
        prose = []
        found.append(line)
    return "\n".join(found[:-1])


def _weights(facts: Facts) -> str:
    return ", ".join(
        f"weight {one['weight_of_y2']:g}: gamma {one['gamma']:g}"
        for one in facts["noise_to_nothing"].values()
    )


def _solved(facts: Facts) -> str:
    names = [name for name, one in facts["at_setpoints"].items() if one["lmi_solved"]]
    return f"finds gains at setpoint {', '.join(names)} only" if names else "finds none at any"


def _ticks(cut: Facts) -> str:
    found = cut["plant_leaves_after_ticks"].items()
    return ", ".join(f"{ticks} ticks with `{model}`" for model, ticks in found)


def _share(cut: Facts, key: str) -> str:
    return ", ".join(
        f"{100.0 * (one[key] / one['growth_per_s']['10'] - 1.0):+.1f} %"
        for one in cut["setpoints"].values()
    )


def _straight_table(facts: Facts) -> str:
    rows = []
    for constants, title in (("printed", "printed rho"), ("corrected", "rho A")):
        for name, one in facts["straight"][constants].items():
            rows.append(
                (
                    title,
                    name,
                    _s(one["tip"]["below_10_s"]),
                    _s(one["tip"]["below_1_s"]),
                    _s(one["z"]["below_10_s"]),
                    f"{one['first_mode_rate_per_s']:g}",
                    f"{one['slowest_rate_per_s']:g}",
                    f"{one['fitted_rate_per_s']:g}",
                )
            )
    return table(
        (
            "mass",
            "gains",
            "tip error below 10 % after",
            "1 %",
            "z below 10 % after",
            "first mode, 1/s",
            "slowest mode, 1/s",
            "fitted late, 1/s",
        ),
        rows,
    )


def _scheduled_table(facts: Facts) -> str:
    rows = []
    for start, some in facts["scheduled"].items():
        for origin, one in some.items():
            rows.append(
                (
                    start,
                    origin,
                    f"{1e3 * one['first']:.0f} mm",
                    _s(one["below_10_s"]),
                    f"{1e3 * one['last_tenth_m']:g} mm",
                    f"{one['z_first_tenth']:g}",
                    f"{one['z_last_tenth']:g}",
                    len(one["changes_s"]),
                )
            )
    return table(
        (
            "arm starts at",
            "gains",
            "first",
            "below 10 % after",
            "largest in the last 20 s",
            "z, largest in the first 20 s, 1/m^2",
            "in the last",
            "changes of gains",
        ),
        rows,
    )


def _epsilon_table(facts: Facts) -> str:
    rows = []
    for origin, some in facts["epsilon"].items():
        for value, one in some.items():
            decay = one.get("decay", one.get("first_mode_decay"))
            rows.append(
                (
                    origin,
                    value,
                    f"{one['gamma']:g}",
                    f"{one['gain_norm']:g}" if "gain_norm" in one else "",
                    f"{decay:g}",
                    f"{one['certified_decay']:g}" if "certified_decay" in one else "",
                    _s(one["below_10_s"]),
                    _s(one["below_1_s"]),
                )
            )
    return table(
        (
            "gains",
            "epsilon",
            "gamma",
            "norm of L",
            "decay (grid: slowest; arm: first mode)",
            "certified decay",
            "tip error below 10 % after",
            "1 %",
        ),
        rows,
    )


def _truncation_table(cut: Facts) -> str:
    rows = [
        (f"{amplitude} x_3", "leaves" if error is None else f"{100.0 * error:g} %")
        for amplitude, error in cut["tip_error_of_the_period"].items()
    ]
    return table(("initial condition", "largest error of the tip"), rows)


def _growth_table(cut: Facts) -> str:
    names = list(cut["setpoints"])
    setpoints = [cut["setpoints"][name] for name in names]
    grids = setpoints[0]["growth_per_s"]
    rows = [
        [f"growth, {cells} cells, 1/s", *(f"{one['growth_per_s'][cells]:g}" for one in setpoints)]
        for cells in grids
    ]
    for key, title in (
        ("growth_printed_matrices_per_s", "growth, 10 cells, (5) as printed, 1/s"),
        ("growth_with_gains_per_s", "growth of the error, 10 cells, gains of (18), 1/s"),
        ("growth_printed_rho_per_s", "growth, 10 cells, printed rho, 1/s"),
        ("bound_per_s", "fastest wave of the lower band, 1/s"),
        ("grows_below_per_m", "k_1, 1/m"),
        ("grows_above_per_m", "k_2, 1/m"),
        ("exact_model_per_s", "growth, (1) at the same shape, 1/s"),
    ):
        rows.append([title, *(f"{one[key]:g}" for one in setpoints)])
    return table(["", *(f"setpoint {n}" for n in names)], rows)


def claims(facts: Facts) -> tuple[Claim, ...]:
    """What section 4.1 says and what was found."""
    start, cut = facts["initial"], facts["truncation"]
    straight, beside = facts["straight"], facts["scheduled"]
    grid, arm = facts["epsilon"]["grid (16)"], facts["epsilon"]["arm (18)"]
    soft, hard = grid["1"], grid["10"]
    low, high = arm["0.001"], arm["10"]
    printed = straight["printed"]
    return (
        Claim(
            "4.1, grid",
            "second-order central and first-order upwind-biased differences on 10 cells",
            "orders 2 and 1; there is no wind, so the side of the odd ones is a choice",
            holds=True,
        ),
        Claim(
            "4.1, initial condition",
            "x_3(s, 0) = 2 s^2 - 8/3 s^3 + s^4",
            f"w_sss(1) = {start['w_sss_at_tip']:g}, the free tip asks for 0",
            holds=False,
        ),
        Claim(
            "2.1, boundary conditions of u",
            "four",
            "on the grid a stretch u = s has no force against it; two conditions belong to u",
            holds=False,
        ),
        Claim(
            "2.2, setpoints",
            "(u_e, w_e) = (0, w_e) is a solution of the PDE",
            f"the first equation of (2) is left with "
            f"{cut['setpoints']['1']['axial_residual_n_per_m']:g} N/m at setpoint 1",
            holds=False,
        ),
        Claim(
            "4.1, simulation of (2)",
            "solved from the initial condition",
            f"leaves for infinity after {cut['leaves_s']['printed']['corrected']:g} s "
            f"(rho A: {cut['leaves_s']['corrected']['corrected']:g} s)",
            holds=False,
        ),
        Claim(
            "(5) at setpoints 1, 2, 3",
            "models of the arm near the setpoint",
            "unstable on ten cells, growth "
            + ", ".join(f"{one['growth_printed_rho_per_s']:g}" for one in cut["setpoints"].values())
            + " 1/s with the printed rho; (1) linearised there has no growing mode",
            holds=False,
        ),
        Claim(
            "(22), D_ij = 0",
            "an H-infinity-optimal observer",
            "z is measured without noise: gamma of (16) is the weight of its noise and goes to 0 with it",
            holds=False,
        ),
        Claim(
            "Fig. 4a",
            "the error asymptotically converges to zero",
            f"about the straight arm, gains of (18): tip error below 10 % after "
            f"{_s(printed['(18), drag']['tip']['below_10_s'])}, below 1 % after "
            f"{_s(printed['(18), drag']['tip']['below_1_s'])}, with drag; without, the fastest waves grow",
            holds=True,
        ),
        Claim(
            "Fig. 4b",
            "the estimate approximates the actual shape",
            "exact arm from setpoint 2: "
            f"{1e3 * beside['setpoint 2']['(18)']['first']:.0f} mm of tip error become "
            f"{1e3 * beside['setpoint 2']['(18)']['last_tenth_m']:g} mm",
            holds=True,
        ),
        Claim(
            "Fig. 5",
            "the gain-scheduled observer converges for different initial conditions",
            "from four starts beside the exact arm, with up to "
            f"{max(len(some['(18)']['changes_s']) for some in beside.values())} changes of gains",
            holds=True,
        ),
        Claim(
            "4.1, large epsilon",
            "faster, with higher gains and a higher norm",
            f"(16) on the grid: decay {soft['decay']:g} -> {hard['decay']:g}, gain "
            f"{soft['gain_norm']:g} -> {hard['gain_norm']:g}, gamma "
            f"{soft['gamma']:g} -> {hard['gamma']:g} for epsilon 1 -> 10",
            holds=True,
        ),
        Claim(
            "4.1, large epsilon in (18)",
            "the observer state converges faster",
            f"certified decay {low['certified_decay']:g} -> {high['certified_decay']:g}, but the first mode's "
            f"{low['first_mode_decay']:g} -> {high['first_mode_decay']:g} for epsilon 0.001 -> 10",
            holds=False,
        ),
        Claim(
            "4.1, rho = 1.1e3",
            "mass per length",
            "everything is 22.6 times slower than with rho A = 2.16 kg/m",
            holds=False,
        ),
    )
