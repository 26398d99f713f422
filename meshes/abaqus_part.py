"""The mesh of an Abaqus part, numbered from 0 and checked for damage, and its placement by an instance."""

from __future__ import annotations

import numpy as np

from .abaqus_deck import KeywordBlock
from .abaqus_model import NO_INDICES, Component, ElementBlock
from .data import Indices, Points
from .mesh_conversion import DAMAGE
from .topology import positions_of


class LocalMesh:
    """Nodes and elements of a part, an instance or the assembly, numbered from 0.

    Attributes:
        components: what defines them.
        node_ids: (n,) node numbers of the file, sorted.
        points: (n, 3).
        cells: kind -> (element numbers, nodes as indices).
        used: (n,) whether each node belongs to an element.
    """

    def __init__(self, components: list[Component]) -> None:
        self.components = components
        nodes = [block for component in components for block in component.nodes]
        self.node_ids = np.concatenate([ids for _, ids, _ in nodes]) if nodes else NO_INDICES
        self.points = np.concatenate([points for *_, points in nodes]) if nodes else np.zeros((0, 3))
        if not (np.diff(self.node_ids) > 0).all():
            self._sort_nodes([block for block, *_ in nodes], np.cumsum([0] + [len(ids) for _, ids, _ in nodes]))
        self.cells: dict[str, tuple[Indices, Indices]] = {}
        elements = [block for component in components for block in component.elements]
        for kind in dict.fromkeys(block.kind for block in elements):
            of_kind = [block for block in elements if block.kind == kind]
            indices = [self._indices(block) for block in of_kind]
            self.cells[kind] = np.concatenate([block.ids for block in of_kind]), np.concatenate(indices)
        self._drop_repeated(elements)
        self.used = np.zeros(len(self.node_ids), bool)
        for _, nodes_of in self.cells.values():
            self.used[nodes_of] = True

    def _sort_nodes(self, blocks: list[KeywordBlock], starts: Indices) -> None:
        """Sort nodes by number; a node given twice is kept once, or refused if it lies at two places.

        Args:
            blocks: of the nodes.
            starts: index of the first node of each block.
        """
        order = np.argsort(self.node_ids, kind="stable")
        ids, points = self.node_ids[order], self.points[order]
        again = np.flatnonzero(np.diff(ids) == 0) + 1
        if (second := (points[again] != points[again - 1]).any(axis=1)).any():
            row = int(order[again[second.argmax()]])
            block = int(np.searchsorted(starts, row, side="right")) - 1
            blocks[block].refuse(
                f"node {self.node_ids[row]} is defined a second time, at another place. Number nodes once; parts with "
                "numbers of their own need *PART and *INSTANCE.",
                row - int(starts[block]),
            )
        retained = np.r_[True, np.diff(ids) > 0]
        self.node_ids, self.points = ids[retained], points[retained]

    def _indices(self, block: ElementBlock) -> Indices:
        """(m, k) nodes of elements as indices."""
        indices = positions_of(self.node_ids, block.nodes)
        if (missing := (indices < 0).any(axis=1)).any():
            row = int(missing.argmax())
            node = int(block.nodes[row][indices[row] < 0][0])
            _refuse_element(
                block, row, f"element {block.ids[row]} names node {node}, which is not in the file "
                "(or in another part). Is the file cut or damaged? Export it again.",
            )  # fmt: skip
        return indices

    def _drop_repeated(self, elements: list[ElementBlock]) -> None:
        """Keep elements that are given twice once; MeshError if they have other nodes the second time."""
        ids = np.concatenate([ids for ids, _ in self.cells.values()]) if self.cells else NO_INDICES
        ordered = ids if (np.diff(ids) > 0).all() else np.sort(ids)
        again = np.unique(ordered[1:][ordered[1:] == ordered[:-1]])
        if not len(again):
            return
        first_nodes: dict[int, bytes] = {}
        for block in elements:
            for row in np.flatnonzero(np.isin(block.ids, again)):
                element, nodes = int(block.ids[row]), block.kind.encode() + block.nodes[row].tobytes()
                if first_nodes.setdefault(element, nodes) != nodes:
                    _refuse_element(
                        block, int(row), f"element {element} is defined a second time, with other nodes. Number "
                        "elements once; parts with numbers of their own need *PART and *INSTANCE.",
                    )  # fmt: skip
        for kind, (numbers, indices) in self.cells.items():
            first = np.sort(np.unique(numbers, return_index=True)[1])
            self.cells[kind] = numbers[first], indices[first]

    def element_ids(self) -> Indices:
        """Numbers of all elements, also of those that are left out; none of a mesh without cells."""
        ids = [ids for ids, _ in self.cells.values()]
        if not ids:
            return NO_INDICES
        return np.concatenate([*ids, *(ids for component in self.components for ids in component.unused_ids)])

    def unused_nodes(self) -> int:
        """The number of nodes that belong to no element, not even to one that is left out."""
        ids = [ids for component in self.components for ids in component.unused_nodes]
        used = self.used | np.isin(self.node_ids, np.concatenate(ids)) if ids else self.used
        return int((~used).sum())

    def ends_with(self, last: KeywordBlock) -> bool:
        """Whether `last`, the last keyword of the file, is one of its *ELEMENT: the list may have been cut off."""
        return any(block.block is last for component in self.components for block in component.elements)

    def check_nodes_used(self, last: KeywordBlock) -> None:
        """Raise MeshError if so many nodes belong to no element that elements are missing.

        `last`: the last keyword of the file.
        """
        lost = self.unused_nodes()
        if self.cells and DAMAGE.too_many_lost(lost, len(self.used), at_end=self.ends_with(last)):
            block = next(component for component in self.components if component.elements).elements[-1].block
            where = ", with which the file ends," if self.ends_with(last) else ""
            block.refuse(
                f"{lost} of {len(self.used)} nodes belong to no element; *ELEMENT{where} seems to be cut short. Export "
                "the file again, or delete the nodes that are not needed."
            )


