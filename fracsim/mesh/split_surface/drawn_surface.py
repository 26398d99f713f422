"""The split surface at a time as it is drawn, of the part of the mesh that a rank has; contact moves its points.

    x = mean over p of (x_p + s F_p (X - X_p))

with the nodes p that a point follows, and the average deformation gradient F_p around p, the identity at nodes without
an unsplit cell. With s = 1 the point is the material point; with s < 1 it is nearer to the nodes p.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from mpi4py import MPI

from ..ghost_exchange import KeyedReduction
from .closed_surface import SplitSurface, SurfacePoints
from .mesh_part import MeshPart
from .surface_map import SurfaceMap, placed_points
from .surface_motion import NodalGradients
from .surface_numbering import SurfaceNumbering

Flags = npt.NDArray[np.bool_]
Ints = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]


class SharedPoints:
    """Points of a split surface that several ranks have."""

    def __init__(self, part: MeshPart, split: SplitSurface, numbering: SurfaceNumbering) -> None:
        """`numbering`: of the points of all ranks (collective)."""
        self.comm = part.comm
        ones = np.ones((len(part.node_numbers), 1))
        is_shared = part.sum_at(np.arange(len(ones)), ones)[:, 0] > 1
        parents = split.parents
        # ranks that share a point share the nodes that it follows
        on_border = np.logical_and.reduceat(is_shared[parents.parents], parents.start[:-1])
        self._border = np.flatnonzero(on_border)
        self._reduction = KeyedReduction(self.comm, numbering.points[self._border])

    def any_over_ranks(self, flags: Flags) -> Flags:
        """(n,) flags of the points that any rank flags (collective)."""
        result = flags.copy()
        result[self._border] = self._reduction(flags[self._border], np.logical_or)
        return result

    def has_any(self, flags: Flags) -> bool:
        """Whether any flag of any rank is set (collective)."""
        return bool(self.comm.allreduce(bool(flags.any()), op=MPI.LOR))


@dataclass(frozen=True)
class DrawnSurface:
    """Split surface of a part of a mesh at a displacement.

    Attributes:
        part: part of the mesh.
        pattern: (C,) damage patterns.
        split: the surface in the reference configuration.
        shared: points that several ranks have.
        whole: numbers of the points on the surface of all ranks.
        middle: (n, d) mean present positions of the nodes that the points follow, m.
        deformation: (m, d, d) F_p of some nodes.
        row: (N,) row of each node in `deformation`.
    """

    part: MeshPart
    pattern: npt.NDArray[np.integer]
    split: SplitSurface
    shared: SharedPoints
    whole: SurfaceNumbering
    middle: Values
    deformation: Values
    row: Ints

    @classmethod
    def at_displacement(
        cls,
        part: MeshPart,
        pattern: npt.NDArray[np.integer],
        split: SplitSurface,
        whole: SurfaceNumbering,
        shared: SharedPoints,
        gradients: NodalGradients,
        u: Values,
    ) -> DrawnSurface:
        """The surface at nodal displacements u (N, d), m; `gradients` at the nodes that copies follow (collective)."""
        deformation = gradients(u) + np.eye(part.skeleton.dim)
        middle = split.parents.mean(part.skeleton.points + u)
        return cls(part, pattern, split, shared, whole, middle, deformation, gradients.row)

    @property
    def numbering(self) -> SurfacePoints:
        """The points by their entities."""
        assert self.split.numbering is not None
        return self.split.numbering

    def placed_points(self) -> SurfaceMap:
        """All points at their positions, as a map without nodes."""
        points = np.arange(len(self.middle))
        return placed_points(self.middle, self._arms(points, self.split.points))

    def positions(self, points: Ints, reference: Values) -> Values:
        """(k, d) present positions of points (k,) with other reference positions (k, d), m."""
        return np.asarray(self.middle[points] + self._arms(points, reference))

    def _arms(self, points: Ints, reference: Values) -> Values:
        """(k, d) means over the parents of F_p (X - X_p), m."""
        parents = self.split.parents
        count = np.diff(parents.start)[points]
        start = np.cumsum(count) - count
        entries = np.repeat(parents.start[points] - start, count) + np.arange(int(count.sum()))
        nodes = parents.parents[entries]
        arm = np.repeat(reference, count, axis=0) - self.part.skeleton.points[nodes]
        has_arm = np.flatnonzero(np.any(arm != 0, axis=1))
        arm[has_arm] = np.einsum("nij,nj->ni", self.deformation[self.row[nodes[has_arm]]], arm[has_arm])
        return np.asarray(np.add.reduceat(arm, start, axis=0) / count[:, None]) if len(points) else arm


def gradients_of_copies(part: MeshPart, pattern: npt.NDArray[np.integer], split: SplitSurface) -> NodalGradients:
    """Average gradients at the nodes that copies of points follow (collective)."""
    assert split.numbering is not None
    wanted = np.zeros(len(part.node_numbers), bool)
    wanted[split.parents.parents[split.parents.start[split.numbering.first] :]] = True
    return NodalGradients(part, pattern, wanted)
