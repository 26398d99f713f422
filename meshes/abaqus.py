"""Bodies, sets and surfaces of an Abaqus input file (.inp).

Not by meshio (5.3): it ends a block at a comment, reads several instances as one body, ignores their translation and
rotation, and takes names of sets for cells.

Parts are placed once for each instance: translated, then turned about an axis. Every instance is a body with nodes of
its own. Sets and surfaces are collected first and resolved at the end, when every node and element has its number.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np

from .abaqus_deck import KeywordBlock, number
from .abaqus_elements import facet_columns, shape_of
from .abaqus_model import NO_INDICES, Component, Deck, NamedSet, SetEntry, label_key, list_names
from .abaqus_part import LocalMesh, find_in_sorted, moved
from .data import Indices, Points
from .mesh_conversion import DIMENSIONS, Block, MeshFileContents
from .topology import Mask, distinct_rows


def read_abaqus(path: Path) -> MeshFileContents:
    """Points, cells, sets and surfaces of an Abaqus input file.

    Element sets become sets of cells, node sets point sets, surfaces sets of facets. Where there are several instances
    their names are sets of cells as well. Materials, sections, steps and all else is skipped.

    Raises:
        MeshError: the file is damaged, or holds elements that cannot be used; the message names file and line.
    """
    return _Assembled(path, Deck(path)).contents()


# --- all instances ----------------------------------------------------------------------------------------------------


@dataclass(eq=False)
class _Placed:
    """An instance, or the assembly with what it has of its own: a mesh and the places of its numbers among all.

    Attributes:
        node_start: index of the first node among those of all instances.
        cell_starts: kind -> index of the first cell among those of all instances.
    """

    name: str
    part: str
    components: list[Component]
    mesh: LocalMesh
    node_start: int
    cell_starts: dict[str, int] = field(default_factory=dict)

    @cached_property
    def elements(self) -> tuple[Indices, Indices]:
        """Element numbers, sorted, and their cells."""
        ids = [ids for ids, _ in self.mesh.cells.values()]
        if not ids:
            return NO_INDICES, NO_INDICES
        numbers = np.concatenate(ids)
        cells = np.concatenate([self.cell_starts[kind] + np.arange(len(i)) for kind, (i, _) in self.mesh.cells.items()])
        order = np.argsort(numbers, kind="stable")
        return numbers[order], cells[order]

    @cached_property
    def unused_ids(self) -> Indices:
        ids = [ids for component in self.mesh.components for ids in component.unused_ids]
        return np.unique(np.concatenate(ids)) if ids else NO_INDICES

    def members(self, entry: SetEntry, nodes: bool) -> tuple[Indices, int]:
        """Nodes or cells that an entry gives by numbers or as a range, and how many of them are not in the file."""
        ids, positions = (
            (self.mesh.node_ids, self.node_start + np.arange(len(self.mesh.node_ids))) if nodes else self.elements
        )
        unused = NO_INDICES if nodes else self.unused_ids
        if entry.span is not None:
            first, last, step = entry.span
            begin, end = np.searchsorted(ids, [first, last + 1])
            inside = (ids[begin:end] - first) % step == 0
            count = (last - first) // step + 1 - int(inside.sum())
            return positions[begin:end][inside], max(0, count - _in_range(unused, first, last, step))
        assert entry.numbers is not None
        position = find_in_sorted(ids, entry.numbers)
        lost = entry.numbers[position < 0]
        return positions[position[position >= 0]], len(lost) - int(np.isin(lost, unused).sum())


def _edges(kind: str) -> list[tuple[int, ...]]:
    """Columns of the edges of a plane cell; none of another one."""
    if DIMENSIONS.get(shape_of(kind), 3) != 2:
        return []
    return [columns for i in range(1, 5) if (columns := facet_columns(kind, f"S{i}"))]


def _in_range(ids: Indices, first: int, last: int, step: int) -> int:
    return int(((ids >= first) & (ids <= last) & ((ids - first) % step == 0)).sum())


class _Assembled:
    """The mesh of all instances, and sets and surfaces in its numbers."""

    def __init__(self, path: Path, deck: Deck) -> None:
        self.path, self.deck = path, deck
        self.notes = list(deck.notes)
        self.placed = list(self._place())
        self.by_name = {label_key(placed.name): placed for placed in self.placed}
        self.kinds = list(dict.fromkeys(kind for placed in self.placed for kind in placed.mesh.cells))
        self.starts: dict[str, int] = {}
        total = 0
        for kind in self.kinds:
            self.starts[kind] = total
            for placed in self.placed:
                if kind in placed.mesh.cells:
                    placed.cell_starts[kind] = total
                    total += len(placed.mesh.cells[kind][0])
        self.total = total
        self.blocks = {
            kind: np.concatenate(
                [p.node_start + p.mesh.cells[kind][1] for p in self.placed if kind in p.mesh.cells]
            )
            for kind in self.kinds
        }  # fmt: skip
        self.node_count = sum(map(len, self.points))
        self.dim = max((DIMENSIONS.get(shape_of(kind), 3) for kind in self.kinds), default=0)
        self._definitions: dict[tuple[str, str], dict[str, list[NamedSet]]] = {}
        self._surface_facets: dict[tuple[str, str], tuple[list[Indices], Indices]] = {}
        self._lost: dict[str, int] = {}
        self._resolved: dict[tuple[str, str, str], Indices] = {}
        self._resolving: list[tuple[str, str, str]] = []

    def _place(self) -> Iterator[_Placed]:
        deck, start = self.deck, 0
        meshes: dict[str, LocalMesh] = {}
        self.points: list[Points] = []
        result: list[tuple[str, str, list[Component], KeywordBlock | None]] = [
            (owned.name, part, [deck.parts[part], owned], block) for owned, part, block in deck.instances.values()
        ]
        if not deck.instances and deck.parts:
            result = [(part.name, key, [part], None) for key, part in deck.parts.items()]
            self.notes.append(
                "The file has *PART and no *ASSEMBLY: if it was cut off, bodies are missing. Its parts are read where "
                "they lie."
            )
        elif left := [part.name for key, part in deck.parts.items() if key not in {f[1] for f in result}]:
            self.notes.append(f"Parts without an instance are left out: {list_names(left)}.")
        for name, part, components, block in [*result, ("", "", [deck.assembly], None)]:
            owned = components[-1]
            if owned.nodes or owned.elements or owned.unused or not name:
                mesh = LocalMesh(components)
                mesh.check_nodes_used(deck.last)
            else:
                if part not in meshes:
                    meshes[part] = LocalMesh(components[:1])
                    meshes[part].check_nodes_used(deck.last)
                mesh = meshes[part]
            self.points.append(moved(mesh.points, block) if block else mesh.points)
            placed = _Placed(name, part, components, mesh, start)
            start += len(mesh.points)
            yield placed

    # --- sets ---

    def _target(self, placed: _Placed, entry: SetEntry, what: str) -> tuple[_Placed, SetEntry]:
        """Whose numbers and sets an entry means: those of INSTANCE=, of "instance.name", or of its own component."""
        if entry.instance:
            if placed.name or label_key(entry.instance) not in self.by_name:
                entry.block.refuse(self._unknown("instance", entry.instance, [p.name for p in self.placed if p.name]))
            return self.by_name[label_key(entry.instance)], entry
        if not entry.name or label_key(entry.name) in self._sets_of(placed, what) or placed.name:
            return placed, entry
        name = entry.name
        for dot in (i for i, letter in enumerate(name) if letter == "."):
            instance = self.by_name.get(label_key(name[:dot].strip('" ')))
            if instance is None or not instance.name:
                continue
            after = name[dot + 1 :].strip().strip('"').strip()
            value = number(after, np.int64)
            numbers = None if value is None else np.array([value], np.int64)
            return instance, SetEntry(
                entry.block, numbers, name="" if numbers is not None else after, of_elements=entry.of_elements,
                face=entry.face,
            )  # fmt: skip
        return placed, entry

    def _sets_of(self, placed: _Placed, what: str) -> dict[str, list[NamedSet]]:
        """Sets that an instance has from its part or of its own, by key; `what` is an attribute of Component."""
        key = (label_key(placed.name), what)
        if key not in self._definitions:
            sets = self._definitions[key] = {}
            for component in placed.components:
                for name, named in getattr(component, what).items():
                    sets.setdefault(name, []).append(named)
        return self._definitions[key]

    @staticmethod
    def _unknown(what: str, name: str, known: list[str]) -> str:
        return f"there is no {what} '{name[:80]}'; known are: {list_names(known)}. Is the file cut or damaged?"

    def _enter(self, key: tuple[str, str, str], entry: SetEntry | None) -> None:
        if key in self._resolving or len(self._resolving) > 200:
            assert entry is not None
            entry.block.refuse(f"the set '{entry.name}' contains itself, or sets are nested too deep.")
        self._resolving.append(key)

    def resolve(self, placed: _Placed, what: str, name: str, asked: SetEntry | None = None) -> Indices:
        """Nodes (`what` is "node_sets") or cells ("element_sets") of a set."""
        key = (label_key(placed.name), what, label_key(name))
        if key in self._resolved:
            return self._resolved[key]
        sets = self._sets_of(placed, what)
        if key[2] not in sets:
            assert asked is not None
            kind = "node set" if what == "node_sets" else "element set"
            asked.block.refuse(self._unknown(kind, name, [named[0].name for named in sets.values()]))
        self._enter(key, asked)
        parts = [self._members(placed, what, named, entry) for named in sets[key[2]] for entry in named.entries]
        self._resolving.pop()
        self._resolved[key] = np.unique(np.concatenate(parts)) if parts else NO_INDICES
        return self._resolved[key]

    def _members(self, placed: _Placed, what: str, named: NamedSet, entry: SetEntry) -> Indices:
        looked_up = "element_sets" if entry.of_elements else what
        placed, entry = self._target(placed, entry, looked_up)
        if entry.name:
            members = self.resolve(placed, looked_up, entry.name, entry)
            return self._nodes_of(members) if entry.of_elements else members
        members, lost = placed.members(entry, what == "node_sets")
        if lost:
            self._lost[named.name] = self._lost.get(named.name, 0) + lost
        return members

    def _nodes_of(self, cells: Indices) -> Indices:
        parts = [nodes[rows].ravel() for _, nodes, rows in self._by_kind(cells)]
        return np.unique(np.concatenate(parts)) if parts else NO_INDICES

    def _by_kind(self, cells: Indices) -> Iterator[tuple[str, Indices, Indices]]:
        """Kind, nodes of all cells of that kind, and which of them are among `cells` (sorted)."""
        for kind in self.kinds:
            nodes = self.blocks[kind]
            begin, end = np.searchsorted(cells, [self.starts[kind], self.starts[kind] + len(nodes)])
            if end > begin:
                yield kind, nodes, cells[begin:end] - self.starts[kind]

    # --- surfaces ---

    def surface(self, placed: _Placed, name: str, asked: SetEntry | None = None) -> tuple[list[Indices], Indices]:
        """Facets of a surface, arrays of node numbers, and its nodes if it is one of nodes."""
        sets = self._sets_of(placed, "surfaces")
        if label_key(name) not in sets:
            assert asked is not None
            asked.block.refuse(self._unknown("surface", name, [named[0].name for named in sets.values()]))
        key = (label_key(placed.name), label_key(name))
        if key in self._surface_facets:
            return self._surface_facets[key]
        self._enter((key[0], "surfaces", key[1]), asked)
        facets: list[Indices] = []
        nodes: list[Indices] = [NO_INDICES]
        for surface in sets[key[1]]:
            for entry in surface.entries:
                if surface.surface_kind == "UNION":
                    details, points = self.surface(*self._named_surface(placed, entry))
                    facets += details
                    nodes.append(points)
                elif surface.surface_kind == "NODE":
                    nodes.append(self._members(placed, "node_sets", surface, entry))
                elif not entry.name and entry.numbers is None:
                    facets += self._faces(np.sort(placed.elements[1]), entry)
                else:
                    facets += self._faces(np.sort(self._members(placed, "element_sets", surface, entry)), entry)
        self._resolving.pop()
        widths = sorted({rows.shape[1] for rows in facets})
        by_width = [np.concatenate([rows for rows in facets if rows.shape[1] == width]) for width in widths]
        once = [distinct_rows(rows)[0] for rows in by_width]
        self._surface_facets[key] = once, np.unique(np.concatenate(nodes))
        return self._surface_facets[key]

    def _named_surface(self, placed: _Placed, entry: SetEntry) -> tuple[_Placed, str, SetEntry]:
        target, meant = self._target(placed, entry, "surfaces")
        if not meant.name:
            entry.block.refuse(f"'{entry.name[:80]}' is a number; COMBINE=UNION needs names of surfaces.")
        return target, meant.name, meant

    def _faces(self, cells: Indices, entry: SetEntry) -> Iterator[Indices]:
        for kind, nodes, rows in self._by_kind(cells):
            if not entry.face:
                free = self._free[kind]
                for columns, is_free in free:
                    yield nodes[rows][:, columns][is_free[rows]]
                if not free and DIMENSIONS.get(shape_of(kind), 3) == self.dim - 1:
                    yield nodes[rows][:, : 3 if shape_of(kind) == "triangle" else 4]
                continue
            chosen = facet_columns(kind, entry.face)
            if chosen is None:
                entry.block.refuse(
                    f"a {shape_of(kind)} has no face '{entry.face[:20]}'; faces are S1, S2, ... of solid and plane "
                    "elements, SPOS, SNEG and E1, E2, ... of shells."
                )
            yield nodes[rows][:, chosen]

    @cached_property
    def _free(self) -> dict[str, list[tuple[tuple[int, ...], Mask]]]:
        """For the kinds of the highest dimension: columns of each face, and whether it belongs to one cell only."""
        faces: list[tuple[str, tuple[int, ...]]] = []
        rows = []
        for kind in self.kinds:
            if DIMENSIONS.get(shape_of(kind), 3) == self.dim:
                identifiers = (f"S{i}" for i in range(1, 7))
                for columns in filter(None, (facet_columns(kind, identifier) for identifier in identifiers)):
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

    # --- names ---

    def _published(self, what: str) -> Iterator[tuple[str, list[tuple[_Placed, str]]]]:
        """Names for the user, and the sets of instances that each name stands for.

        A set of the assembly has its name; so has one of a part, for all its instances together. Where several
        instances have a set of that name, each one is also named "instance.set"; only so where the assembly or another
        part has a set of the same name.
        """
        holders: dict[str, list[tuple[_Placed, str]]] = {}
        for placed in self.placed:
            for key, named in self._sets_of(placed, what).items():
                if not all(first.internal for first in named):
                    holders.setdefault(key, []).append((placed, named[0].name))
        apart = []
        for entries in holders.values():
            owned = [item for item in entries if not item[0].name]
            remaining = [item for item in entries if item[0].name]
            mixed = len({placed.part for placed, _ in remaining}) > 1
            if owned:
                yield owned[0][1], owned
            elif not mixed:
                yield remaining[0][1], remaining
            if mixed or len(remaining) > 1 or (owned and remaining):
                for placed, name in remaining:
                    yield f"{placed.name}.{name}", [(placed, name)]
            if mixed or (owned and remaining):
                apart.append(entries[0][1])
        if apart:
            kind = what.replace("_", " ")
            self.notes.append(
                f"Several parts, or a part and the assembly, have {kind} of the same name: {list_names(apart)}. Those "
                "of parts are called by instance and name, as 'Part-1-1.Set-1'."
            )

    # --- result ---

    def contents(self) -> MeshFileContents:
        """Everything as Contents; see read_abaqus."""
        blocks = [Block(kind, self.blocks[kind]) for kind in self.kinds]
        attached = self._attached()
        cells = {}
        for name, entries in self._published("element_sets"):
            members = np.unique(
                np.concatenate([self.resolve(placed, "element_sets", owned) for placed, owned in entries])
            )
            cells[name] = members[attached[members]]
        bodies = [placed for placed in self.placed if placed.name and placed.mesh.cells]
        if len(bodies) > 1:
            for placed in bodies:
                cells.setdefault(placed.name, np.sort(placed.elements[1]))
        points = {
            name: np.unique(np.concatenate([self.resolve(placed, "node_sets", owned) for placed, owned in entries]))
            for name, entries in self._published("node_sets")
        }
        sets = {name: self._rows(members) for name, members in cells.items() if len(members)}
        self._note_unused(cells, blocks)
        facets = self._surfaces(points)
        for corners in (2, 3, 4):
            names = {name: [f for f in result if f.shape[1] == corners] for name, result in facets.items()}
            names = {name: result for name, result in names.items() if result}
            if (corners == 2) != (self.dim == 2) or not names:
                continue
            ends = np.cumsum([0] + [sum(map(len, result)) for result in names.values()])
            rows = np.concatenate([np.concatenate(result) for result in names.values()])
            blocks.append(Block({2: "line", 3: "triangle", 4: "quad"}[corners], rows))
            for name, begin, end in zip(names, ends, ends[1:], strict=False):
                empty = [NO_INDICES] * (len(blocks) - 1)
                before = sets.get(name, empty)
                sets[name] = [*before, *empty[len(before) :], np.arange(begin, end)]
        if remaining := [ids for placed in self.placed for ids in self._nodes_of_unused(placed)]:
            blocks.append(Block("vertex", np.unique(np.concatenate(remaining))[:, None]))
        sets = {name: [*parts, *[NO_INDICES] * (len(blocks) - len(parts))] for name, parts in sets.items()}
        for mesh in dict.fromkeys(placed.mesh for placed in self.placed):
            if mesh.ends_with(self.deck.last) and (unused := mesh.unused_nodes()):
                self.notes.append(
                    f"The file ends with elements, and {unused} nodes belong to none of them: if it was cut off, cells "
                    "are missing. Compare the number of elements with that of the program that wrote it."
                )
            missing, first = mesh.missing_numbers()
            if missing:
                where = f" of part '{mesh.components[0].name}'" if mesh.components[0].name else ""
                self.notes.append(
                    f"Element numbers{where} left out: {missing}, first {first}; are lines of the file lost?"
                )
        if self._lost:
            total = sum(self._lost.values())
            self.notes.append(
                f"Sets name {total} nodes or elements that are not in the file: {list_names([*self._lost])}. Is it "
                "whole?"
            )
        return MeshFileContents(np.concatenate(self.points), blocks, sets, points, notes=tuple(self.notes))

    @staticmethod
    def _nodes_of_unused(placed: _Placed) -> Iterator[Indices]:
        """Nodes that springs, beams and the like name: their elements are left out, but have not been lost."""
        for component in placed.mesh.components:
            for ids in component.unused_nodes:
                positions = find_in_sorted(placed.mesh.node_ids, ids)
                yield placed.node_start + positions[positions >= 0]

    def _attached(self) -> Mask:
        """Which cells are of the body, or lie on it.

        Facets whose nodes are not all of the body (rigid tools) and lines that are no edges of plane cells (trusses,
        beams) are not.
        """
        attached = np.ones(self.total, bool)
        level = {kind: DIMENSIONS.get(shape_of(kind), 3) for kind in self.kinds}
        if all(dim == self.dim for dim in level.values()):
            return attached
        of_body = np.zeros(self.node_count, bool)
        for kind in self.kinds:
            if level[kind] == self.dim:
                of_body[self.blocks[kind]] = True
        for kind in self.kinds:
            if level[kind] < self.dim:
                rows, begin = self.blocks[kind], self.starts[kind]
                present = of_body[rows].all(axis=1) & (level[kind] == self.dim - 1)
                if self.dim == 2:
                    present[present] = self._are_edges(rows[present, :2])
                attached[begin : begin + len(rows)] = present
        return attached

    def _are_edges(self, lines: Indices) -> Mask:
        """Which pairs of nodes are edges of plane cells."""
        marked = np.zeros(self.node_count, bool)
        marked[lines] = True
        edges: list[Indices] = [np.zeros((0, 2), np.int64)]
        for kind in self.kinds:
            for columns in _edges(kind):
                pairs = self.blocks[kind][:, columns]
                edges.append(pairs[marked[pairs].all(axis=1)])
        pairs = np.sort(np.concatenate([*edges, lines]), axis=1)
        _, _, inverse = distinct_rows(pairs)
        allowed = len(pairs) - len(lines)
        return np.isin(inverse[allowed:], inverse[:allowed])

    def _rows(self, cells: Indices) -> list[Indices]:
        result = {kind: rows for kind, _, rows in self._by_kind(cells)}
        return [result.get(kind, NO_INDICES) for kind in self.kinds]

    def _surfaces(self, points: dict[str, Indices]) -> dict[str, list[Indices]]:
        """Facets by the surface's name; nodes of surfaces of nodes are added to `points`."""
        facets: dict[str, list[Indices]] = {}
        empty = []
        for name, entries in self._published("surfaces"):
            useful = False
            for placed, owned in entries:
                rows, nodes = self.surface(placed, owned)
                rows = [row for row in rows if len(row) and (row.shape[1] == 2) == (self.dim == 2)]
                facets.setdefault(name, []).extend(rows)
                if len(nodes):
                    points[name] = np.union1d(points.get(name, NO_INDICES), nodes)
                useful |= bool(rows) or len(nodes) > 0
            if not useful:
                empty.append(name)
        if empty:
            self.notes.append(f"Surfaces that hold no facet of the body are not used: {list_names(empty)}.")
        return facets

    def _note_unused(self, cells: dict[str, Indices], blocks: list[Block]) -> None:
        counts: dict[str, int] = {}
        for placed in self.placed:
            for component in placed.mesh.components:
                for element_type, count in component.unused.items():
                    counts[element_type] = counts.get(element_type, 0) + count
        in_sets = np.zeros(self.total, bool)
        for members in cells.values():
            in_sets[members] = True
        for kind, block in zip(self.kinds, blocks, strict=True):
            level = DIMENSIONS.get(shape_of(kind), 3)
            begin = self.starts[kind]
            named = int(in_sets[begin : begin + len(block.nodes)].sum()) if level == self.dim - 1 else 0
            if level < self.dim and (unused := len(block.nodes) - named):
                counts[kind] = counts.get(kind, 0) + unused
        if counts:
            listed = list_names([f"{count} {name}" for name, count in counts.items()])
            self.notes.append(f"Elements that are not part of the body are not used: {listed}.")
