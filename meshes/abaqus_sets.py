"""Sets and surfaces of an Abaqus model, resolved to nodes, cells and facets of its assembly."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np

from .abaqus_assembly import Assembly, Instance
from .abaqus_deck import parse_number
from .abaqus_model import NO_INDICES, NamedSet, SetEntry, label_key
from .data import Indices, list_some
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
