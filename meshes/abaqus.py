"""Bodies, sets and surfaces of an Abaqus input file (.inp).

An instance of a part is translated, then rotated about an axis, and is a body with nodes of its own. Sets and surfaces
are resolved when all nodes and elements of all instances are numbered.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from .abaqus_assembly import Assembly
from .abaqus_model import NO_INDICES, Deck
from .abaqus_sets import SetResolver
from .data import Indices, list_some
from .mesh_conversion import DAMAGE, Block, MeshFileContents, dimension_of


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
