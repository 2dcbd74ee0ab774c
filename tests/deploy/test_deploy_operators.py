"""Quadrature of 3-PI operators on the segment grid against the operators themselves."""

import numpy as np
import numpy.typing as npt
import pytest
from deploy_artefacts import operator, random_operator
from numpy.polynomial import legendre

from deploy.grid import Place, SegmentGrid, make_grid
from deploy.operators import interpolation, operator_matrix
from wire.artefact import OperatorFactors

Array = npt.NDArray[np.float64]
LENGTH = 1.3
PLACES = list(Place)


def signal(place: Place, s: Array) -> Array:
    """A smooth function with the boundary value of what lives there: v(0) = 0, e(L) = k(L) = 0."""
    x = s / LENGTH
    if place is Place.OUTER_FACE:
        return np.asarray(np.sin(2.5 * x) + x**3)
    return np.asarray(np.cos(2.0 * x) - np.cos(2.0) + (1.0 - x) * np.exp(x))


def exact(factors: OperatorFactors, source: list[Place], s: float) -> Array:
    """(N x)(s) by Gauss quadrature on both sides of s."""
    nodes, weights = legendre.leggauss(40)
    total = np.zeros(len(factors.n0.coefficients))
    point = np.array([s])
    here = np.array([signal(place, point)[0] for place in source])
    total += factors.n0(point, LENGTH)[0] @ here
    for left, right, start, end in (
        (factors.n1a, factors.n1b, 0.0, s),
        (factors.n2a, factors.n2b, s, LENGTH),
    ):
        t = start + 0.5 * (end - start) * (nodes + 1.0)
        x = np.stack([signal(place, t) for place in source], axis=1)
        inner = np.einsum("t,trb,tb->r", 0.5 * (end - start) * weights, right(t, LENGTH), x)
        total += left(point, LENGTH)[0] @ inner
    return total


def largest_error(
    factors: OperatorFactors, grid: SegmentGrid, to: list[Place], source: list[Place]
) -> Array:
    x = np.stack([signal(place, grid.locations_m(place)) for place in source], axis=1)
    out = (operator_matrix(factors, grid, to, source) @ x.ravel()).reshape(grid.nodes, len(to))
    return np.array(
        [
            max(
                abs(out[i, a] - exact(factors, source, s)[a])
                for i, s in enumerate(grid.locations_m(place))
            )
            for a, place in enumerate(to)
        ]
    )


@pytest.mark.parametrize("spacing", ["equispaced", "chebyshev"])
@pytest.mark.parametrize("source", PLACES)
def test_second_order_between_any_two_places(spacing: str, source: Place) -> None:
    factors = random_operator(11, outputs=3, inputs=1)
    errors = [
        largest_error(factors, make_grid(LENGTH, n, spacing), PLACES, [source]) for n in (16, 64)
    ]
    assert np.max(errors[1]) < 0.02
    # 4 = two halvings at second order squared: a quarter of the width leaves a sixteenth
    assert np.all(errors[0] / errors[1] > 4.0**1.75)


def test_second_order_for_the_whole_controller() -> None:
    source = [Place.OUTER_FACE, Place.OUTER_FACE, Place.CENTRE, Place.INNER_FACE]
    factors = random_operator(12, outputs=1, inputs=4, rank1=3, rank2=1)
    errors = [
        largest_error(factors, make_grid(LENGTH, n, "equispaced"), [Place.OUTER_FACE], source)[0]
        for n in (16, 32, 64)
    ]
    orders = np.log2(np.array(errors[:-1]) / errors[1:])
    np.testing.assert_allclose(orders, 2.0, atol=0.2)


def one_kernel(upper: bool) -> OperatorFactors:
    """N1 = 1 or N2 = 1, all else 0."""
    zero, one = np.zeros((1, 1, 1)), np.ones((1, 1, 1))
    return operator(zero, zero if upper else one, one, one if upper else zero, one)


def test_running_integrals_of_one_are_exact_at_faces() -> None:
    """Sums of dual widths up to a face: the tie's own width is shared by both sides."""
    faces = [0.0, 0.2, 0.7, 0.9, 1.3]
    grid = make_grid(LENGTH, 4, faces)
    place = [Place.INNER_FACE]
    before = operator_matrix(one_kernel(False), grid, place, place) @ np.ones(4)
    np.testing.assert_allclose(before, faces[:-1], atol=1e-15)
    after = operator_matrix(one_kernel(True), grid, place, place) @ np.ones(4)
    # the last dual cell ends at the last centre, since k(L) = 0
    np.testing.assert_allclose(after, 1.1 - np.array(faces[:-1]), atol=1e-15)


def test_ties_are_averaged_and_one_sided_at_the_ends() -> None:
    grid = make_grid(LENGTH, 4, "equispaced")
    width = LENGTH / 4
    lower = operator_matrix(one_kernel(False), grid, [Place.INNER_FACE], [Place.OUTER_FACE])
    upper = operator_matrix(one_kernel(True), grid, [Place.INNER_FACE], [Place.OUTER_FACE])
    # the curvature of node i + 1 and the velocity of node i share a face
    np.testing.assert_allclose(np.diag(lower, -1), 0.5 * width)
    np.testing.assert_allclose(np.diag(upper, -1), 0.5 * width)
    sides = (False, True)
    tip = [operator_matrix(one_kernel(u), grid, [PLACES[0]], [PLACES[0]])[3, 3] for u in sides]
    np.testing.assert_allclose(tip, [0.5 * width, 0.0], atol=1e-15)
    root = [operator_matrix(one_kernel(u), grid, [PLACES[2]], [PLACES[2]])[0, 0] for u in sides]
    np.testing.assert_allclose(root, [0.0, 0.5 * width], atol=1e-15)


def test_multiplier_takes_the_neighbours_value_at_a_shared_face() -> None:
    grid = make_grid(LENGTH, 4, "chebyshev")
    from_velocity = interpolation(grid, Place.INNER_FACE, Place.OUTER_FACE)
    np.testing.assert_allclose(from_velocity, np.eye(4, k=-1), atol=1e-15)
    from_curvature = interpolation(grid, Place.OUTER_FACE, Place.INNER_FACE)
    np.testing.assert_allclose(from_curvature, np.eye(4, k=1), atol=1e-15)
