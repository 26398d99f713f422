"""The assembly of an Abaqus model: instances of parts placed in space, their nodes and cells numbered together.

The mesh of a part is numbered from 0 and checked for damage.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from .abaqus_deck import KeywordBlock
from .abaqus_model import NO_INDICES, Component, Deck, ElementBlock, SetEntry, facet_columns, label_key
from .data import Indices, Points, list_some
from .mesh_conversion import DAMAGE, dimension_of, shape_of
from .topology import Mask, distinct_rows, positions_of


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


@dataclass(eq=False)
class Instance:
    """An instance of a part; with the name "", what the assembly has of its own.

    Attributes:
        name: of the instance.
        part: key of its part.
        components: the part, then what the instance adds to it.
        mesh: nodes and cells, numbered from 0.
        first_node: index of its first node in the assembly.
        first_cells: kind -> index of its first cell of that kind in the assembly.
    """

    name: str
    part: str
    components: list[Component]
    mesh: LocalMesh
    first_node: int
    first_cells: dict[str, int] = field(default_factory=dict)

    @cached_property
    def elements(self) -> tuple[Indices, Indices]:
        """Element numbers, sorted, and the cell of each."""
        ids = [ids for ids, _ in self.mesh.cells.values()]
        if not ids:
            return NO_INDICES, NO_INDICES
        numbers = np.concatenate(ids)
        cells = np.concatenate([self.first_cells[kind] + np.arange(len(i)) for kind, (i, _) in self.mesh.cells.items()])
        order = np.argsort(numbers, kind="stable")
        return numbers[order], cells[order]

    @property
    def cells(self) -> Indices:
        """All cells, sorted."""
        return np.sort(self.elements[1])

    @cached_property
    def unused_ids(self) -> Indices:
        """Numbers of elements that are left out, such as springs, sorted."""
        ids = [ids for component in self.components for ids in component.unused_ids]
        return np.unique(np.concatenate(ids)) if ids else NO_INDICES

    @property
    def nodes_of_unused(self) -> Indices:
        """Nodes of the elements that are left out."""
        numbers = [numbers for component in self.components for numbers in component.unused_nodes]
        indices = positions_of(self.mesh.node_ids, np.concatenate([NO_INDICES, *numbers]))
        return self.first_node + indices[indices >= 0]

    def members(self, entry: SetEntry, nodes: bool) -> tuple[Indices, int]:
        """Nodes, or cells, of an entry of numbers or of a range, and how many of its members are not in the file."""
        ids, indices = (
            (self.mesh.node_ids, self.first_node + np.arange(len(self.mesh.node_ids))) if nodes else self.elements
        )
        unused = NO_INDICES if nodes else self.unused_ids
        if entry.span is not None:
            first, last, step = entry.span
            begin, end = np.searchsorted(ids, [first, last + 1])
            inside = (ids[begin:end] - first) % step == 0
            count = (last - first) // step + 1 - int(inside.sum())
            in_range = (unused >= first) & (unused <= last) & ((unused - first) % step == 0)
            return indices[begin:end][inside], max(0, count - int(in_range.sum()))
        assert entry.numbers is not None
        index = positions_of(ids, entry.numbers)
        lost = entry.numbers[index < 0]
        return indices[index[index >= 0]], len(lost) - int(np.isin(lost, unused).sum())


class Assembly:
    """The mesh of all instances; cells of one kind are numbered one after another.

    Attributes:
        instances: those of the deck, then the assembly itself.
        points: (n, 3) of all instances.
        kinds: cell types that occur.
        blocks: kind -> (m, k) nodes of its cells.
        starts: kind -> index of its first cell.
        cell_count: of all kinds.
        dim: the highest dimension of a cell.
        notes: messages to the user.
    """

    def __init__(self, deck: Deck) -> None:
        self.notes: list[str] = []
        self.instances = list(self._place(deck))
        self._by_name = {label_key(instance.name): instance for instance in self.instances if instance.name}
        self.points: Points = np.concatenate(self._points)
        self.kinds = list(dict.fromkeys(kind for instance in self.instances for kind in instance.mesh.cells))
        self.starts: dict[str, int] = {}
        self.cell_count = 0
        for kind in self.kinds:
            self.starts[kind] = self.cell_count
            for instance in self.instances:
                if kind in instance.mesh.cells:
                    instance.first_cells[kind] = self.cell_count
                    self.cell_count += len(instance.mesh.cells[kind][0])
        self.blocks = {
            kind: np.concatenate(
                [part.first_node + part.mesh.cells[kind][1] for part in self.instances if kind in part.mesh.cells]
            )
            for kind in self.kinds
        }
        self.dim = max((dimension_of(kind) for kind in self.kinds), default=0)

    def _place(self, deck: Deck) -> Iterator[Instance]:
        """The instances in their places; parts of a file without an assembly where they lie."""
        listed: list[tuple[str, str, list[Component], KeywordBlock | None]] = [
            (component.name, part, [deck.parts[part], component], block)
            for component, part, block in deck.instances.values()
        ]
        used = {part for _, part, *_ in listed}
        if not deck.instances and deck.parts:
            listed = [(part.name, key, [part], None) for key, part in deck.parts.items()]
            self.notes.append(
                "The file has *PART and no *ASSEMBLY: if it was cut off, bodies are missing. Its parts are read where "
                "they lie."
            )
        elif unused := [part.name for key, part in deck.parts.items() if key not in used]:
            self.notes.append(f"Parts without an instance are left out: {list_some(unused)}.")
        self._points: list[Points] = []
        meshes: dict[str, LocalMesh] = {}
        first_node = 0
        for name, part, components, block in [*listed, ("", "", [deck.assembly], None)]:
            added = components[-1]
            if added.nodes or added.elements or added.unused or not name:
                mesh = LocalMesh(components)
                mesh.check_nodes_used(deck.last)
            else:
                # instances that add nothing share the mesh of their part
                if part not in meshes:
                    meshes[part] = LocalMesh(components[:1])
                    meshes[part].check_nodes_used(deck.last)
                mesh = meshes[part]
            self._points.append(placed_points(mesh.points, block) if block else mesh.points)
            yield Instance(name, part, components, mesh, first_node)
            first_node += len(mesh.points)

    def instance(self, name: str) -> Instance | None:
        """The instance of a name; None if there is none."""
        return self._by_name.get(label_key(name))

    def by_kind(self, cells: Indices) -> Iterator[tuple[str, Indices, Indices]]:
        """For each kind among `cells` (sorted): its name, its nodes (m, k), and which of its cells are meant."""
        for kind in self.kinds:
            nodes = self.blocks[kind]
            begin, end = np.searchsorted(cells, [self.starts[kind], self.starts[kind] + len(nodes)])
            if end > begin:
                yield kind, nodes, cells[begin:end] - self.starts[kind]

    def split_by_kind(self, cells: Indices) -> list[Indices]:
        """For each kind the numbers within its block of those that are among `cells` (sorted)."""
        rows_of = {kind: rows for kind, _, rows in self.by_kind(cells)}
        return [rows_of.get(kind, NO_INDICES) for kind in self.kinds]

    def nodes_of(self, cells: Indices) -> Indices:
        """The nodes of cells, sorted."""
        parts = [nodes[rows].ravel() for _, nodes, rows in self.by_kind(cells)]
        return np.unique(np.concatenate(parts)) if parts else NO_INDICES

    def faces(self, cells: Indices, entry: SetEntry) -> Iterator[Indices]:
        """Nodes of the faces of cells that an entry of a surface identifies; of "" the free faces."""
        for kind, nodes, rows in self.by_kind(cells):
            if not entry.face:
                free = self._free_faces[kind]
                for columns, is_free in free:
                    yield nodes[rows][:, columns][is_free[rows]]
                if not free and dimension_of(kind) == self.dim - 1:
                    yield nodes[rows][:, : 3 if shape_of(kind) == "triangle" else 4]
                continue
            face = facet_columns(kind, entry.face)
            if face is None:
                entry.block.refuse(
                    f"a {shape_of(kind)} has no face '{entry.face[:20]}'; faces are S1, S2, ... of solid and plane "
                    "elements, SPOS, SNEG and E1, E2, ... of shells."
                )
            yield nodes[rows][:, face]

    @cached_property
    def _free_faces(self) -> dict[str, list[tuple[tuple[int, ...], Mask]]]:
        """For kinds of the highest dimension: columns of each face, and of which cells it belongs to no other cell."""
        faces: list[tuple[str, tuple[int, ...]]] = []
        rows = []
        for kind in self.kinds:
            if dimension_of(kind) == self.dim:
                for columns in _faces_of(kind):
                    corners = np.full((len(self.blocks[kind]), 4), -1, np.int64)
                    corners[:, : len(columns)] = self.blocks[kind][:, columns]
                    faces.append((kind, columns))
                    rows.append(np.sort(corners, axis=1))
        free: dict[str, list[tuple[tuple[int, ...], Mask]]] = {kind: [] for kind in self.kinds}
        if rows:
            _, counts, inverse = distinct_rows(np.concatenate(rows))
            single = np.split(counts[inverse] == 1, np.cumsum([len(r) for r in rows])[:-1])
            for (kind, columns), is_free in zip(faces, single, strict=True):
                free[kind].append((columns, is_free))
        return free

    def attached_cells(self) -> Mask:
        """Whether each cell is part of the body, or a facet of it.

        Facets with nodes outside the body (rigid tools), and lines that are no edges of plane cells (trusses, beams),
        are not.
        """
        attached = np.ones(self.cell_count, bool)
        if all(dimension_of(kind) == self.dim for kind in self.kinds):
            return attached
        of_body = np.zeros(len(self.points), bool)
        for kind in self.kinds:
            if dimension_of(kind) == self.dim:
                of_body[self.blocks[kind]] = True
        for kind in self.kinds:
            if dimension_of(kind) < self.dim:
                rows, begin = self.blocks[kind], self.starts[kind]
                is_facet = of_body[rows].all(axis=1) & (dimension_of(kind) == self.dim - 1)
                if self.dim == 2:
                    is_facet[is_facet] = self._are_edges(rows[is_facet, :2])
                attached[begin : begin + len(rows)] = is_facet
        return attached

    def _are_edges(self, lines: Indices) -> Mask:
        """Whether each pair of nodes (k, 2) is an edge of a plane cell."""
        marked = np.zeros(len(self.points), bool)
        marked[lines] = True
        edges: list[Indices] = [np.zeros((0, 2), np.int64)]
        for kind in self.kinds:
            for columns in _faces_of(kind) if dimension_of(kind) == 2 else ():
                pairs = self.blocks[kind][:, columns]
                edges.append(pairs[marked[pairs].all(axis=1)])
        pairs = np.sort(np.concatenate([*edges, lines]), axis=1)
        _, _, inverse = distinct_rows(pairs)
        of_cells = len(pairs) - len(lines)
        return np.isin(inverse[of_cells:], inverse[:of_cells])


def _faces_of(kind: str) -> list[tuple[int, ...]]:
    """Columns of each face of a cell type, or of each edge of a plane one."""
    return [columns for i in range(1, 7) if (columns := facet_columns(kind, f"S{i}"))]
