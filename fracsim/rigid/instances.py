"""Copies of one mesh as they break: a blow on one of them costs what that one costs.

All share the mesh as it was built, its stress and the operator of the whole body, in the axes of the mesh; each knows
its own damage, from the first blow on that may break it. One that is dented is a mesh of its own.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from .breakage import Breakable, Opened
from .instance_placement import Poses

if TYPE_CHECKING:
    from .denting import Shape

Ints = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]
Patterns = npt.NDArray[np.uint8]
Kept = tuple[dict[int, dict[str, npt.NDArray[Any]]], "dict[int, Shape]"]  # by the numbers of copies


class Copies:
    """Of a mesh of some nodes, at their poses (one rank).

    Attributes:
        poses: where they are at rest.    nodes: of a copy; those of copy k follow k times as many.
        shapes: of the copies that have flowed, by their numbers.
        passes, iterations: analyses, and iterations of CG in them, that were taken.
    """

    def __init__(
        self, make: Callable[[int, Shape | None], Breakable], poses: Poses, sizes: tuple[int, int, int]
    ) -> None:
        """`make`: the copy of a number, whole, of a shape (None: as the mesh is); `sizes`: nodes, cells and edges of
        the mesh."""
        self._make, self.poses = make, poses
        self.shapes: dict[int, Shape] = {}
        self.nodes, self._cells, self._edges = sizes
        self._made: dict[int, Breakable] = {}
        self.passes = self.iterations = 0

    @classmethod
    def of(cls, body: Breakable) -> Copies:
        """One, where the mesh has it."""
        graph = body.graph
        sizes = len(graph.domain.nodes), graph.domain.cell_count, len(graph.broken)
        return cls(lambda *_: body, Poses.at_rest(1), sizes)

    def __len__(self) -> int:
        return len(self.poses)

    def copy(self, number: int) -> Breakable:
        """One of them."""
        if number not in self._made:
            self._made[number] = self._make(number, self.shapes.get(number))
        return self._made[number]

    @property
    def damaged(self) -> dict[int, Breakable]:
        """Those with a broken edge, by their numbers."""
        return {number: each for number, each in sorted(self._made.items()) if each.graph.broken.any()}

    def damage(self) -> tuple[Patterns, Values]:
        """Patterns (C,) of all cells and where each edge (E,) is cut, in the order of the mesh of all copies."""
        pattern = np.zeros((len(self), self._cells), np.uint8)
        cut: Values = np.full((len(self), self._edges), np.nan)
        for number, each in self.damaged.items():
            pattern[number], cut[number] = each.damage()
        return pattern.reshape(-1), cut.reshape(-1)

    @property
    def split_cells(self) -> int:
        """Cells that have come apart."""
        return sum(int(np.count_nonzero(each.graph.split)) for each in self._made.values())

    def left(self, name: int) -> tuple[int, int]:
        """The copy that the body of a name is of, and the surfaces that may still open in it: each copy has its own, or
        what is struck first would take those of all."""
        number = name // self.nodes
        return number, self.copy(number).left

    def breaks(self, number: int) -> bool:
        """Whether surfaces may still open in one of them."""
        return self.copy(number).breaks

    # --- strikes ---

    def may_break(self, name: int, force: float) -> bool:
        """Whether forces of this sum (N) could break the body of a name; see `Breakable`."""
        number, node = divmod(name, self.nodes)
        each = self.copy(number)
        return each.may_break(each.piece_of(node), force)

    def opened(
        self, name: int, points: Values, force: Values, radius: Values, share: int, energy: float = np.inf
    ) -> Opened:
        """What forces (k, 3) on circles of radii (k,) about points (k, 3) of a body at rest open, N and m, at most
        `share` surfaces, or the shape that they leave for an energy, J. Whether they count is up to `take`. Raises
        NotConverged."""
        number, node = divmod(name, self.nodes)
        each, turn = self.copy(number), self.poses.turn[number]
        inside = (points - self.poses.place[number]) @ turn
        found = each.opened(node, each.loads(each.piece_of(node), inside, force @ turn, radius), share, energy)
        return replace(found, name=name)

    def take(self, every: list[Opened]) -> None:
        """Have all of that open, whichever rank found it."""
        of = [each.name // self.nodes for each in every]
        for number in dict.fromkeys(of):
            self.copy(number).take([each for each, mine in zip(every, of, strict=True) if mine == number])
        for number, each in zip(of, every, strict=True):
            if each.shape is not None:
                self._reshape(number, each.shape)
        self.passes += sum(each.passes for each in every)
        self.iterations += sum(each.iterations for each in every)

    def _reshape(self, number: int, shape: Shape) -> None:
        """A copy is of another shape from here on."""
        if (made := self._made.pop(number, None)) is not None:
            made.destroy(alone=number in self.shapes)
        self.shapes[number] = shape

    # --- a checkpoint ---

    def kept(self, names: Iterable[int]) -> Kept:
        """What the copies are now that bodies of these names are of, for `saved` once they have been struck."""
        return {n: self.copy(n).saved() for n in {name // self.nodes for name in names}}, self.shapes.copy()

    def saved(self, kept: Kept | None = None) -> dict[str, npt.NDArray[Any]]:
        """What a checkpoint keeps: keys (n, 2) of broken edges and their cuts; where surfaces started, and in which;
        shapes of those that flowed. `kept`: what copies were that have been struck since."""
        before, shapes = ({}, self.shapes) if kept is None else kept
        if shapes:  # nothing breaks where something flows
            every = shapes.values()
            return {
                "shape_of": np.array([*shapes]),
                "shape_points": np.stack([each.points for each in every]),
                "shape_yields": np.stack([each.yields for each in every]),
            }
        parts = {number: before[number] if number in before else each.saved()
                 for number, each in sorted(self._made.items())}  # fmt: skip
        parts = {number: each for number, each in parts.items() if each}
        if not parts:
            return {}
        return {
            "broken": np.concatenate([each["broken"] + number * self.nodes for number, each in parts.items()]),
            "cut": np.concatenate([each["cut"] for each in parts.values()]),
            "starts": np.concatenate([each["starts"] for each in parts.values()]),
            "starts_of": np.repeat([*parts], [len(each["starts"]) for each in parts.values()]),
        }

    def restore(self, saved: dict[str, npt.NDArray[Any]]) -> None:
        """Be as `saved` said."""
        if "shape_of" in saved:
            from .denting import Shape

            for number, *shape in zip(*(saved[f"shape_{key}"] for key in ("of", "points", "yields")), strict=True):
                self._reshape(int(number), Shape(*shape))
        if "broken" not in saved:
            return
        of = saved["broken"][:, 0] // self.nodes
        for number in map(int, np.union1d(np.union1d(of, saved["starts_of"]), [*self._made])):
            mine, starts = of == number, saved["starts"][saved["starts_of"] == number]
            broken = saved["broken"][mine] - number * self.nodes
            self.copy(number).restore({"broken": broken, "cut": saved["cut"][mine], "starts": starts})
