"""Bodies, sets and surfaces of an Abaqus input file (.inp).

An instance of a part is translated, then rotated about an axis, and is a body with nodes of its own. Sets and surfaces
are resolved when all nodes and elements of all instances are numbered.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np

from .abaqus_assembly import Assembly, Instance
from .abaqus_deck import parse_number
from .abaqus_model import NO_INDICES, Deck, NamedSet, SetEntry, label_key
from .data import Indices, list_some
from .mesh_conversion import DAMAGE, Block, MeshFileContents, dimension_of
from .topology import distinct_rows

Table = str  # an attribute of Component: "node_sets", "element_sets" or "surfaces"
MAX_DEPTH = 200  # of sets of sets; deeper ones name themselves by way of others


class SetResolver:
    """Members of the sets and surfaces of an assembly.

    Attributes:
        lost: name of a set -> how many of its members are not in the file.
    """

    def __init__(self, assembly: Assembly) -> None:
        self.assembly = assembly
        self.lost: dict[str, int] = {}
        self._tables: dict[tuple[str, Table], dict[str, list[NamedSet]]] = {}
        self._members_of: dict[tuple[str, Table, str], Indices] = {}
        self._facets_of: dict[tuple[str, str], tuple[list[Indices], Indices]] = {}
        self._resolving: list[tuple[str, Table, str]] = []

    def sets_of(self, instance: Instance, table: Table) -> dict[str, list[NamedSet]]:
        """Sets of an instance by key: those of its part and its own."""
        key = (label_key(instance.name), table)
        if key not in self._tables:
            sets = self._tables[key] = {}
            for component in instance.components:
                for name, named in getattr(component, table).items():
                    sets.setdefault(name, []).append(named)
        return self._tables[key]

    def members(self, instance: Instance, table: Table, name: str, asked_by: SetEntry | None = None) -> Indices:
        """Nodes or cells, sorted, of a set of an instance.

        `asked_by`: the entry that names the set, which a MeshError points to.
        """
        key = (label_key(instance.name), table, label_key(name))
        if key in self._members_of:
            return self._members_of[key]
        sets = self.sets_of(instance, table)
        if key[2] not in sets:
            assert asked_by is not None
            kind = "node set" if table == "node_sets" else "element set"
            asked_by.block.refuse(_unknown(kind, name, (named[0].name for named in sets.values())))
        self._enter(key, asked_by)
        parts = [self._members(instance, table, named, entry) for named in sets[key[2]] for entry in named.entries]
        self._resolving.pop()
        self._members_of[key] = np.unique(np.concatenate(parts)) if parts else NO_INDICES
        return self._members_of[key]

    def _members(self, instance: Instance, table: Table, named: NamedSet, entry: SetEntry) -> Indices:
        """Nodes or cells of one entry of a set."""
        looked_up = "element_sets" if entry.of_elements else table
        instance, entry = self._target(instance, entry, looked_up)
        if entry.name:
            members = self.members(instance, looked_up, entry.name, entry)
            return self.assembly.nodes_of(members) if entry.of_elements else members
        members, lost = instance.members(entry, table == "node_sets")
        if lost:
            self.lost[named.name] = self.lost.get(named.name, 0) + lost
        return members

    def _target(self, instance: Instance, entry: SetEntry, table: Table) -> tuple[Instance, SetEntry]:
        """The instance that an entry refers to, and the entry as it reads there.

        The instance of INSTANCE=, of "instance.name", or the one that has the entry.
        """
        if entry.instance:
            target = self.assembly.instance(entry.instance)
            if instance.name or target is None:
                names = (candidate.name for candidate in self.assembly.instances if candidate.name)
                entry.block.refuse(_unknown("instance", entry.instance, names))
            return target, entry
        if not entry.name or label_key(entry.name) in self.sets_of(instance, table) or instance.name:
            return instance, entry
        # names may have points themselves: the first prefix that is an instance counts
        for dot in (i for i, letter in enumerate(entry.name) if letter == "."):
            target = self.assembly.instance(entry.name[:dot].strip('" '))
            if target is None:
                continue
            local_name = entry.name[dot + 1 :].strip().strip('"').strip()
            value = parse_number(local_name, np.int64)
            numbers = None if value is None else np.array([value], np.int64)
            name = local_name if numbers is None else ""
            return target, SetEntry(entry.block, numbers, name=name, of_elements=entry.of_elements, face=entry.face)
        return instance, entry

    def _enter(self, key: tuple[str, Table, str], asked_by: SetEntry | None) -> None:
        """Note that a set is being resolved; MeshError if it is already."""
        if key in self._resolving or len(self._resolving) > MAX_DEPTH:
            assert asked_by is not None
            asked_by.block.refuse(f"the set '{asked_by.name}' contains itself, or sets are nested too deep.")
        self._resolving.append(key)

    def facets(self, instance: Instance, name: str, asked_by: SetEntry | None = None) -> tuple[list[Indices], Indices]:
        """Facets of a surface, an array for each number of corners; and the nodes of a surface of nodes."""
        sets = self.sets_of(instance, "surfaces")
        if label_key(name) not in sets:
            assert asked_by is not None
            asked_by.block.refuse(_unknown("surface", name, (named[0].name for named in sets.values())))
        key = (label_key(instance.name), label_key(name))
        if key in self._facets_of:
            return self._facets_of[key]
        self._enter((key[0], "surfaces", key[1]), asked_by)
        facets: list[Indices] = []
        nodes: list[Indices] = [NO_INDICES]
        for surface in sets[key[1]]:
            for entry in surface.entries:
                if surface.surface_kind == "UNION":
                    target, meant = self._target(instance, entry, "surfaces")
                    if not meant.name:
                        entry.block.refuse(f"'{entry.name[:80]}' is a number; COMBINE=UNION needs names of surfaces.")
                    united, points = self.facets(target, meant.name, meant)
                    facets += united
                    nodes.append(points)
                elif surface.surface_kind == "NODE":
                    nodes.append(self._members(instance, "node_sets", surface, entry))
                else:
                    whole = not entry.name and entry.numbers is None
                    cells = (
                        instance.cells if whole else np.sort(self._members(instance, "element_sets", surface, entry))
                    )
                    facets += self.assembly.faces(cells, entry)
        self._resolving.pop()
        widths = sorted({rows.shape[1] for rows in facets})
        by_width = [np.concatenate([rows for rows in facets if rows.shape[1] == width]) for width in widths]
        self._facets_of[key] = [distinct_rows(rows)[0] for rows in by_width], np.unique(np.concatenate(nodes))
        return self._facets_of[key]

    def published(self, table: Table, notes: list[str]) -> Iterator[tuple[str, list[tuple[Instance, str]]]]:
        """Names for the user, and the sets of instances that each name stands for.

        A set of the assembly keeps its name; a set of a part has its name for all instances together. If several
        instances have a set of that name, each is also named "instance.set"; only so if the assembly or another part
        has a set of the same name, which a note tells.
        """
        holders: dict[str, list[tuple[Instance, str]]] = {}
        for instance in self.assembly.instances:
            for key, named in self.sets_of(instance, table).items():
                if not all(definition.internal for definition in named):
                    holders.setdefault(key, []).append((instance, named[0].name))
        ambiguous = []
        for entries in holders.values():
            of_assembly = [(instance, name) for instance, name in entries if not instance.name]
            of_parts = [(instance, name) for instance, name in entries if instance.name]
            several_parts = len({instance.part for instance, _ in of_parts}) > 1
            if of_assembly:
                yield of_assembly[0][1], of_assembly
            elif not several_parts:
                yield of_parts[0][1], of_parts
            if several_parts or len(of_parts) > 1 or (of_assembly and of_parts):
                for instance, name in of_parts:
                    yield f"{instance.name}.{name}", [(instance, name)]
            if several_parts or (of_assembly and of_parts):
                ambiguous.append(entries[0][1])
        if ambiguous:
            notes.append(
                f"Several parts, or a part and the assembly, have {table.replace('_', ' ')} of the same name: "
                f"{list_some(ambiguous)}. Those of parts are called by instance and name, as 'Part-1-1.Set-1'."
            )


def _unknown(what: str, name: str, known: Iterable[str]) -> str:
    return f"there is no {what} '{name[:80]}'; known are: {list_some(known)}. Is the file cut or damaged?"


def read_abaqus(path: Path) -> MeshFileContents:
    """Points, cells, sets and surfaces of an Abaqus input file.

    Element sets become sets of cells, node sets point sets, surfaces sets of facets. If there are several instances,
    each is a set of cells too. Materials, sections, steps and other keywords are skipped.

    Raises:
        MeshError: the file is damaged, or holds elements that cannot be used; the message names file and line.
    """
    # Not by meshio 5.3: it ends a block at a comment, reads several instances as one body, ignores their translation
    # and rotation, and takes names of sets for cells.
    deck = Deck(path)
    assembly = Assembly(deck)
    resolver = SetResolver(assembly)
    notes = [*deck.notes, *assembly.notes]
    cells = _cell_sets(assembly, resolver, notes)
    point_sets = {
        name: np.unique(
            np.concatenate([resolver.members(instance, "node_sets", set_name) for instance, set_name in holders])
        )
        for name, holders in resolver.published("node_sets", notes)
    }
    notes += _unused_elements(assembly, cells)
    blocks = [Block(kind, assembly.blocks[kind]) for kind in assembly.kinds]
    sets = {name: assembly.split_by_kind(members) for name, members in cells.items() if len(members)}
    _add_facets(blocks, sets, _surfaces(assembly, resolver, point_sets, notes), assembly.dim)
    unused = np.concatenate([NO_INDICES, *(instance.nodes_of_unused for instance in assembly.instances)])
    if any(component.unused_nodes for instance in assembly.instances for component in instance.components):
        blocks.append(Block("vertex", np.unique(unused)[:, None]))  # as cells, lest they count as lost nodes
    sets = {name: [*parts, *[NO_INDICES] * (len(blocks) - len(parts))] for name, parts in sets.items()}
    notes += _signs_of_damage(deck, assembly, resolver)
    return MeshFileContents(assembly.points, blocks, sets, point_sets, notes=tuple(notes))


def _cell_sets(assembly: Assembly, resolver: SetResolver, notes: list[str]) -> dict[str, Indices]:
    """Cells of the element sets, and of each of several instances; those outside the body are left out of sets."""
    attached = assembly.attached_cells()
    cells = {}
    for name, holders in resolver.published("element_sets", notes):
        members = np.unique(
            np.concatenate([resolver.members(instance, "element_sets", set_name) for instance, set_name in holders])
        )
        cells[name] = members[attached[members]]
    bodies = [instance for instance in assembly.instances if instance.name and instance.mesh.cells]
    if len(bodies) > 1:
        for instance in bodies:
            cells.setdefault(instance.name, instance.cells)
    return cells


def _surfaces(
    assembly: Assembly, resolver: SetResolver, point_sets: dict[str, Indices], notes: list[str]
) -> dict[str, list[Indices]]:
    """Facets of each surface; nodes of surfaces of nodes are added to `point_sets`."""
    facets: dict[str, list[Indices]] = {}
    empty = []
    for name, holders in resolver.published("surfaces", notes):
        is_used = False
        for instance, set_name in holders:
            rows, nodes = resolver.facets(instance, set_name)
            rows = [row for row in rows if len(row) and (row.shape[1] == 2) == (assembly.dim == 2)]
            facets.setdefault(name, []).extend(rows)
            if len(nodes):
                point_sets[name] = np.union1d(point_sets.get(name, NO_INDICES), nodes)
            is_used |= bool(rows) or len(nodes) > 0
        if not is_used:
            empty.append(name)
    if empty:
        notes.append(f"Surfaces that hold no facet of the body are not used: {list_some(empty)}.")
    return facets


def _add_facets(
    blocks: list[Block], sets: dict[str, list[Indices]], facets: dict[str, list[Indices]], dim: int
) -> None:
    """Add a block for each kind of facet of the surfaces, and the surfaces to the sets."""
    for kind, corners in (("line", 2),) if dim == 2 else (("triangle", 3), ("quad", 4)):
        of_kind = {name: [rows for rows in arrays if rows.shape[1] == corners] for name, arrays in facets.items()}
        of_kind = {name: arrays for name, arrays in of_kind.items() if arrays}
        if not of_kind:
            continue
        ends = np.cumsum([0] + [sum(map(len, arrays)) for arrays in of_kind.values()])
        blocks.append(Block(kind, np.concatenate([rows for arrays in of_kind.values() for rows in arrays])))
        for name, begin, end in zip(of_kind, ends, ends[1:], strict=False):
            before = sets.get(name, [])
            padding = [NO_INDICES] * (len(blocks) - 1 - len(before))
            sets[name] = [*before, *padding, np.arange(begin, end)]


def _unused_elements(assembly: Assembly, cells: dict[str, Indices]) -> list[str]:
    """A note with the numbers of elements that are no part of the body, nor facets in a set."""
    counts: dict[str, int] = {}
    for instance in assembly.instances:
        for component in instance.components:
            for element_type, count in component.unused.items():
                counts[element_type] = counts.get(element_type, 0) + count
    in_sets = np.zeros(assembly.cell_count, bool)
    for members in cells.values():
        in_sets[members] = True
    for kind, nodes in assembly.blocks.items():
        dim, begin = dimension_of(kind), assembly.starts[kind]
        in_use = int(in_sets[begin : begin + len(nodes)].sum()) if dim == assembly.dim - 1 else 0
        if dim < assembly.dim and (unused := len(nodes) - in_use):
            counts[kind] = counts.get(kind, 0) + unused
    if not counts:
        return []
    listed = list_some(f"{count} {name}" for name, count in counts.items())
    return [f"Elements that are not part of the body are not used: {listed}."]


def _signs_of_damage(deck: Deck, assembly: Assembly, resolver: SetResolver) -> list[str]:
    """Notes that lines of the file may be missing."""
    notes = []
    for mesh in dict.fromkeys(instance.mesh for instance in assembly.instances):
        if mesh.ends_with(deck.last) and (unused := mesh.unused_nodes()):
            notes.append(
                f"The file ends with elements, and {unused} nodes belong to none of them: if it was cut off, cells "
                "are missing. Compare the number of elements with that of the program that wrote it."
            )
        numbers = mesh.element_ids()
        gaps, first = DAMAGE.gaps_in(numbers, int(numbers.min())) if len(numbers) else (0, 0)
        if gaps:
            where = f" of part '{mesh.components[0].name}'" if mesh.components[0].name else ""
            notes.append(f"Element numbers{where} left out: {gaps}, first {first}; are lines of the file lost?")
    if lost := resolver.lost:
        notes.append(
            f"Sets name {sum(lost.values())} nodes or elements that are not in the file: {list_some(lost)}. Is it "
            "whole?"
        )
    return notes
