"""Obstacles that a body is set down on: they act neither on the body at rest nor on each other.

A barrier or penalty acts below a distance D. Where the gap at rest g is less it would throw the body, with an energy
that nobody has put in. An obstacle with g < D is therefore moved back by D - g: a plane along its normal, other shapes
are inset, a hollow one has more room. So the body begins in balance with it, sinks in by a small share of D as it is
pressed, and may also touch it (g = 0). With the usual D an obstacle gives way by a twentieth of an edge at most.

A barrier that begins at g instead would be as stiff as g is small. Second-order schemes rattle on such a barrier, and
friction, which is that of the force at the start of a step, is then up to 2.5 times mu N.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, cast

import numpy as np
import numpy.typing as npt
from mpi4py import MPI

from ..mesh.domain import Domain
from .initial_overlap import free_pairs
from .laws import ObstacleLaw
from .obstacle import RigidObstacle
from .obstacle_pairs import ObstaclePair
from .obstacle_term import ObstacleTerm
from .offset_shape import TranslatedShape
from .shape_base import ConvexBody, Shape
from .shapes import HalfSpace
from .triangle_mesh_shape import TriangleMeshShape, refine_triangles

Values = npt.NDArray[np.float64]

ROUND_OFF = 1e-9  # of the body's size: what overlaps by less touches
CLEAR = 1 + 1e-6  # times the width that a gap at rest is: round-off does not press
LOOKS = 4  # facets are known once their obstacles have been moved back


def build_inactive_at_rest[Term: ObstacleTerm](
    domain: Domain,
    obstacles: Sequence[RigidObstacle],
    law: ObstacleLaw,
    made: Callable[[Sequence[RigidObstacle], ObstacleLaw], Term],
    *,
    mutual: bool,
) -> Term:
    """The term that is `made` of obstacles with a law, none of which acts at rest (collective).

    `mutual`: free obstacles feel others. What overlaps is left to `made`, which refuses it.
    """
    most = np.array([_most(each.shape) for each in obstacles])
    gaps = _gaps_to_nodes(domain, obstacles)
    if mutual:
        _lower_to_others(gaps, obstacles)
    for look in range(LOOKS):
        width = min(law.barrier.width, float((gaps + most).min()) / CLEAR)
        by = np.clip(CLEAR * width - gaps, 0.0, most)
        term = made([offset_obstacle(*each) for each in zip(obstacles, by, strict=True)], _narrowed(law, width))
        found = term.rest_gaps()
        if look == LOOKS - 1 or (found >= width).all():
            break
        term.destroy()
        gaps = np.minimum(gaps, found - by)
    return term


def offset_from_meshes(
    others: dict[int, RigidObstacle], free: Sequence[RigidObstacle], width: float, edge: float
) -> dict[int, RigidObstacle]:
    """The obstacles that free ones from files feel with their points, moved back so that barriers of this width, m, do
    not act at rest; by their numbers. `edge`: m, to which triangles of files are cut."""
    x, moved = [], {}
    for each in free:
        assert isinstance(each.shape, TriangleMeshShape)
        points, _ = refine_triangles(each.shape.points, each.shape.triangles, edge)
        x.append(each.posed_at(0.0).pose.points_to_space(points))
    for number, each in others.items():
        gap = min(float(each.posed_at(0.0).distance(points).min()) for points in x)
        by = min(max(CLEAR * width - gap, 0.0), _most(each.shape))
        moved[number] = offset_obstacle(each, by if gap >= 0 else 0.0)
    return moved


def offset_obstacle(obstacle: RigidObstacle, by: float) -> RigidObstacle:
    """The obstacle with its surface `by` m further from what is outside it; its mass and inertia stay."""
    shape = obstacle.shape
    if not by:
        return obstacle
    if isinstance(shape, HalfSpace):
        return replace(obstacle, start_point=obstacle.start_point - by * shape.normal(obstacle.start_point[None])[0])
    if isinstance(shape, TranslatedShape):
        return replace(obstacle, shape=TranslatedShape(_inset(shape.shape, by), shape.offset))
    return replace(obstacle, shape=_inset(shape, by))


def _inset(shape: Shape, by: float) -> Shape:
    assert isinstance(shape, ConvexBody)
    return shape.inset(by)


def _most(shape: Shape) -> float:
    """By how much a shape can be moved back, m."""
    inner = shape.shape if isinstance(shape, TranslatedShape) else shape
    return inner.max_inset if isinstance(inner, ConvexBody) else float("inf")


def _narrowed(law: ObstacleLaw, width: float) -> ObstacleLaw:
    """The law with this width, m."""
    if width == law.barrier.width:
        return law
    return replace(law, barrier=replace(cast("Any", law.barrier), width=width))


def _gaps_to_nodes(domain: Domain, obstacles: Sequence[RigidObstacle]) -> Values:
    """(obstacles,) least distances to nodes at t = 0, m, infinite where one overlaps the body (collective)."""
    every = [each.posed_at(0.0) for each in obstacles]
    gaps = np.array([float(each.distance(domain.nodes).min(initial=np.inf)) for each in every])
    domain.comm.Allreduce(MPI.IN_PLACE, gaps, MPI.MIN)
    return np.where(gaps < -ROUND_OFF * domain.size, np.inf, gaps)


def _lower_to_others(gaps: Values, obstacles: Sequence[RigidObstacle]) -> None:
    """Gaps (obstacles,) of free ones are no more than those to what they feel among the others, m."""
    for a, b in free_pairs(obstacles):
        body, other = obstacles[a], obstacles[b]
        sides = ObstaclePair.between(body, other).gaps(body.posed_at(0.0).pose, other.posed_at(0.0).pose)
        gap = min(float(each.min(initial=np.inf)) for each in sides)
        size = float(np.ptp(body.shape.tessellate()[0], axis=0).max())
        if gap >= -ROUND_OFF * size:
            gaps[a] = min(gaps[a], gap)
