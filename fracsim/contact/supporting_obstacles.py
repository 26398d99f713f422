"""Obstacles that a body is set down on: they act neither on the body at rest nor on each other.

Contact acts below a distance D. An obstacle with a smaller gap g at rest would throw the body, with an energy that no
load has done. It is therefore moved back by D - g: a half space along its normal, other shapes are inset, a hollow one
grows. So the body begins in equilibrium with it, and may also touch it (g = 0). The same holds for a free obstacle and
another one.

A barrier that begins at g instead would be as stiff as g is small. Second-order schemes oscillate on such a barrier,
and friction, which is that of the force at the start of a step, is then up to 2.5 times mu N.

Equations: docs/theory.md#rigid-obstacles.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, cast

import numpy as np
from mpi4py import MPI

from ..array_types import Values
from ..mesh.domain import Domain
from .laws import ObstacleLaw
from .obstacle import RigidObstacle, free_pairs
from .obstacle_pairs import ObstaclePair
from .obstacle_term import ObstacleTerm
from .shape_base import unit_vector
from .shapes import HalfSpace
from .triangle_mesh_shape import TriangleMeshShape, refine_triangles


@dataclass(frozen=True)
class SetDownPolicy:
    """Tuned numbers of obstacles that a body is set down on.

    Attributes:
        round_off: overlap, in sizes of the body, that counts as touching.
        clearance: gap at rest, in widths of the barrier, so that round-off causes no pressure.
        max_rounds: terms that are built: facets are known once their obstacles have been moved back.
    """

    round_off: float = 1e-9
    clearance: float = 1 + 1e-6
    max_rounds: int = 4


SET_DOWN = SetDownPolicy()


def build_inactive_at_rest[Term: ObstacleTerm](
    domain: Domain,
    obstacles: Sequence[RigidObstacle],
    law: ObstacleLaw,
    build: Callable[[Sequence[RigidObstacle], ObstacleLaw], Term],
    *,
    mutual: bool,
) -> Term:
    """Term of obstacles that are moved back so that none acts at rest (collective).

    Args:
        domain: mesh of the body.
        obstacles: obstacles.
        law: contact law; its width is reduced where an obstacle cannot be moved back enough.
        build: obstacles, law -> term. It refuses obstacles that overlap the body.
        mutual: whether free obstacles are in contact with others.
    """
    limits = np.array([obstacle.shape.max_inset for obstacle in obstacles])
    gaps, pairs = _gaps_to_nodes(domain, obstacles), _pair_gaps(obstacles) if mutual else []
    for number in range(SET_DOWN.max_rounds):
        room = min([*(gaps + limits), *(gap + limits[a] + limits[b] for a, b, gap in pairs)])
        width = min(law.barrier.width, float(room) / SET_DOWN.clearance)
        offsets = np.clip(SET_DOWN.clearance * width - gaps, 0.0, limits)
        _add_offsets_of_pairs(offsets, limits, pairs, obstacles, SET_DOWN.clearance * width)
        moved = [_offset_obstacle(*item) for item in zip(obstacles, offsets, strict=True)]
        term = build(moved, _with_width(law, width))
        rest_gaps = _rest_gaps(term)
        if number == SET_DOWN.max_rounds - 1 or (rest_gaps >= width).all():
            break
        term.destroy()
        gaps = np.minimum(gaps, rest_gaps - offsets)
    return term


def _rest_gaps(term: ObstacleTerm) -> Values:
    """(obstacles,) least gaps of the body at rest to each obstacle at t = 0, m (collective).

    Gaps of points, and of facets where the obstacle acts on them.
    """
    x, posed = term.surface.rest_positions, [obstacle.posed_at(0.0) for obstacle in term.group.obstacles]
    gaps = np.array([term.surface.min_distance(shape.distance(x)) for shape in posed])
    for number in term.surface.curved:
        facet_gaps = term.surface.facets.gaps(posed[number], x, term.group.barrier_width)
        gaps[number] = min(gaps[number], float(facet_gaps.min(initial=np.inf)))
    term.comm.Allreduce(MPI.IN_PLACE, gaps, MPI.MIN)
    return gaps


def pair_obstacles(obstacles: Sequence[RigidObstacle], width: float, edge: float) -> dict[int, RigidObstacle]:
    """Obstacles as they are in contact with one another, by their numbers.

    Triangle meshes have triangles as small as those of the body. Prescribed analytic obstacles are moved back so that
    barriers do not act between them and free triangle meshes at rest.

    Args:
        obstacles: by their numbers.
        width: of the barrier, m.
        edge: length to which triangles are refined, m.
    """
    result = {number: _with_small_triangles(obstacle, edge) for number, obstacle in enumerate(obstacles)}
    free_points = [
        obstacle.posed_at(0.0).pose.points_to_space(obstacle.shape.points)
        for obstacle in result.values()
        if obstacle.free and isinstance(obstacle.shape, TriangleMeshShape)
    ]
    for number, obstacle in result.items():
        shape = obstacle.shape
        if not free_points or obstacle.free or isinstance(shape, TriangleMeshShape):
            continue
        gap = min(float(obstacle.posed_at(0.0).distance(points).min()) for points in free_points)
        offset = min(max(SET_DOWN.clearance * width - gap, 0.0), shape.max_inset)
        if gap >= 0 and offset:
            result[number] = replace(obstacle, shape=shape.inset(offset))
    return result


def _with_small_triangles(obstacle: RigidObstacle, edge: float) -> RigidObstacle:
    """Obstacle whose triangles, if it is a triangle mesh, have edges of at most `edge`, m."""
    if not isinstance(shape := obstacle.shape, TriangleMeshShape):
        return obstacle
    return replace(obstacle, shape=TriangleMeshShape(*refine_triangles(shape.points, shape.triangles, edge)))


def _offset_obstacle(obstacle: RigidObstacle, offset: float) -> RigidObstacle:
    """Obstacle with its surface moved back by `offset`, m; its mass and inertia stay."""
    if not offset:
        return obstacle
    if isinstance(shape := obstacle.shape, HalfSpace):
        return replace(obstacle, start_point=obstacle.start_point - offset * unit_vector(shape.direction))
    return replace(obstacle, shape=shape.inset(offset))


def _with_width(law: ObstacleLaw, width: float) -> ObstacleLaw:
    """Law with a width, m."""
    if width == law.barrier.width:
        return law
    return replace(law, barrier=replace(cast("Any", law.barrier), width=width))


def _gaps_to_nodes(domain: Domain, obstacles: Sequence[RigidObstacle]) -> Values:
    """(obstacles,) least distances to nodes at t = 0, m; infinite where an obstacle overlaps the body (collective)."""
    posed = [obstacle.posed_at(0.0) for obstacle in obstacles]
    gaps = np.array([float(shape.distance(domain.nodes).min(initial=np.inf)) for shape in posed])
    domain.comm.Allreduce(MPI.IN_PLACE, gaps, MPI.MIN)
    return np.where(gaps < -SET_DOWN.round_off * domain.bounds.diagonal, np.inf, gaps)


def _pair_gaps(obstacles: Sequence[RigidObstacle]) -> list[tuple[int, int, float]]:
    """Numbers of each free obstacle and another one, and their gap at t = 0, m; none of pairs that overlap."""
    result = []
    for a, b in free_pairs([obstacle.free for obstacle in obstacles]):
        body, second = obstacles[a], obstacles[b]
        sides = ObstaclePair.between(body, second).gaps(body.posed_at(0.0).pose, second.posed_at(0.0).pose)
        gap = min(float(side.min(initial=np.inf)) for side in sides)
        size = float(np.ptp(body.shape.tessellate()[0], axis=0).max())
        if gap >= -SET_DOWN.round_off * size:
            result.append((a, b, gap))
    return result


def _add_offsets_of_pairs(
    offsets: Values,
    limits: Values,
    pairs: Sequence[tuple[int, int, float]],
    obstacles: Sequence[RigidObstacle],
    min_gap: float,
) -> None:
    """Increase offsets (obstacles,), m, up to limits, until no pair of obstacles has a gap below `min_gap`, m.

    An obstacle that is not free is moved back before a free one, which keeps the radius with which it rolls. Two free
    ones are moved back by half each.
    """
    for a, b, gap in pairs:
        missing = min_gap - gap - offsets[a] - offsets[b]
        for number, share in ((b, 0.5 if obstacles[b].free else 1.0), (a, 1.0), (b, 1.0)):
            added = min(max(share * missing, 0.0), limits[number] - offsets[number])
            offsets[number] += added
            missing -= added