def _refuse_element(elements: ElementBlock, row: int, message: str) -> None:
    """Raise MeshError at the line of an element."""
    ends = elements.block.numbers(np.int64)[1]
    elements.block.refuse(message, int(np.searchsorted(ends, row * (elements.nodes.shape[1] + 1), side="right")))


def placed_points(points: Points, block: KeywordBlock) -> Points:
    """Points (n, 3) of an instance, translated by its first data line, then rotated by the second one.

    The second line holds two points of the axis and the angle in degrees, right-handed about the axis from the first
    point to the second (Abaqus Keywords Guide, *INSTANCE). Rotation by the formula of Rodrigues.
    """
    values, ends = block.numbers(np.float64)
    counts = [int(count) for count in np.diff(ends, prepend=0)]
    for line, (count, needed) in enumerate(zip(counts, (3, 7, 0), strict=False)):
        if count != needed:
            block.refuse(
                "*INSTANCE has at most two lines: translation (x, y, z), and rotation (two points of the axis and an "
                f"angle in degrees, seven numbers); here are {count} numbers.",
                line,
            )
    if not np.isfinite(values).all():
        block.refuse("*INSTANCE needs finite numbers.", 0)
    with np.errstate(all="ignore"):  # check_mesh refuses coordinates that overflow
        if counts:
            points = points + values[:3]
        if len(counts) == 2:
            a, b, angle = values[3:6], values[6:9], np.radians(values[9])
            length = float(np.linalg.norm(b - a))
            if length == 0 or not np.isfinite(length):
                block.refuse("the two points of the axis of rotation are the same; give two that differ.", 1)
            axis, from_axis = (b - a) / length, points - a
            along = (from_axis @ axis)[:, None] * axis
            points = a + along + (from_axis - along) * np.cos(angle) + np.cross(axis, from_axis) * np.sin(angle)
    return points
