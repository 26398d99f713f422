"""Shapes to try contact on, points about them, and derivatives by differences."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import numpy.typing as npt

from fracsim.contact.shapes import Capsule, HalfSpace, RoundedBox, RoundedCylinder, Shape, Sphere

Values = npt.NDArray[np.float64]

BODIES: dict[str, Shape] = {
    "disk": Sphere(0.7, dim=2),
    "sphere": Sphere(0.7),
    "stadium": Capsule(0.3, 1.1, axis=(1.0, 2.0)),
    "capsule": Capsule(0.3, 1.1, axis=(1.0, 2.0, -0.5)),
    "rectangle": RoundedBox((1.2, 0.8), rounding=0.15),
    "box": RoundedBox((1.2, 0.8, 1.0), rounding=0.15),
    "sharper box": RoundedBox((1.2, 0.8, 1.0)),
    "cylinder": RoundedCylinder(0.5, 1.4, rounding=0.15, axis=(0.3, -1.0, 0.4)),
    "sharper cylinder": RoundedCylinder(0.5, 1.4),
}
HOLLOW: dict[str, Shape] = {
    "bowl": Sphere(0.7, hollow=True),
    "ring": Sphere(0.7, dim=2, hollow=True),
    "container": RoundedBox((1.2, 0.8, 1.0), rounding=0.15, hollow=True),
    "drum": RoundedCylinder(0.5, 1.4, rounding=0.15, axis=(0.3, -1.0, 0.4), hollow=True),
}
PLANES: dict[str, Shape] = {"plane": HalfSpace((1.0, -2.0, 3.0)), "line": HalfSpace((1.0, -2.0))}
ALL = BODIES | HOLLOW | PLANES


def points(shape: Shape, count: int, seed: int = 0, reach: float = 1.5) -> Values:
    """Random points in a cube about the shape."""
    return np.random.default_rng(seed).uniform(-reach, reach, (count, shape.dim))


def differences(function: Callable[[Values], Values], x: Values, h: float = 1e-6) -> Values:
    """(n, ..., m) central differences of a function of rows x (n, m), each row with its own value."""
    steps = h * np.eye(x.shape[1])
    return np.stack([(function(x + step) - function(x - step)) / (2 * h) for step in steps], axis=-1)


def enclosed(at: Values, elements: npt.NDArray[np.int32]) -> float:
    """Volume (area) within a closed outline, by the divergence theorem: positive where it faces outwards."""
    corners = at[elements]
    dim = at.shape[1]
    return float(np.linalg.det(corners).sum() / (6 if dim == 3 else 2))


def facing(at: Values, elements: npt.NDArray[np.int32]) -> tuple[Values, Values]:
    """Unit normals and middles of triangles or segments; none of those without area."""
    corners = at[elements]
    edges = corners[:, 1:] - corners[:, :1]
    normals = np.cross(edges[:, 0], edges[:, 1]) if at.shape[1] == 3 else edges[:, 0, ::-1] * [1, -1]
    size = np.linalg.norm(normals, axis=1)
    real = size > 1e-12
    return normals[real] / size[real, None], corners.mean(axis=1)[real]


def sampled(at: Values, elements: npt.NDArray[np.int32], count: int, seed: int = 0) -> Values:
    """(count, d) random points of an outline, evenly over its area."""
    rng = np.random.default_rng(seed)
    corners = at[elements]
    edges = corners[:, 1:] - corners[:, :1]
    size = np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]) if at.shape[1] == 3 else edges[:, 0], axis=1)
    chosen = rng.choice(len(elements), count, p=size / size.sum())
    shares = rng.dirichlet(np.ones(elements.shape[1]), count)
    return np.einsum("nk,nkd->nd", shares, corners[chosen])
