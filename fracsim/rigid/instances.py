"""Instances of one mesh as they break: a blow on one of them costs what that one costs.

All instances share the mesh, its stress and the operator of the whole body, in the axes of the mesh. Each has damage of
its own, from the first blow that may break it. A dented instance is a mesh of its own.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from .breakage import BreakableBody, ImpactOutcome
from .instance_placement import InstancePoses

if TYPE_CHECKING:
    from .denting import DentedShape

Ints = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]
Patterns = npt.NDArray[np.uint8]
Arrays = dict[str, npt.NDArray[Any]]
# Arrays of broken instances, and shapes of dented ones, by their numbers.
InstancesSnapshot = tuple[dict[int, Arrays], "dict[int, DentedShape]"]


class Instances:
    """Bodies of one mesh at their poses (one rank).

    Attributes:
        poses: at rest.
        node_count: nodes of an instance; those of instance k follow after k times as many.
        dented_shapes: of instances that yielded, by their numbers.
        analyses: number of analyses so far.
        cg_iterations: iterations of CG in them.
    """

    def __init__(
        self,
        make: Callable[[int, DentedShape | None], BreakableBody],
        poses: InstancePoses,
        sizes: tuple[int, int, int],
    ) -> None:
        """Begin with unbroken instances, which are made when they are first needed.

        Args:
            make: returns the instance of a number, unbroken, with a shape; None: that of the mesh.
            poses: at rest.
            sizes: numbers of nodes, cells and edges of the mesh.
        """
        self._make, self.poses = make, poses
        self.dented_shapes: dict[int, DentedShape] = {}
        self.node_count, self._cell_count, self._edge_count = sizes
        self._bodies: dict[int, BreakableBody] = {}
        self.analyses = self.cg_iterations = 0

    @classmethod
    def of_body(cls, body: BreakableBody) -> Instances:
        """Return a single instance, placed as the mesh is."""
        graph = body.graph
        sizes = len(graph.domain.nodes), graph.domain.cell_count, len(graph.broken)
        return cls(lambda *_: body, InstancePoses.identity(1), sizes)

    def __len__(self) -> int:
        return len(self.poses)

    def get(self, number: int) -> BreakableBody:
        """Return the instance of a number."""
        if number not in self._bodies:
            self._bodies[number] = self._make(number, self.dented_shapes.get(number))
        return self._bodies[number]

    @property
    def damaged(self) -> dict[int, BreakableBody]:
        """Instances with a broken edge, by their numbers."""
        return {number: body for number, body in sorted(self._bodies.items()) if body.graph.broken.any()}

    def damage(self) -> tuple[Patterns, Values]:
        """Return patterns (C,) of all cells and cut positions (E,) of all edges, in the order of the mesh of all."""
        pattern = np.zeros((len(self), self._cell_count), np.uint8)
        cut: Values = np.full((len(self), self._edge_count), np.nan)
        for number, body in self.damaged.items():
            pattern[number], cut[number] = body.input_damage()
        return pattern.reshape(-1), cut.reshape(-1)

    @property
    def split_cell_count(self) -> int:
        """Number of split cells of all instances."""
        return sum(int(np.count_nonzero(body.graph.split)) for body in self._bodies.values())

    def surfaces_left(self, name: int) -> tuple[int, int]:
        """Return the instance that a body belongs to, and the number of surfaces that may still open in it.

        The limit is that of each instance; a common one would be used up by those that are impacted first.
        """
        number = name // self.node_count
        return number, self.get(number).surfaces_left

    def can_break(self, number: int) -> bool:
        """Return whether surfaces may still open in an instance."""
        return self.get(number).can_break

    # --- analyses ---

    def may_break(self, name: int, force: float) -> bool:
        """Return whether forces, the sum of whose sizes is `force`, N, could break a body; see BreakableBody."""
        number, node = divmod(name, self.node_count)
        body = self.get(number)
        return body.may_break(body.fragments.containing(node), force)

    def find_outcome(
        self, name: int, points: Values, force: Values, radius: Values, max_surfaces: int, energy: float = np.inf
    ) -> ImpactOutcome:
        """Analyse a body under contact forces. The outcome has no effect before `apply_outcomes`.

        Args:
            name: of the body.
            points: (k, 3) at rest, m.
            force: (k, 3) at rest, N.
            radius: (k,) of the circles that the forces press on, m.
            max_surfaces: surfaces that may open.
            energy: that plastic flow may dissipate, J.

        Raises:
            NotConverged: an analysis failed.
        """
        number, node = divmod(name, self.node_count)
        body, rotation = self.get(number), self.poses.rotation[number]
        # into the axes of the mesh
        mesh_points, mesh_force = (points - self.poses.position[number]) @ rotation, force @ rotation
        loads = body.distribute_forces(body.fragments.containing(node), mesh_points, mesh_force, radius)
        return replace(body.find_outcome(node, loads, max_surfaces, energy), body_name=name)

    def apply_outcomes(self, outcomes: list[ImpactOutcome]) -> None:
        """Break edges and change shapes as analyses on any rank found."""
        numbers = [outcome.body_name // self.node_count for outcome in outcomes]
        for number in dict.fromkeys(numbers):
            owned = [outcome for outcome, owner in zip(outcomes, numbers, strict=True) if owner == number]
            self.get(number).apply_outcomes(owned)
        for number, outcome in zip(numbers, outcomes, strict=True):
            if outcome.shape is not None:
                self._change_shape(number, outcome.shape)
        self.analyses += sum(outcome.analyses for outcome in outcomes)
        self.cg_iterations += sum(outcome.cg_iterations for outcome in outcomes)

    def _change_shape(self, number: int, shape: DentedShape) -> None:
        """Give an instance another shape."""
        if (body := self._bodies.pop(number, None)) is not None:
            body.analyses.destroy(owns_operator=number in self.dented_shapes)
        self.dented_shapes[number] = shape

    # --- checkpoints ---

    def snapshot(self, names: Iterable[int]) -> InstancesSnapshot:
        """Return the state of the instances of bodies `names`, for a checkpoint of the time before they change."""
        numbers = {name // self.node_count for name in names}
        return {number: self.get(number).to_checkpoint() for number in numbers}, self.dented_shapes.copy()

    def to_checkpoint(self, earlier: InstancesSnapshot | None = None) -> Arrays:
        """Return the arrays that a checkpoint stores.

        They are keys (n, 2) and cut positions of broken edges, starts of surfaces with their instances, or shapes of
        dented instances. `earlier`: states in place of the present ones, of instances that changed since.
        """
        before, shapes = ({}, self.dented_shapes) if earlier is None else earlier
        # bodies that yield do not break
        if shapes:
            return {
                "shape_of": np.array([*shapes]),
                "shape_points": np.stack([shape.points for shape in shapes.values()]),
                "shape_yields": np.stack([shape.yield_stress for shape in shapes.values()]),
            }
        parts = {
            number: before[number] if number in before else body.to_checkpoint()
            for number, body in sorted(self._bodies.items())
        }
        parts = {number: arrays for number, arrays in parts.items() if arrays}
        if not parts:
            return {}
        return {
            "broken": np.concatenate([arrays["broken"] + number * self.node_count for number, arrays in parts.items()]),
            "cut": np.concatenate([arrays["cut"] for arrays in parts.values()]),
            "starts": np.concatenate([arrays["starts"] for arrays in parts.values()]),
            "starts_of": np.repeat([*parts], [len(arrays["starts"]) for arrays in parts.values()]),
        }

    def from_checkpoint(self, arrays: Arrays) -> None:
        """Restore the state that `to_checkpoint` stored."""
        if "shape_of" in arrays:
            from .denting import DentedShape

            names = ("shape_of", "shape_points", "shape_yields")
            for number, points, yield_stress in zip(*(arrays[name] for name in names), strict=True):
                self._change_shape(int(number), DentedShape(points, yield_stress))
        if "broken" not in arrays:
            return
        edge_instance, start_instance = arrays["broken"][:, 0] // self.node_count, arrays["starts_of"]
        for number in map(int, np.union1d(np.union1d(edge_instance, start_instance), [*self._bodies])):
            edges = edge_instance == number
            broken = arrays["broken"][edges] - number * self.node_count
            starts = arrays["starts"][start_instance == number]
            self.get(number).from_checkpoint({"broken": broken, "cut": arrays["cut"][edges], "starts": starts})
