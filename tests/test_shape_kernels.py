"""Compiled distances, closest points and energies of facets beside their array code."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, cast

import numpy as np
import numpy.typing as npt
import pytest
from mpi4py import MPI

from fracsim.contact.closest_point import find_closest_points
from fracsim.contact.facet_contact import FacetForces
from fracsim.contact.laws import Barrier
from fracsim.contact.pose import Pose, PosedShape
from fracsim.contact.shape_kernels import CompiledShapeKernels, compile_shape_kernels
from fracsim.contact.shapes import (
    Capsule,
    HalfSpace,
    RoundedBox,
    RoundedCylinder,
    Shape,
    Sphere,
    TranslatedShape,
)

Values = npt.NDArray[np.float64]

SHAPES: dict[str, Shape] = {
    "plane": HalfSpace((0.3, -0.2, 1.0)), "line": HalfSpace((0.3, -1.0)), "ball": Sphere(0.3), "disk": Sphere(0.3, 2),
    "capsule": Capsule(0.1, 0.5, (1.0, 0.3, 0.2)), "stadium": Capsule(0.1, 0.5, (1.0, 0.3)),
    "box": RoundedBox((0.5, 0.4, 0.3), 0.05), "rectangle": RoundedBox((0.5, 0.3), 0.05),
    "cylinder": RoundedCylinder(0.25, 0.4, 0.05, (1.0, 0.3, -0.2)), "bowl": Sphere(0.3, hollow=True),
    "tank": RoundedCylinder(0.25, 0.4, 0.05, hollow=True),
    "pendulum": TranslatedShape(RoundedBox((0.5, 0.4, 0.3)), np.array([0.1, 0.2, 0.0])),
    "grown": TranslatedShape(Capsule(0.1, 0.5), np.array([0.0, 0.1, 0.2]), 0.07),
}  # fmt: skip
CONVEX = [name for name, shape in SHAPES.items() if shape.convex and name != "grown"]
WIDTH, SMOOTHING = 0.1, 0.02
LAW = Barrier(3.0, WIDTH)


@pytest.fixture(scope="module")
def kernels() -> CompiledShapeKernels:
    compiled = compile_shape_kernels(MPI.COMM_SELF)
    assert compiled is not None
    return compiled


def compiled_shape(shape: Shape, kernels: CompiledShapeKernels) -> Shape:
    if isinstance(shape, TranslatedShape):
        return cast("Shape", replace(cast("Any", shape), shape=compiled_shape(shape.shape, kernels)))
    return kernels.used_for(shape)


def posed_pair(name: str, kernels: CompiledShapeKernels) -> tuple[PosedShape, PosedShape]:
    """The same shape at the same pose by array code, and compiled."""
    shape, rng = SHAPES[name], np.random.default_rng(3)
    d = shape.dim
    pose = Pose.at_point(rng.normal(size=d)).incremented(rng.normal(size=3 if d == 2 else 6))
    return PosedShape(shape, pose), PosedShape(compiled_shape(shape, kernels), pose)


@pytest.mark.parametrize("name", SHAPES)
def test_distances_are_those_of_array_code(name: str, kernels: CompiledShapeKernels) -> None:
    """At points outside, inside, and on the axes and middle planes, where normals are a choice."""
    plain, compiled = posed_pair(name, kernels)
    rng, d = np.random.default_rng(5), plain.pose.dim
    X = np.concatenate([rng.normal(size=(200, d)) * 0.5, rng.normal(size=(50, d)) * 0.05, np.eye(d) * 0.04])
    x = plain.pose.points_to_space(X)
    np.testing.assert_allclose(compiled.distance(x), plain.distance(x), rtol=1e-12, atol=1e-14)
    np.testing.assert_allclose(compiled.normal(x), plain.normal(x), atol=1e-12)
    np.testing.assert_allclose(compiled.curvature(x), plain.curvature(x), rtol=1e-11, atol=1e-10)
    assert not np.shares_memory(compiled.distance(x[::2]), x)
    np.testing.assert_array_equal(compiled.distance(x[::2]), compiled.distance(x)[::2])


@pytest.mark.parametrize("name", ["ball", "capsule", "cylinder", "box", "rectangle"])
def test_the_centre_has_the_same_normal(name: str, kernels: CompiledShapeKernels) -> None:
    """There every direction is a closest one, across the axis."""
    at_origin = [PosedShape(posed.shape, Pose.at_point(0 * posed.pose.centre)) for posed in posed_pair(name, kernels)]
    x = np.zeros((1, at_origin[0].pose.dim))
    plain, compiled = ([posed.distance(x), posed.normal(x)[0], posed.curvature(x)[0]] for posed in at_origin)
    for values, expected in zip(compiled, plain, strict=True):
        np.testing.assert_allclose(values, expected, atol=1e-14)


def facets_near(posed: PosedShape) -> Values:
    """Facets (k, c, d), of half the obstacle's size to twice that, with gaps of 5 to 120 % of the barrier's width."""
    rng, d, k = np.random.default_rng(1), posed.pose.dim, 24
    x = rng.normal(size=(k, d, d)) * rng.uniform(0.1, 0.5, size=(k, 1, 1))
    away = x.mean(axis=1, keepdims=True)
    x = posed.pose.centre + x + 2 * away / np.linalg.norm(away, axis=2, keepdims=True)  # none is cut
    wanted = rng.uniform(0.05, 1.2, size=k) * WIDTH
    for _ in range(8):
        at = find_closest_points(posed, x, SMOOTHING)
        x = x + (wanted - at.gap)[:, None, None] * at.normal[:, None]
    return x


@pytest.mark.parametrize("name", CONVEX)
def test_closest_points_are_those_of_array_code(name: str, kernels: CompiledShapeKernels) -> None:
    """From a guess, and from the corners; inside the obstacle as well."""
    plain, compiled = posed_pair(name, kernels)
    x = facets_near(compiled)
    at = find_closest_points(plain, x, SMOOTHING)
    inside = x - (at.gap + 0.02 * WIDTH)[:, None, None] * at.normal[:, None]  # not as far as the core
    first = np.eye(x.shape[1])[np.zeros(len(x), int)]
    for corners in (x, inside):
        for start in (None, first):
            expected = find_closest_points(plain, corners, SMOOTHING, start)
            closest = find_closest_points(compiled, corners, SMOOTHING, start)
            np.testing.assert_allclose(closest.gap, expected.gap, atol=1e-13)
            np.testing.assert_allclose(closest.barycentric, expected.barycentric, atol=1e-8)


@pytest.mark.parametrize("name", CONVEX)
def test_facets_through_the_middle_of_an_obstacle_are_cut(name: str, kernels: CompiledShapeKernels) -> None:
    """Against many points of each facet. Where facets went through a middle line, on which the distance is not smooth,
    the search could end at a corner: one facet in twenty that a stadium cuts had an open gap. Depths of cut facets are
    not compared: they are those of a point on such a line, or less."""
    rng = np.random.default_rng(0)
    for posed in posed_pair(name, kernels):
        d = posed.pose.dim
        x = posed.pose.centre + 0.25 * rng.normal(size=(1000, d, d))
        samples = rng.dirichlet(np.full(d, 0.5), size=2000)
        offset = ((samples - 1 / d) ** 2).sum(axis=1)
        least = [posed.distance(samples @ facet) + SMOOTHING / 2 * offset for facet in x]
        gap = np.min(least, axis=1) - SMOOTHING / 2 * (1 - 1 / d)
        for start in (None, np.eye(d)[np.zeros(len(x), int)]):
            closest = find_closest_points(posed, x, SMOOTHING, start).gap
            is_cut = gap < -1e-3
            assert is_cut.sum() > 100 and (closest[is_cut] < 0).all()
            assert (closest[gap > 0] <= gap[gap > 0] + 1e-9).all()


@pytest.mark.parametrize("averaged", [False, True])
@pytest.mark.parametrize("name", CONVEX)
def test_energies_of_facets_are_those_of_array_code(name: str, kernels: CompiledShapeKernels, averaged: bool) -> None:
    """F, forces and second derivatives, from the same closest points; one facet is cut."""
    plain, compiled = posed_pair(name, kernels)
    x = facets_near(compiled)
    x[0] -= 1.5 * WIDTH * find_closest_points(plain, x[:1], SMOOTHING).normal[0]
    closest = find_closest_points(plain, x, SMOOTHING)
    assert (closest.gap <= 0).sum() == 1 and ((closest.gap > 0) & (closest.gap < WIDTH)).sum() > 15
    corners, rng = np.arange(x.shape[0] * x.shape[1]).reshape(x.shape[:2]), np.random.default_rng(2)
    area, gaps = rng.uniform(1.0, 2.0, len(x)), rng.uniform(0.02, 1.2, size=(len(x), x.shape[1] + 2)) * WIDTH
    start = gaps if averaged else None
    expected = FacetForces.from_closest(corners, area, closest, LAW, start)
    forces = FacetForces.from_closest(corners, area, replace(closest, posed=compiled), LAW, start)
    assert np.isinf(forces.energy[0])
    # F is a difference of two values of b, and zero before a plane
    parts = LAW.stiffness * WIDTH, LAW.stiffness, LAW.stiffness / WIDTH, LAW.stiffness / WIDTH
    for name, part in zip(("energy", "forces", "hessian", "corner_hessians"), parts, strict=True):
        values, wanted = getattr(forces, name), getattr(expected, name)
        assert values.shape == wanted.shape
        compared = wanted[1:], values[1:] - wanted[1:]
        scale, error = (abs(array).reshape(len(x) - 1, -1).max(axis=1) for array in compared)
        assert (error <= 1e-11 * (scale + part)).all()
