"""Analytic obstacles: signed distance and its derivatives, outlines, volume and inertia."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import minimize
from scipy.spatial import cKDTree

from fracsim.contact.shapes import SHAPES, Capsule, HalfSpace, RoundedBox, RoundedCylinder, Shape, Sphere
from fracsim.errors import InputError
from support.shapes import ALL, BODIES, HOLLOW, differences, enclosed, facing, points, sampled

pytestmark = pytest.mark.any_release

EPS = np.finfo(float).eps
all_shapes = pytest.mark.parametrize("shape", ALL.values(), ids=ALL.keys())
bodies = pytest.mark.parametrize("shape", BODIES.values(), ids=BODIES.keys())
closed = pytest.mark.parametrize("shape", (BODIES | HOLLOW).values(), ids=(BODIES | HOLLOW).keys())


@closed
def test_distance_is_that_to_the_closest_point_of_the_surface(shape: Shape) -> None:
    """Brute force over 200000 random points of the outline.

    They lie up to r (1 - cos 3.75 degrees) < 2e-3 below arcs of radius r < 0.7, and about 0.02 apart, which adds
    0.02^2 / (2 d) < 2e-3 at distances d > 0.1.
    """
    at, elements = shape.tessellate()
    x = points(shape, 2000)
    exact = shape.distance(x)
    clear = abs(exact) > 0.1
    tree = cKDTree(sampled(at, elements, 200_000), balanced_tree=False, compact_nodes=False)  # quicker to build
    brute, _ = tree.query(x[clear])
    assert clear.sum() > 1000 and abs(shape.distance(at)).max() < 20 * EPS
    np.testing.assert_allclose(abs(exact[clear]), brute, atol=4e-3)
    filled = -exact if shape in HOLLOW.values() else exact
    within = (abs(x) < 0.1).all(axis=1)
    assert (filled[within] < 0).all() and (filled[np.linalg.norm(x, axis=1) > 1.1] > 0).all()


CORES = {  # the sharp core |x_i| <= limit_i, and what it is grown by: written down by hand
    "rectangle": ([0.45, 0.25], 0.15),
    "box": ([0.45, 0.25, 0.35], 0.15),
    "capsule": ([0, 0, 0.55], 0.3),
    "sphere": ([0, 0, 0], 0.7),
    "stadium": ([0, 0.55], 0.3),
}


@pytest.mark.parametrize("name", CORES)
def test_distance_from_outside_is_the_least_over_the_body(name: str) -> None:
    """min |x - y| over the core by SciPy, less the rounding."""
    limits, grown = CORES[name]
    shape = BODIES[name]
    if isinstance(shape, Capsule):  # the same along the last axis
        shape = Capsule(shape.radius, shape.length, axis=tuple(np.eye(len(limits))[-1]))
    x = points(shape, 40, seed=3)
    x = x[shape.distance(x) > 0.05]
    assert len(x) > 5
    within = [(-limit, limit) for limit in limits]
    for each, distance in zip(x, shape.distance(x), strict=True):
        found = minimize(lambda y, at=each: ((y - at) ** 2).sum(), 0 * each, bounds=within, tol=1e-14)
        assert distance == pytest.approx(np.sqrt(found.fun) - grown, abs=1e-6)


@all_shapes
def test_normal_and_curvature_are_derivatives(shape: Shape) -> None:
    """By central differences, away from where the distance has kinks (inside) or its Hessian jumps."""
    x = points(shape, 500, seed=1)
    D = differences(shape.distance, x)
    smooth = np.abs(np.linalg.norm(D, axis=1) - 1) < 1e-6  # differences across a kink are shorter
    assert smooth.mean() > 0.95
    n, H, bent = shape.normal(x), shape.curvature(x), differences(shape.normal, x)
    np.testing.assert_allclose(np.linalg.norm(n, axis=1), 1, atol=10 * EPS)
    np.testing.assert_allclose(n[smooth], D[smooth], atol=1e-8)
    jump = np.abs(bent).max(axis=(1, 2)) > 1e4
    np.testing.assert_allclose(H[~jump], bent[~jump], atol=1e-6)
    assert jump.mean() < 0.01
    np.testing.assert_allclose(H, H.transpose(0, 2, 1), atol=1e-12)
    np.testing.assert_allclose(np.einsum("nij,nj->ni", H, n), 0, atol=1e-11)


@all_shapes
@given(seed=st.integers(0, 10**6))
def test_distance_is_1_lipschitz(shape: Shape, seed: int) -> None:
    """|d(x) - d(y)| <= |x - y|: what conservative advancement rests on."""
    x, y = points(shape, 50, seed), points(shape, 50, seed + 1)
    change = np.abs(shape.distance(x) - shape.distance(y))
    assert (change <= np.linalg.norm(x - y, axis=1) + 10 * EPS).all()


@all_shapes
def test_middle_planes_and_axes_are_no_exception(shape: Shape) -> None:
    """Points on the axes, and the centre, give finite values; outside, those of a point beside them."""
    x = np.concatenate([np.zeros((1, shape.dim)), *(s * np.eye(shape.dim) for s in (-1.3, -0.1, 0.1, 1.3))])
    for values in (shape.distance(x), shape.normal(x), shape.curvature(x)):
        assert np.isfinite(values).all()
    np.testing.assert_allclose(np.linalg.norm(shape.normal(x), axis=1), 1, atol=10 * EPS)
    far = np.concatenate([-1.3 * np.eye(shape.dim), 1.3 * np.eye(shape.dim)])
    beside = far + 1e-9 * np.arange(1, shape.dim + 1)
    np.testing.assert_allclose(shape.normal(far), shape.normal(beside), atol=1e-7)
    np.testing.assert_allclose(shape.curvature(far), shape.curvature(beside), atol=1e-6)


def test_a_core_without_thickness_curves_on_its_middle_plane() -> None:
    """A box as round as can be is a stadium, on the plane z = 0 too."""
    box, stadium = RoundedBox((1.6, 0.6), rounding=0.3), Capsule(0.3, 1.0, axis=(1.0, 0.0))
    x = np.concatenate([points(box, 100), [[1.0, 0.0], [0.0, 1.0], [0.5, 0.7]]])
    np.testing.assert_allclose(box.distance(x), stadium.distance(x), atol=10 * EPS)
    np.testing.assert_allclose(box.curvature(x), stadium.curvature(x), atol=1e-9)


def test_distance_is_c1_over_a_rounded_edge() -> None:
    """Along a path around the edge of box and cylinder the normal turns by no more than the way over the fillet."""
    turn = np.linspace(0, 2 * np.pi, 20001)[:, None]
    x = np.hstack([np.cos(turn), 0.2 * np.ones_like(turn), np.sin(turn)])
    for shape in (BODIES["sharper box"], BODIES["sharper cylinder"]):
        outside = shape.distance(x) > 0
        assert outside.all()
        n = shape.normal(x)
        way = np.linalg.norm(np.diff(x, axis=0), axis=1)
        assert (np.linalg.norm(np.diff(n, axis=0), axis=1) <= way / 0.01 + EPS).all()


@closed
def test_outline_is_closed_faces_out_and_has_the_volume(shape: Shape) -> None:
    """Every edge (2D: point) once in either direction; volume by the divergence theorem within 1 %."""
    at, elements = shape.tessellate()
    sides = [(0, 1), (1, 2), (2, 0)] if shape.dim == 3 else [(0,), (1,)]
    if shape.dim == 3:
        edges = Counter(tuple(element[list(side)]) for element in elements for side in sides)
        assert set(edges.values()) == {1} and all((b, a) in edges for a, b in edges)
    else:
        assert sorted(elements[:, 0]) == sorted(elements[:, 1]) == list(range(len(at)))
    sign = -1 if shape in HOLLOW.values() else 1
    volume = enclosed(at, elements)
    assert 0.99 * shape.volume < sign * volume < shape.volume
    normals, middles = facing(at, elements)
    # a flat element over an arc of 7.5 degrees
    assert (np.einsum("ni,ni->n", normals, shape.normal(middles)) > 0.99).all()
    assert len(np.unique(elements)) == len(at)


@pytest.mark.parametrize("direction", ((0.0, 0.0, 2.0), (1.0, -2.0, 3.0), (0.0, 1.0), (1.0, -2.0)))
def test_outline_of_a_plane_is_a_patch(direction: tuple[float, ...]) -> None:
    """On the plane, of the given size, facing out."""
    plane = HalfSpace(direction, extent=3.0)
    at, elements = plane.tessellate()
    normals, middles = facing(at, elements)
    np.testing.assert_allclose(plane.distance(at), 0, atol=20 * EPS)
    np.testing.assert_allclose(normals, plane.normal(middles), atol=20 * EPS)
    assert np.linalg.norm(at[1] - at[0]) == pytest.approx(3.0)


@bodies
def test_volume_and_inertia_by_quadrature(shape: Shape) -> None:
    """Mid-points of a fine lattice, cells at the surface by the share that a linear distance gives them.

    The share is exact for a plane along the lattice, and off by O(h^2) of the surface otherwise: 2e-3 is enough.
    """
    steps = 120 if shape.dim == 3 else 1200
    line = (np.arange(steps) + 0.5) / steps * 2.4 - 1.2
    x = np.stack(np.meshgrid(*[line] * shape.dim, indexing="ij"), axis=-1).reshape(-1, shape.dim)
    h = 2.4 / steps
    weight = np.clip(0.5 - shape.distance(x) / h, 0, 1) * h**shape.dim
    S = np.einsum("n,ni,nj->ij", weight, x, x, optimize=True)
    inertia = np.trace(S) * np.eye(3) - S if shape.dim == 3 else np.trace(S)
    assert weight.sum() == pytest.approx(shape.volume, rel=2e-3)
    found = shape.inertia(7.0)
    np.testing.assert_allclose(found, 7.0 * inertia, atol=2e-3 * np.max(found))


def test_closed_forms_of_the_books() -> None:
    """Sphere 2/5 m r^2; disk 1/2 m r^2; with vanishing rounding, box m (b^2 + c^2) / 12 and cylinder 1/2 m R^2.

    Of rounded ones: a sphere is the box and the capsule with no core; a capsule's volume is ball plus cylinder.
    """
    sphere, disk = Sphere(0.5), Sphere(0.5, dim=2)
    np.testing.assert_allclose(sphere.inertia(3.0), 3 * sphere.volume * 0.4 * 0.25 * np.eye(3), rtol=1e-14)
    assert sphere.volume == pytest.approx(np.pi / 6) and disk.volume == pytest.approx(np.pi / 4)
    assert float(disk.inertia(3.0)) == pytest.approx(3 * disk.volume * 0.125, rel=1e-14)
    box = RoundedBox((1.0, 2.0, 3.0), rounding=1e-9)
    np.testing.assert_allclose(box.inertia(1.0), 6 / 12 * np.diag([13, 10, 5]), atol=1e-7)
    cylinder = RoundedCylinder(0.5, 2.0, rounding=1e-9)
    mass, across = np.pi / 2, 0.25 / 4 + 4 / 12
    np.testing.assert_allclose(cylinder.inertia(1.0), mass * np.diag([across, across, 0.125]), atol=1e-7)
    np.testing.assert_allclose(RoundedBox((1.0, 1.0, 1.0), rounding=0.5).inertia(3.0), sphere.inertia(3.0), atol=1e-14)
    assert Capsule(0.5, 2.0).volume == pytest.approx(sphere.volume + np.pi / 4 * 2)


@pytest.mark.parametrize("name", ("sphere", "cylinder", "box"))
def test_hollow_is_the_same_surface_from_inside(name: str) -> None:
    """Signs reversed, the room inside as volume, and no inertia."""
    filled = BODIES[name]
    hollow = HOLLOW[{"sphere": "bowl", "cylinder": "drum", "box": "container"}[name]]
    x = points(filled, 50)
    for of in ("distance", "normal", "curvature"):
        np.testing.assert_array_equal(getattr(hollow, of)(x), -getattr(filled, of)(x))
    assert hollow.volume == filled.volume
    assert hollow.distance(np.zeros((1, 3)))[0] > 0
    with pytest.raises(InputError, match="hold it"):
        hollow.inertia(1.0)


@all_shapes
def test_no_points(shape: Shape) -> None:
    """A rank may have none."""
    x = np.empty((0, shape.dim))
    d = shape.dim
    assert [each(x).shape for each in (shape.distance, shape.normal, shape.curvature)] == [(0,), (0, d), (0, d, d)]


def test_names() -> None:
    assert {name: each.kind for name, each in SHAPES.items()} == {name: name for name in SHAPES}
    assert {RoundedBox, Capsule, RoundedCylinder, HalfSpace, Sphere} == set(SHAPES.values())


@pytest.mark.parametrize(
    ("wrong", "message"),
    (
        (lambda: Sphere(-1.0), "radius of a sphere is -1.0"),
        (lambda: Sphere(1.0, dim=4), "4 dimensions"),
        (lambda: Capsule(1.0, float("inf")), "length of a capsule is inf"),
        (lambda: HalfSpace((0.0, 0.0)), "no direction"),
        (lambda: RoundedBox((1.0,)), "2 or 3"),
        (lambda: RoundedBox((1.0, 0.0)), "size of a box is 0.0"),
        (lambda: RoundedBox((1.0, 2.0), rounding=0.6), "at most 0.5 m"),
        (lambda: RoundedBox((1.0, 2.0), rounding=0.0), "rounding of a box is 0.0"),
        (lambda: RoundedCylinder(1.0, 1.0, axis=(1.0, 0.0)), "3 numbers"),
        (lambda: RoundedCylinder(1.0, 4.0, rounding=1.0), "take a capsule"),
        (lambda: HalfSpace((0.0, 1.0)).inertia(1.0), "hold it or drive it"),
    ),
)
def test_what_is_no_shape_is_said(wrong: object, message: str) -> None:
    assert callable(wrong)
    with pytest.raises(InputError, match=message):
        wrong()
