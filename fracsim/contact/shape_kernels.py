"""Compiled distances to analytic shapes at a pose, closest points of facets, and energies of facets.

They replace dozens of array operations on a few rows each. Their plain counterparts are `shapes`, `closest_point` and
`facet_contact.FacetEnergy`, with `[solver] plain = true` or without a compiler.
"""

from __future__ import annotations

from collections.abc import Hashable
from ctypes import CDLL
from dataclasses import replace
from enum import IntEnum
from functools import lru_cache
from pathlib import Path
from typing import Any, cast

import numpy as np
from mpi4py import MPI

from ..array_types import Values
from ..mesh.c_library import FAST_FLAGS, compile_on_all_ranks
from .closest_point import SEARCH
from .laws import BARRIER, Barrier
from .shape_base import ConvexBody, Shape, frame_about, unit_vector
from .shapes import HalfSpace, RevolvedBody, RoundedBox, TranslatedShape

SOURCE = Path(__file__).with_suffix(".c")
_SEARCH = np.array([
    SEARCH.max_iterations, SEARCH.max_trials, SEARCH.slope_reduction, SEARCH.flat_distance, SEARCH.min_change,
    SEARCH.round_off,
])  # fmt: skip


class ShapeKind(IntEnum):
    """Kinds of shapes, numbered as in shape_kernels.c."""

    HALF_SPACE = 0
    SWEPT_SPHERE = 1
    BOX = 2
    CYLINDER = 3


class CompiledShapeKernels:
    """Functions of shape_kernels.c (shape_base.ShapeKernels)."""

    def __init__(self, code: CDLL) -> None:
        self._code = code

    def used_for(self, shape: Shape) -> Shape:
        """The shape, evaluated by these functions."""
        return cast("Shape", replace(cast("Any", shape), kernels=self))

    def pack(self, shape: Shape, centre: Values, rotation: Values) -> Values:
        """Numbers of a shape at a pose of centre (d,), m, and rotation (d, d): `Obstacle` of shape_kernels.c."""
        d, packed = len(centre), _pack_shape(cast("Hashable", shape)).copy()
        packed[3 : 3 + d] = centre
        packed[6:15].reshape(3, 3)[:d, :d] = rotation
        return packed

    def distance(self, packed: Values, x: Values) -> Values:
        """(n,) signed distances of points x (n, d), m."""
        result = np.empty(len(x))
        self._code.evaluate_shape(*x.shape, packed, _numbers(x), result, None, None)
        return result

    def normal(self, packed: Values, x: Values) -> Values:
        """(n, d) gradients of the distance."""
        result = np.empty(x.shape)
        self._code.evaluate_shape(*x.shape, packed, _numbers(x), None, result, None)
        return result

    def curvature(self, packed: Values, x: Values) -> Values:
        """(n, d, d) Hessians of the distance, 1/m."""
        result = np.empty((*x.shape, x.shape[1]))
        self._code.evaluate_shape(*x.shape, packed, _numbers(x), None, None, result)
        return result

    def find_closest_points(
        self, packed: Values, x: Values, smoothing: float, tolerance: float, barycentric: Values
    ) -> None:
        """Search for the closest points of facets (shape_base.ShapeKernels)."""
        self._code.find_closest_points(*x.shape, packed, _numbers(x), smoothing, tolerance, _SEARCH, barycentric)

    def facet_energy(
        self,
        packed: Values,
        x: Values,
        barycentric: Values,
        smoothing: float,
        law: Barrier,
        start: Values | None,
        area: Values,
        *,
        second: bool,
    ) -> tuple[Values, Values]:
        """Energy F of facets and its derivatives (facet_contact).

        Args:
            packed: the shape at its pose.
            x: (k, c, d) corners, m.
            barycentric: (k, c) of the closest points.
            smoothing: mu, m.
            law: b.
            start: (k, c + 2) gaps at the start of the step, of the closest points, the smoothed minima and the corners,
                m; None: the barrier is not averaged.
            area: (k,) m^2.
            second: which derivatives are computed.

        Returns:
            (k,) F, J, and (k, c, d) forces, N; or (k, c d, c d) second derivatives of F, N/m, and (k, c, d, d) of b at
            the corners, Pa/m.
        """
        k, c, d = x.shape
        shapes = ((k, c * d, c * d), (k, c, d, d)) if second else ((k,), (k, c, d))
        results = np.empty(shapes[0]), np.empty(shapes[1])
        numbers = np.array([law.stiffness, law.width, BARRIER.early_weight, BARRIER.closed_value])
        self._code.evaluate_facets(
            *x.shape, packed, _numbers(x), _numbers(barycentric), smoothing, numbers,
            None if start is None else _numbers(start), _numbers(area),
            *((None, None, *results) if second else (*results, None, None)),
        )  # fmt: skip
        return results


def _numbers(values: Values) -> Values:
    """Contiguous array of the values."""
    return np.ascontiguousarray(values, np.float64)


def compile_shape_kernels(comm: MPI.Comm) -> CompiledShapeKernels | None:
    """Compiled functions of shapes; None without a compiler (collective)."""
    code = compile_on_all_ranks(comm, SOURCE.stem, SOURCE.read_text(encoding="utf-8"), FAST_FLAGS)
    return None if code is None else CompiledShapeKernels(code)


@lru_cache(maxsize=256)
def _pack_shape(original: Hashable) -> Values:
    """Numbers of a shape at the origin: `Obstacle` of shape_kernels.c."""
    growth, origin, shape = 0.0, np.zeros(3), cast("Any", original)
    min_radius = getattr(shape, "min_radius", np.inf)
    while isinstance(shape, TranslatedShape):
        origin[: shape.dim] += shape.offset
        growth, shape = growth + shape.growth, shape.shape
    sign = -1.0 if isinstance(shape, ConvexBody) and shape.hollow else 1.0
    kind, axis, half, radius, fillet = _parameters(shape)
    axes = np.zeros((2, 3))
    axes[0, : len(axis)] = axis
    if kind in (ShapeKind.SWEPT_SPHERE, ShapeKind.CYLINDER):
        axes[1, : len(axis)] = frame_about(axis)[:, 0]
    sizes = np.full(3, np.inf)
    sizes[: len(half)] = half
    fixed = [kind, sign, growth], np.zeros(3), np.eye(3).reshape(-1), origin, [min_radius], axes.reshape(-1)
    return np.concatenate([*fixed, sizes, [radius, fillet]])


def _parameters(shape: Shape) -> tuple[int, Values, Values, float, float]:
    """Kind, axis (d,), half sizes (m,) and radius of the core, and fillet of a shape, m."""
    if isinstance(shape, HalfSpace):
        return ShapeKind.HALF_SPACE, unit_vector(shape.direction), np.empty(0), 0.0, 0.0
    if isinstance(shape, RoundedBox):
        return ShapeKind.BOX, np.empty(0), shape.core, 0.0, shape.fillet
    assert isinstance(shape, RevolvedBody)
    axis, radius, half = shape.core
    kind = ShapeKind.CYLINDER if radius else ShapeKind.SWEPT_SPHERE
    return kind, axis, np.array([half]), radius, shape.fillet
