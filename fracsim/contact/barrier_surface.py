"""Surface of a body with the barrier: in contact with itself, or with triangle-mesh obstacles, in implicit steps.

A pair belongs to the rank of its lowest point (ipc_pairs.PairShare). Before obstacles a rank needs the elements around
the points of its own ones alone, since every rank has the whole obstacle.

Equations: docs/theory.md#contact.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import ClassVar

import numpy as np
import numpy.typing as npt
from dolfinx import fem

from ..mesh.domain import Domain
from .element_exchange import EXCHANGE, ElementSet
from .ipc_pairs import IpcPairs, PairShare
from .mesh_obstacles import AllMeshPairs, MeshObstacle, MeshObstaclePairs
from .partitioned_surface import PartitionedSurface
from .retractable_surface import SURFACE, RetractableSurface, SelfContactLaw

Values = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]


class BarrierSurface(RetractableSurface):
    """Elements of this rank and of others near them, and the pairs of this rank.

    Attributes:
        pairs: pairs of the body with itself, or with each obstacle.
    """

    closed_pressure: ClassVar[float] = SURFACE.closed_pressure
    pairs: IpcPairs | AllMeshPairs

    def _build_contacts(self, elements: Ints) -> None:
        corners, X, law, edge = self.elements[elements], self.rest_positions, self.law, self._edge
        D, k, share = law.distance, law.stiffness, PairShare.of(self.comm, self.own_points)
        if not self._meshes:
            self.pairs = IpcPairs(X, corners, distance=D, stiffness=k, friction=law.friction, share=share, edge=edge)
        else:
            self.pairs = AllMeshPairs(
                [
                    MeshObstaclePairs(X, corners, mesh, distance=D, stiffness=k, share=share, edge=edge)
                    for mesh in self._meshes
                ]
            )

    def _gradients(self, x: Values) -> list[Values]:
        if isinstance(self.pairs, AllMeshPairs):
            return [pairs.body_gradient(x) for pairs in self.pairs.pairs]
        return [self.pairs.gradient(x)]

    def cut_elements(self, x: Values) -> list[Ints]:
        """Remaining elements (k,) that the body itself, or each obstacle, intersects with points at x (n, d), m."""
        if isinstance(self.pairs, AllMeshPairs):
            return [pairs.cut_elements(x) for pairs in self.pairs.pairs]
        return [np.unique(self.pairs.intersections(x))]

    def set_stiffness(self, stiffness: float) -> None:
        """Set the stiffness of the barrier, Pa."""
        self.law = replace(self.law, stiffness=stiffness)
        self.pairs.set_stiffness(stiffness)


class BarrierBodySurface(PartitionedSurface[BarrierSurface]):
    """Contact surface of a body with the barrier, whose stiffness may grow."""

    def __init__(
        self, domain: Domain, u: fem.Function, law: SelfContactLaw, obstacles: Sequence[MeshObstacle] = ()
    ) -> None:
        """As of PartitionedSurface (collective)."""
        # before obstacles: elements that share a point are always near each other
        margin = np.inf if obstacles else EXCHANGE.barrier_margin * domain.mean_edge_length
        super().__init__(domain, u, law, obstacles, law.distance, margin)

    def _build_surface(self, element_set: ElementSet) -> BarrierSurface:
        return BarrierSurface(self._comm, element_set, self.law, self._meshes, self._domain.mean_edge_length)

    def _searched_boxes(self, boxes: Values) -> Values:
        return boxes[self.border_elements()] if self._meshes else super()._searched_boxes(boxes)

    def set_stiffness(self, stiffness: float) -> None:
        """Set the stiffness of the barrier, Pa."""
        if stiffness != self.law.stiffness:
            self.law = replace(self.law, stiffness=stiffness)
            self.current.set_stiffness(stiffness)

    def to_checkpoint(self) -> dict[str, Values]:
        """As of PartitionedSurface, and the stiffness."""
        return {**super().to_checkpoint(), "stiffness": np.array([self.law.stiffness])}

    def from_checkpoint(self, saved: dict[str, Values]) -> None:
        """Set the state from the arrays of a checkpoint (collective)."""
        self.set_stiffness(float(saved["stiffness"][0]))
        super().from_checkpoint(saved)
