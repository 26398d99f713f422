"""The mesh of an Abaqus part in numbers from 0, checked against damage, and where an instance of it lies."""

from __future__ import annotations

import numpy as np

from .abaqus_deck import KeywordBlock
from .abaqus_model import NO_INDICES, Component, ElementBlock
from .data import Indices, Points

MAX_GAPS = 3  # element numbers left out that are told of,
MAX_GAP_SHARE = 0.01  # or so many of all elements
MAX_UNUSED_SHARE = 0.1  # of the nodes of a part that no element may name
MAX_CUT_SHARE = 0.01  # the same, where the file ends with the elements
MAX_UNUSED_NODES = 3  # and so many in any case: reference points


class LocalMesh:
    """Nodes and elements of a part, an instance or the assembly, numbered from 0.

    Attributes:
        node_ids: sorted numbers in the file.    points: (n, 3).
        cells: kind -> (element numbers, nodes as indices).
    """

    def __init__(self, components: list[Component]) -> None:
        self.components = components
        nodes = [item for component in components for item in component.nodes]
        self.node_ids = np.concatenate([ids for _, ids, _ in nodes]) if nodes else NO_INDICES
        self.points = np.concatenate([points for *_, points in nodes]) if nodes else np.zeros((0, 3))
        if not (np.diff(self.node_ids) > 0).all():
            self._sort_nodes([block for block, *_ in nodes], np.cumsum([0] + [len(ids) for _, ids, _ in nodes]))
        self.cells: dict[str, tuple[Indices, Indices]] = {}
        elements = [item for component in components for item in component.elements]
        for kind in dict.fromkeys(item.kind for item in elements):
            same = [item for item in elements if item.kind == kind]
            indices = [self._indices(item) for item in same]
            self.cells[kind] = np.concatenate([item.ids for item in same]), np.concatenate(indices)
        self._drop_repeated(elements)
        self.used = np.zeros(len(self.node_ids), bool)
        for _, nodes_of in self.cells.values():
            self.used[nodes_of] = True

    def _sort_nodes(self, blocks: list[KeywordBlock], starts: Indices) -> None:
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

    def _indices(self, item: ElementBlock) -> Indices:
        indices = find_in_sorted(self.node_ids, item.nodes)
        if (missing := (indices < 0).any(axis=1)).any():
            row = int(missing.argmax())
            node = int(item.nodes[row][indices[row] < 0][0])
            _refuse_element(
                item, row, f"element {item.ids[row]} names node {node}, which is not in the file "
                "(or in another part). Is the file cut or damaged? Export it again.",
            )  # fmt: skip
        return indices

    def _drop_repeated(self, elements: list[ElementBlock]) -> None:
        """Elements given twice are kept once; the same number with other nodes is refused."""
        ids = np.concatenate([ids for ids, _ in self.cells.values()]) if self.cells else NO_INDICES
        ordered = ids if (np.diff(ids) > 0).all() else np.sort(ids)
        again = np.unique(ordered[1:][ordered[1:] == ordered[:-1]])
        if not len(again):
            return
        before: dict[int, bytes] = {}
        for item in elements:
            for row in np.flatnonzero(np.isin(item.ids, again)):
                number_of, nodes = int(item.ids[row]), item.kind.encode() + item.nodes[row].tobytes()
                if before.setdefault(number_of, nodes) != nodes:
                    _refuse_element(
                        item, int(row), f"element {number_of} is defined a second time, with other nodes. Number "
                        "elements once; parts with numbers of their own need *PART and *INSTANCE.",
                    )  # fmt: skip
        for kind, (numbers, indices) in self.cells.items():
            first = np.sort(np.unique(numbers, return_index=True)[1])
            self.cells[kind] = numbers[first], indices[first]

    def missing_numbers(self) -> tuple[int, int]:
        """How many element numbers are left out between the others, and the first; 0 where they are more than a few.

        Many gaps are usual where elements were deleted on purpose; a few may be lines that were lost.
        """
        ids = [ids for ids, _ in self.cells.values()]
        if not ids:
            return 0, 0
        used = np.concatenate([*ids, *(ids for component in self.components for ids in component.unused_ids)])
        first, last = int(used.min()), int(used.max())
        missing = last - first + 1 - len(used)
        if not 0 < missing <= max(MAX_GAPS, MAX_GAP_SHARE * len(used)):
            return 0, 0
        present = np.zeros(last - first + 1, bool)
        present[used - first] = True
        return int((~present).sum()), first + int((~present).argmax())

    def unused_nodes(self) -> int:
        """The number of nodes that no element has."""
        remaining = [ids for component in self.components for ids in component.unused_nodes]
        used = self.used | np.isin(self.node_ids, np.concatenate(remaining)) if remaining else self.used
        return int((~used).sum())

    def ends_with(self, last: KeywordBlock) -> bool:
        """Whether the last keyword of the file is one of its *ELEMENT: nothing tells that the list is whole."""
        return any(item.block is last for component in self.components for item in component.elements)

    def check_nodes_used(self, last: KeywordBlock) -> None:
        """MeshError where over a tenth of the nodes belong to no element; or 1 %, where the file ends with elements.

        `last`: the last keyword of the file.
        """
        share = MAX_CUT_SHARE if self.ends_with(last) else MAX_UNUSED_SHARE
        lost = self.unused_nodes()
        if self.cells and lost > max(MAX_UNUSED_NODES, share * len(self.used)):
            block = next(component for component in self.components if component.elements).elements[-1].block
            where = ", with which the file ends," if self.ends_with(last) else ""
            block.refuse(
                f"{lost} of {len(self.used)} nodes belong to no element; *ELEMENT{where} seems to be cut short. Export "
                "the file again, or delete the nodes that are not needed."
            )


def _refuse_element(item: ElementBlock, row: int, message: str) -> None:
    ends = item.block.numbers(np.int64)[1]
    item.block.refuse(message, int(np.searchsorted(ends, row * (item.nodes.shape[1] + 1), side="right")))


def find_in_sorted(ids: Indices, wanted: Indices) -> Indices:
    """Place of each wanted number among sorted ids; -1 where it is not there."""
    if not len(ids):
        return np.full(wanted.shape, -1, np.int64)
    first, last = int(ids[0]), int(ids[-1])
    if last - first == len(ids) - 1:  # numbered without gaps
        return np.where((wanted >= first) & (wanted <= last), wanted - first, -1)
    position = np.minimum(np.searchsorted(ids, wanted), len(ids) - 1)
    return np.where(ids[position] == wanted, position, -1)


def moved(points: Points, block: KeywordBlock) -> Points:
    """Points of an instance: translated by the first data line, then turned by the second one.

    The second line holds two points of the axis and the angle in degrees, right-handed from the first to the second
    point (Abaqus Keywords Guide, *INSTANCE). Rotation by the formula of Rodrigues.
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
    with np.errstate(all="ignore"):  # numbers out of reach are told by check_mesh
        if counts:
            points = points + values[:3]
        if len(counts) == 2:
            a, b, angle = values[3:6], values[6:9], np.radians(values[9])
            length = float(np.linalg.norm(b - a))
            if length == 0 or not np.isfinite(length):
                block.refuse("the two points of the axis of rotation are the same; give two that differ.", 1)
            axis, arms = (b - a) / length, points - a
            along = (arms @ axis)[:, None] * axis
            points = a + along + (arms - along) * np.cos(angle) + np.cross(axis, arms) * np.sin(angle)
    return points
